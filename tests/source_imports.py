"""What source files import."""

import ast
import functools

INSIDE = ("body", "orelse", "finalbody", "handlers", "cases")


@functools.cache
def imports(path):
    """(line, level, name) of everything that a file imports, wherever it does and whatever for. Only statements are looked through: nothing
    else imports, and they are a tenth of a tree."""
    found, left = [], [ast.parse(path.read_text(encoding="utf-8"))]
    while left:
        node = left.pop()
        if isinstance(node, ast.Import):
            found += [(node.lineno, 0, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found += [(node.lineno, node.level, f"{node.module}.{alias.name}") for alias in node.names]
        else:
            left += [part for field in INSIDE for part in getattr(node, field, ())]
    return tuple(found)
