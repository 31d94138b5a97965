"""Sphinx settings: ``sphinx-build -W docs docs/_build``."""

import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
project = "tomo-polysplat"
author = "The tomo-polysplat developers"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
exclude_patterns = ["_build", "jupyter_execute", "generated/*.md"]
myst_heading_anchors = 4
# Notebooks are shown as they are in the repository: the tests run them.
nb_execution_mode = "off"
napoleon_google_docstring = False
napoleon_use_ivar = True
# Links to files outside docs/ are for readers of the repository; tests/test_readme.py checks that they lead somewhere.
# Pages named in the index may come later.
suppress_warnings = ["myst.xref_missing", "toc.empty_glob"]

# The gallery is a copy of examples/, made at each build.
shutil.rmtree(HERE / "gallery", ignore_errors=True)
(HERE / "gallery").mkdir()
for notebook in sorted((HERE.parent / "examples").glob("*.ipynb")):
    shutil.copy(notebook, HERE / "gallery" / notebook.name)

from from_code import make  # noqa: E402  # they lie beside this file
from from_commands import make as run_commands  # noqa: E402

make(HERE / "generated")
run_commands(HERE / "generated")
