"""``python -m tomo_polysplat``: the command line, also for ``torchrun -m tomo_polysplat``."""

import sys

from tomo_polysplat.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
