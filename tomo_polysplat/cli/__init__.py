"""The command ``tomo-polysplat``: one module a subcommand."""

from tomo_polysplat.cli.main import main as main
