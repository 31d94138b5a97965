"""The package as a whole: what importing it costs, which way imports go, and that it is packaged whole."""

import ast
import graphlib
import importlib
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import tomo_polysplat

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "tomo_polysplat"
BASICS = (
    "checks",
    "parallel",
    "versions",
    "compiled",
    "files",
    "folders",
    "file_lock",
    "free_memory",
    "quiet_imports",
    "json_text",
    "plain_file",
    "units",
    "settings",
    "evenly_spread",
    "progress",
    "interrupts",
    "transfer",
    "ranks",
    "rank_processes",
    "rank_work",
)
LAYERS = (
    BASICS,
    ("kernels",),
    ("physics",),
    ("scan",),
    ("nuisances",),
    ("simulate", "start"),
    ("model",),
    ("render",),
    ("fit",),
    ("plan",),
    ("result", "report"),
    ("reconstruction", "viewer"),
    ("quality",),
    ("baselines", "bench", "cli", "doctor", "plugins"),
    ("__main__",),
)
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
# Loading any of these takes a good part of a second, or starts something.
HEAVY = ("astra", "matplotlib", "numba", "triton", "torch", "skimage", "scipy", "h5py", "xraydb", "tomopy")

PUBLIC = vars(tomo_polysplat)["_PUBLIC"]
OPTIONAL = ("triton", "tomopy", "dxchange")


def sources():
    folders = {"": PACKAGE, "plugins/": ROOT / "plugins"}
    return [
        (part_of(path, folder, prefix), path)
        for prefix, folder in folders.items()
        for path in sorted(folder.rglob("*.py"))
        if path != PACKAGE / "__init__.py"
    ]


def part_of(path, folder, prefix):
    return "plugins" if prefix else path.relative_to(folder).with_suffix("").parts[0]


@cache
def read(path):
    """What a file imports anywhere in it, for type checking as well, as (module or None, names); its long functions."""
    source = path.read_text(encoding="utf-8")
    nodes, imported = [*ast.walk(ast.parse(source))], []
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide where they lead"
            imported.append((node.module, [alias.name for alias in node.names]))
        elif isinstance(node, ast.Import):
            imported.append((None, [alias.name for alias in node.names]))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    return imported, [*long_functions(functions, source.splitlines())]


def imported_parts(path):
    """Parts of the package that a file imports."""
    for module, names in read(path)[0]:
        whole = names if module is None else [f"{module}.{name}" for name in names]
        yield from (name.split(".")[1] for name in whole if name.startswith("tomo_polysplat."))


def test_importing_is_quick_and_light():
    code = (
        "import sys, time; start = time.perf_counter(); import tomo_polysplat, tomo_polysplat.cli;"
        "print(time.perf_counter() - start, *sorted(m for m in sys.modules if '.' not in m))"
    )
    # The quickest of three: other programs may keep the machine busy.
    answers = [
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
        ).stdout
        for _ in range(3)
    ]
    seconds, *modules = min(answers, key=lambda answer: float(answer.split()[0])).split()
    assert "tomo_polysplat" in modules and not set(HEAVY) & set(modules)
    assert float(seconds) < 1.0


def test_imports_go_one_way():
    found = [(part, other, path) for part, path in sources() for other in imported_parts(path)]
    assert len(found) > 50, "the search for imports found next to nothing"
    unknown = {part for part, _ in sources()} - set(LEVEL)
    assert not unknown, f"no layer is named for {sorted(unknown)}"
    home = {name: module.split(".")[1] for name, module in PUBLIC.items()} | {"__version__": "checks"}
    upward = [
        f"{path.relative_to(ROOT)} imports {other}"
        for part, other, path in found
        if LEVEL[home.get(other, other)] > LEVEL[part]
    ]
    assert not upward, "\n".join(upward)


def imported_modules(path, known):
    """Modules of the package that a file imports."""
    for module, names in read(path)[0]:
        whole = names if module is None else [f"{module}.{name}" for name in names]
        yield from (name if module is None or name in known else module for name in whole)


def module_of(path):
    if PACKAGE not in path.parents:
        path = PACKAGE / "plugins" / path.relative_to(ROOT / "plugins")
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_no_modules_import_each_other():
    """Neither by way of others, nor within functions, nor for type checking."""
    known = {module_of(path): path for _, path in [*sources(), ("", PACKAGE / "__init__.py")]}
    graph = {name: {*imported_modules(path, known)} & (known.keys() - {name}) for name, path in known.items()}
    assert sum(map(len, graph.values())) > 500, "the search for imports found next to nothing"
    graphlib.TopologicalSorter(graph).prepare()


def test_what_a_result_holds_knows_nothing_of_what_shows_or_judges_it():
    known = {module_of(path): path for _, path in sources()}
    reached, new = set(), {"tomo_polysplat.result.data"}
    while new:
        reached |= new
        new = {
            other for name in new for other in imported_modules(known[name], known)
        } & known.keys() - reached
    assert "tomo_polysplat.scan.geometry" in reached
    parts = {name.split(".")[1] for name in reached}
    assert not parts & {"report", "quality", "viewer", "reconstruction", "cli"}


def test_basics_depend_on_basics_only():
    for name in BASICS:
        path = PACKAGE / f"{name}.py"
        if path.exists():
            assert set(imported_parts(path)) <= set(BASICS), path


@pytest.mark.parametrize("name", sorted(tomo_polysplat.__all__))
def test_every_public_name_is_there(name):
    assert getattr(tomo_polysplat, name) is not None
    assert name in dir(tomo_polysplat)


def test_a_module_does_not_hide_the_public_name_it_defines():
    """Importing a submodule binds it in the package; one called like its function would take its place."""
    assert not {name for name, module in PUBLIC.items() if module == f"tomo_polysplat.{name}"}


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = tomo_polysplat.nothing


def test_every_module_can_be_imported():
    for _, path in sources():
        if PACKAGE in path.parents:
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            try:
                importlib.import_module(name)
            except ModuleNotFoundError as error:
                assert error.name in OPTIONAL, f"{name} needs {error.name}"


def test_every_folder_is_packaged():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    folders = {path.parent for path in PACKAGE.rglob("*.py")}
    for folder in folders:
        assert f'"{".".join(folder.relative_to(ROOT).parts)}",' in text, (
            f"{folder.name} is missing in pyproject.toml"
        )
    assert (PACKAGE / "py.typed").exists()


def test_constraints_cover_every_dependency():
    """What is installed without a pin may break an installation on any day."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    block = text.split("dependencies = [", 1)[1].split("]", 1)[0]
    wanted = {line.strip().strip('",').split(">=")[0] for line in block.splitlines() if line.strip()}
    pinned = {line.split("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert len(wanted) > 8 and wanted <= pinned


def long_functions(functions, lines):
    """Functions of more than 40 lines, 6 parameters or 3 closures, and whether a comment above says why."""
    for node in functions:
        body = node.body[1:] if ast.get_docstring(node) else node.body
        length = node.end_lineno - body[0].lineno + 1 if body else 0
        names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
        closures = sum(isinstance(inner, ast.FunctionDef | ast.Lambda) for inner in ast.walk(node)) - 1
        if length > 40 or len([n for n in names if n not in ("self", "cls")]) > 6 or closures > 3:
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            yield node.name, lines[first - 2].lstrip().startswith("# ")


def test_a_long_function_says_why():
    """But for the kernels, whose compilers take arrays and numbers and no objects that hold them."""
    files = [path for part, path in sources() if part != "kernels"]
    assert [f"{path.name}: {name}" for path in files for name, why in read(path)[1] if not why] == []
