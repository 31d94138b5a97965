"""What conda installs is what pyproject.toml asks for."""

import re
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

yaml = pytest.importorskip("yaml")
ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
FILE = ROOT / "conda" / "recipe.yaml"
RECIPE = yaml.safe_load(FILE.read_text(encoding="utf-8"))
# Packages of another name on conda-forge.
NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base"}


def section(name):
    """Packages of the recipe's list of that name, and what they have to be."""
    packages = (line.partition(" ") for line in RECIPE["requirements"][name])
    return {package: bound for package, _, bound in packages}


def asked(requirements):
    """The same of requirements as pip has them, without what they depend on."""
    plain = (one.partition(";")[0].strip() for one in requirements)
    split = (re.fullmatch(r"([\w.-]+)(.*)", one).groups() for one in plain)
    return {NAMES.get(name, name): bound for name, bound in split}


def test_the_recipe_asks_for_what_the_package_asks_for():
    python = {"python": PROJECT["project"]["requires-python"]}
    assert section("run") == asked(PROJECT["project"]["dependencies"]) | python
    assert section("host") == asked(PROJECT["build-system"]["requires"]) | python | {"pip": ""}


def test_the_recipe_has_the_package_s_name_version_licence_and_command():
    context = {name: PROJECT["project"][name] for name in ("name", "version")}
    assert RECIPE["context"] == context
    assert RECIPE["about"]["license"] == PROJECT["project"]["license"]
    assert [RECIPE["about"]["license_file"]] == PROJECT["project"]["license-files"]
    ((name, function),) = PROJECT["project"]["scripts"].items()
    assert RECIPE["build"]["noarch"] == "python"
    assert RECIPE["build"]["python"]["entry_points"] == [f"{name} = {function}"]


def test_rattler_build_renders_the_recipe():
    """Which knows what may stand in a recipe; a build takes packages of a channel."""
    rattler_build = pytest.importorskip("rattler_build", reason="python -m pip install py-rattler-build")
    (variant,) = rattler_build.Stage0Recipe.from_file(FILE).render()
    package = variant.recipe.package
    assert (str(package.name), str(package.version)) == ("tomo-polysplat", PROJECT["project"]["version"])


def test_the_environment_has_all_that_pip_would_else_bring():
    text = (ROOT / "environment.yml").read_text(encoding="utf-8")
    there = set(re.findall(r"^  - ([\w-]+)", text, re.M))
    # Python 3.12 reads TOML itself.
    assert set(asked(PROJECT["project"]["dependencies"])) - {"tomli"} <= there
