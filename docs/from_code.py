"""Parts of the docs that are made from the code at each build: decisions, settings, and the way of a scan."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

from tomo_polysplat.nuisances.known import NUISANCES
from tomo_polysplat.plan.order import ORDER
from tomo_polysplat.settings import _CHOICES, _RANGES, _SWITCHES

PACKAGE = Path(__file__).parents[1] / "tomo_polysplat"
# Functions whose calls are the way of a scan; see `way`.
STAGES = (
    ("reconstruction.py", "reconstruct"),
    ("reconstruction.py", "_problem"),
    ("plan/solver.py", "solve"),
    ("plan/preparation.py", "prepare"),
    ("plan/solver.py", "_fit"),
    ("fit/optimise.py", "fit"),
    ("reconstruction.py", "_result"),
)


def decisions_table() -> str:
    """A row a decision, in the order in which they are asked."""
    rows = ["| Decision | Question | Asked | Reads |", "|---|---|---|---|"]
    for kind in ORDER:
        page = Path(__file__).parent / "decisions" / f"{kind.name}.md"
        name = f"[`{kind.name}`](../decisions/{kind.name}.md)" if page.exists() else f"`{kind.name}`"
        words = " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())
        needs = ", ".join(f"`{needed.name}`" for needed in kind.needs)
        rows.append(f"| {name} | {words} | {kind.when.value} | {needs} |")
    return "\n".join(rows) + "\n"


def nuisances_table() -> str:
    """A row a nuisance, in the order in which a report tells of them."""
    rows = [
        "| Nuisance | Acts on | Parameters | Found by | The rays cannot tell it from | Gate | Cost |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in NUISANCES:
        numbers = ", ".join(
            f"`{name}` ({one.unit}, from {one.start:g})" for name, one in kind.parameters.items()
        )
        gate = " ".join((inspect.getdoc(kind.gate) or "").split("\n\n")[0].split()).replace("`", "")
        place, found = kind.place.value, kind.found_by.value
        rows.append(
            f"| `{kind.name}` | {place} | {numbers} | {found} | {kind.gauge} | {gate} | {kind.cost} |"
        )
    return "\n".join(rows) + "\n"


def way() -> list[tuple[str, str, list[tuple[str, str]]]]:
    """File, function, and what it calls of the package in the order of the source: (name, its module)."""
    found = []
    for file, name in STAGES:
        tree = ast.parse((PACKAGE / file).read_text(encoding="utf-8"))
        home = {
            alias.asname or alias.name: node.module.removeprefix("tomo_polysplat.")
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tomo_polysplat.")
            for alias in node.names
        }
        function = next(n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == name)
        calls = [n for n in ast.walk(function) if isinstance(n, ast.Call)]
        calls.sort(key=lambda call: (call.lineno, call.col_offset))
        called: list[tuple[str, str]] = []
        for call in calls:
            words = ast.unparse(call.func)
            first = words.partition(".")[0]
            entry = (words, home.get(first, ""))
            if (
                entry[1]
                and entry not in called
                and not entry[1].startswith(("checks", "transfer", "progress"))
            ):
                called.append(entry)
        found.append((file, name, called))
    return found


def draw_way(path: Path) -> None:
    """The stages as boxes, one below the other, with what each calls and where that lives."""
    from matplotlib.figure import Figure

    stages = way()
    lines = [1.6 + len(called) for _, _, called in stages]
    figure = Figure(figsize=(7.5, 0.24 * sum(lines) + 0.2 * len(stages)))
    axis = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axis.set_axis_off()
    height = sum(lines) + 0.8 * len(stages)
    axis.set_xlim(0, 10)
    axis.set_ylim(-height, 0)
    top = 0.0
    for (file, name, called), size in zip(stages, lines):
        axis.add_patch(_box(top, size))
        axis.text(0.3, top - 0.8, f"{name}()", weight="bold", va="center", fontsize=9)
        axis.text(9.7, top - 0.8, f"tomo_polysplat/{file}", va="center", ha="right", fontsize=8, color="0.4")
        for number, (words, module) in enumerate(called):
            y = top - 1.7 - number
            axis.text(0.7, y, words, va="center", fontsize=8, family="monospace")
            axis.text(9.7, y, module, va="center", ha="right", fontsize=8, color="0.4", family="monospace")
        top -= size + 0.8
    figure.savefig(path)


def _box(top: float, size: float):
    from matplotlib.patches import FancyBboxPatch

    return FancyBboxPatch(
        (0.1, top - size - 0.1), 9.8, size, boxstyle="round,pad=0.05", facecolor="#f4f6f8", edgecolor="0.6"
    )


# What no range of numbers says.
_OTHER = {"curves": "1 or 3", "agent": "a dict of settings", "memory": "bytes, or text"}


def _range(name: str) -> str:
    """The values that a setting takes besides None."""
    if name in _OTHER:
        return _OTHER[name]
    if name in _SWITCHES:
        return "True, False"
    if name in _CHOICES:
        return ", ".join(f'"{choice}"' for choice in _CHOICES[name])
    limits = _RANGES.get(name, {"at_least": 0.0})
    most = f" to {limits['at_most']:g}" if "at_most" in limits else ""
    if "above" in limits:
        return f"above 0{most and ',' + most}"
    return f"{limits['at_least']:g}{most}" if most else f"from {limits['at_least']:g}"


def settings_tables() -> str:
    """The settings by group, as the source has them: name, default, range, and its sentence."""
    source = (PACKAGE / "settings.py").read_text(encoding="utf-8")
    lines, parts = source.splitlines(), []
    found = next(n for n in ast.parse(source).body if isinstance(n, ast.ClassDef) and n.name == "Settings")
    group = ""
    for field, words in zip(found.body, found.body[1:]):
        if not (isinstance(field, ast.AnnAssign) and isinstance(words, ast.Expr)):
            continue
        above = [line.strip() for line in lines[field.lineno - 2 : field.lineno - 1]]
        if above and above[0].startswith("# "):
            group = above[0][2:].rstrip(".")
            parts.append(f"\n## {group}\n\n| Setting | Default | Values | What it is |\n|---|---|---|---|")
        told = " ".join(ast.literal_eval(words.value).split()).replace("|", "\\|")
        name = ast.unparse(field.target)
        parts.append(f"| `{name}` | {ast.unparse(field.value)} | {_range(name)} | {told} |")
    return "\n".join(parts) + "\n"


def make(folder: Path) -> None:
    """Write all of it into a folder."""
    folder.mkdir(exist_ok=True)
    (folder / "decisions_table.md").write_text(decisions_table(), encoding="utf-8")
    (folder / "nuisances_table.md").write_text(nuisances_table(), encoding="utf-8")
    (folder / "settings_tables.md").write_text(settings_tables(), encoding="utf-8")
    draw_way(folder / "way.svg")
