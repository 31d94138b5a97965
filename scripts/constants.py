"""Count the numeric constants at the head of modules: what somebody read off some scans once.

usage: python scripts/constants.py [--list] [FOLDER ...]      (default: tomo_polysplat/fit tomo_polysplat/plan)

A constant is a name in capitals to which a module assigns numbers, alone or in tuples, lists and dicts; every number
counts. Sizes of blocks count as thresholds do. The second column counts numbers with no comment above.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("tomo_polysplat/fit", "tomo_polysplat/plan")
_NAME = re.compile(r"^_?[A-Z][A-Z0-9_]*$")


def constants(source: str) -> Iterator[tuple[str, int, int, bool]]:
    """Name, line, how many numbers, and whether a comment stands above, of each constant of a module."""
    lines = source.splitlines()
    commented = False
    before = 0
    for node in ast.parse(source).body:
        value = node.value if isinstance(node, (ast.Assign, ast.AnnAssign)) else None
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names = [name.id for target in targets for name in _names(target)]
        if value is None or not names or not all(map(_NAME.match, names)):
            commented = False
            continue
        numbers = _numbers(value)
        above = lines[node.lineno - 2].lstrip() if node.lineno > 1 else ""
        # Constants without a blank line between them share what is said above the first.
        commented = above.startswith("#") or (commented and before == node.lineno - 1)
        before = node.end_lineno or node.lineno
        if numbers:
            yield ", ".join(names), node.lineno, numbers, commented


def _names(target: ast.AST | None) -> list[ast.Name]:
    if isinstance(target, ast.Tuple):
        return [name for part in target.elts for name in _names(part)]
    return [target] if isinstance(target, ast.Name) else []


def _numbers(value: ast.AST) -> int:
    """Numbers in an expression that holds nothing else but their containers and arithmetic."""
    if isinstance(value, ast.Constant):
        return int(type(value.value) in (int, float))
    if isinstance(value, (ast.Tuple, ast.List, ast.Set)):
        return sum(map(_numbers, value.elts))
    if isinstance(value, ast.Dict):
        return sum(map(_numbers, value.values))
    if isinstance(value, ast.UnaryOp):
        return _numbers(value.operand)
    if isinstance(value, ast.BinOp):
        return int(bool(_numbers(value.left) or _numbers(value.right)))
    return 0


def main() -> None:
    """Print a line a module, and the sum."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="*", default=FOLDERS)
    parser.add_argument("--list", action="store_true", help="every constant with its line")
    arguments = parser.parse_args()
    total = bare = 0
    for folder in arguments.folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            found = list(constants(path.read_text(encoding="utf-8")))
            if not found:
                continue
            numbers = sum(entry[2] for entry in found)
            without = sum(entry[2] for entry in found if not entry[3])
            total, bare = total + numbers, bare + without
            print(f"{numbers:4d} {without:4d}  {path.relative_to(ROOT)}")
            for name, line, many, commented in found if arguments.list else ():
                print(f"           {line}: {name} ({many}){'' if commented else ', no comment'}")
    print(f"{total:4d} {bare:4d}  in all; the second column: without a comment above")


if __name__ == "__main__":
    main()
