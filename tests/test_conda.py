"""What conda installs is what pyproject.toml asks for."""

import re
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
RECIPE = (ROOT / "conda" / "meta.yaml").read_text(encoding="utf-8")
# Packages of another name on conda-forge.
NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base"}


def section(name):
    """Packages of the recipe's list of that name, and what they have to be."""
    lines = re.search(rf"^ +{name}:\n((?: +- .*\n)+)", RECIPE, re.M)[1].splitlines()
    packages = (line.split("#")[0].strip(" -").partition(" ") for line in lines)
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


def test_the_recipe_has_the_package_s_version_licence_and_command():
    assert f'version = "{PROJECT["project"]["version"]}"' in RECIPE
    assert f"license: {PROJECT['project']['license']}\n" in RECIPE
    (file,) = PROJECT["project"]["license-files"]
    assert f"license_file: {file}\n" in RECIPE and (ROOT / file).is_file()
    ((name, function),) = PROJECT["project"]["scripts"].items()
    assert f"- {name} = {function}\n" in RECIPE


def test_the_recipe_is_yaml_once_its_variables_are_put_in():
    yaml = pytest.importorskip("yaml")
    known = dict(re.findall(r'{% set (\w+) = "(.*)" %}', RECIPE))
    plain = re.sub(r"{{ (\w+) }}", lambda word: known.get(word[1], word[1]), re.sub(r"{%.*%}\n", "", RECIPE))
    recipe = yaml.safe_load(plain)
    assert set(recipe) == {"package", "source", "build", "requirements", "test", "about"}
    assert recipe["package"] == {"name": PROJECT["project"]["name"], "version": known["version"]}
    assert recipe["build"]["noarch"] == "python" and set(recipe["test"]["imports"]) == {
        "tomo_polysplat",
        "tomo_polysplat.plugins",
    }


def test_the_environment_has_all_that_pip_would_else_bring():
    text = (ROOT / "environment.yml").read_text(encoding="utf-8")
    there = set(re.findall(r"^  - ([\w-]+)", text, re.M))
    # Python 3.12 reads TOML itself.
    assert set(asked(PROJECT["project"]["dependencies"])) - {"tomli"} <= there
