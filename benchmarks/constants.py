"""Numeric constants and lines of each part of the diagnosis: `python benchmarks/constants.py [ROOT]`.

A constant is a name in capitals that a module gives a number, or a group of names a number each; tables and tuples count one for each
number. Those made of other constants alone follow from them and do not count.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

PARTS = ("engine/estimator", "engine/intake", "engine/drift", "engine/events", "engine/motion", "engine/bindings", "witnesses", "answer")


def constants(text: str) -> int:
    """Number of numeric constants of a module."""
    found = 0
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            names = [
                n.id for t in getattr(node, "targets", [getattr(node, "target", None)]) for n in ast.walk(t) if isinstance(n, ast.Name)
            ]
            if names and all(name.strip("_").isupper() for name in names):
                found += sum(isinstance(n, ast.Constant) and type(n.value) in (int, float) for n in ast.walk(node.value))
    return found


def counted(root: Path) -> dict[str, tuple[int, int]]:
    """Part -> (constants, lines)."""
    texts = {part: [p.read_text(encoding="utf-8") for p in sorted((root / "src/rotorwatch" / part).rglob("*.py"))] for part in PARTS}
    return {part: (sum(map(constants, some)), sum(len(t.splitlines()) for t in some)) for part, some in texts.items()}


if __name__ == "__main__":
    rows = counted(Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).resolve().parents[1])
    print("| part | constants | lines |\n|---|---|---|")
    for part, (numbers, lines) in [*rows.items(), ("all", tuple(map(sum, zip(*rows.values()))))]:
        print(f"| {part} | {numbers} | {lines} |")
