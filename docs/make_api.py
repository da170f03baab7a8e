"""The API reference of the documents' site: every public name with its signature and what its docstring says of each parameter.

`docs/conf.py` puts it below docs/api.md when the site is built; tests/test_site.py refuses a parameter that is not described.
Docstrings here are prose in which a parameter is explained as "name: text.", or "name (shape), other: text."; `explained` finds that.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from typing import Any, NamedTuple

import rotorwatch as rw
from rotorwatch.base import discovery

_NAME = r"\w+(?: (?:\([^)]*\)|\[[^\]]*\]))?"  # with its shape or unit
_NAMES = rf"{_NAME}(?:(?:, | and ){_NAME})*"
_START = re.compile(rf"(?:^|(?<=[.;)] ))({_NAMES}): ")


class Public(NamedTuple):
    """A public name: how it is called, the object, and its module."""

    label: str
    found: Any
    module: str


def public() -> Iterator[Public]:
    """Every name of `rotorwatch.__all__` but the version, and every function of rotorwatch_lab; functions first, by their names."""
    homes = {name: f"rotorwatch.{home}" for name, home in {**rw._VERBS, **rw._HOMES}.items()}
    for name, entry in discovery.offered("rotorwatch.api").items():
        if entry.dist is not None and entry.dist.name == discovery.OURS and callable(getattr(rw, name)):
            homes[name] = entry.module
    pairs = [(name, getattr(import_module(home), name)) for name, home in homes.items()]
    for name, found in sorted(pairs, key=lambda pair: (inspect.isclass(pair[1]), pair[0])):
        yield Public(name, found, homes[name])


def members(kind: type) -> Iterator[tuple[str, Any]]:
    """Public methods and properties that a class defines itself, in the order of the source."""
    for name, found in vars(kind).items():
        if not name.startswith("_") and (inspect.isfunction(found) or isinstance(found, (property, classmethod))):
            yield name, found


def parameters(found: Any) -> list[inspect.Parameter]:
    """The parameters of a function or a constructor, without self; none where there is no signature."""
    found = found.__func__ if isinstance(found, classmethod) else found
    try:
        listed = list(inspect.signature(found).parameters.values())
    except (TypeError, ValueError):
        return []
    return [p for p in listed if p.name not in ("self", "cls")]


def explained(text: str, names: list[str]) -> dict[str, str]:
    """Name of a parameter -> its meaning, from a docstring."""
    found: dict[str, str] = {}
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        line = " ".join(paragraph.split())
        starts = [m for m in _START.finditer(line) if _of(m.group(1)) <= set(names)]
        ends = [m.start() for m in starts[1:]] + [len(line)]
        for match, end in zip(starts, ends):
            meaning = re.split(r"(?<=[.;)]) (?=Raises |Returns )", line[match.end() : end])[0].strip().rstrip(";")
            for name in _of(match.group(1)):
                shape = re.search(rf"\b{name} (\([^)]*\)|\[[^\]]*\])", match.group(1))
                found.setdefault(name, f"{shape.group(1)} {meaning}" if shape else meaning)
    return found


def _of(names: str) -> set[str]:
    """The names in "a (n,), b and c"."""
    return set(re.split(r", | and ", re.sub(r" (?:\([^)]*\)|\[[^\]]*\])", "", names)))


def unexplained() -> list[str]:
    """Parameters of public functions, and of constructors of public classes, that their docstrings say nothing of, as "name(parameter)"."""
    missing = []
    for label, found, _ in public():
        if inspect.isclass(found) and issubclass(found, Exception):
            continue
        listed = [p.name for p in parameters(found)]
        descriptions = explained(found.__doc__ or "", listed)
        missing += [f"{label}({name})" for name in listed if name not in descriptions]
    return missing


def page() -> str:
    """The reference as Markdown."""
    parts = []
    for label, found, module in public():
        parts.append(f"## {label}\n")
        if inspect.isclass(found) and issubclass(found, Exception):
            parts.append(_prose(found.__doc__ or ""))
            continue
        parts.append(_entry(f"rotorwatch.{label}", found, module))
        if inspect.isclass(found):
            for name, member in members(found):
                parts.append(f"### {label}.{name}\n\n{_entry(f'{label}.{name}', member, '')}")
    return "\n".join(parts)


def _entry(label: str, found: Any, module: str) -> str:
    """Signature, docstring and table of parameters."""
    doc = inspect.getdoc(found.fget if isinstance(found, property) else found) or ""
    listed = [] if isinstance(found, property) else parameters(found)
    shown = label if isinstance(found, property) else _signature(label, found)
    text = f"```python\n{shown}\n```\n\n{_prose(doc)}\n"
    descriptions = explained(doc, [p.name for p in listed])
    if listed:
        rows = [f"| `{p.name}` | {_type(p)} | {_default(p)} | {_cell(descriptions.get(p.name, ''))} |" for p in listed]
        text += "\n| parameter | type | default | meaning |\n|---|---|---|---|\n" + "\n".join(rows) + "\n"
    return text + (f"\nDefined in `{module}`.\n" if module else "")


def _signature(label: str, found: Any) -> str:
    listed = parameters(found)
    parts, starred = [], False
    for p in listed:
        if p.kind is p.KEYWORD_ONLY and not starred:
            parts.append("*")
            starred = True
        starred = starred or p.kind is p.VAR_POSITIONAL
        star = {p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "")
        parts.append(f"{star}{p.name}" + ("" if p.default is p.empty else f"={_value(p.default)}"))
    line = f"{label}({', '.join(parts)})"
    return line if len(line) < 100 else f"{label}(\n    " + ",\n    ".join(parts) + ",\n)"


def _type(p: inspect.Parameter) -> str:
    if p.annotation is p.empty:
        return ""
    text = p.annotation if isinstance(p.annotation, str) else inspect.formatannotation(p.annotation)
    return f"`{text}`".replace("|", "\\|")


def _default(p: inspect.Parameter) -> str:
    return "required" if p.default is p.empty else f"`{_value(p.default)}`".replace("|", "\\|")


def _value(value: Any) -> str:
    text = repr(value)
    return getattr(value, "__name__", "...") if " at 0x" in text or len(text) > 60 else text


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _prose(text: str) -> str:
    """A docstring as Markdown: names between double backquotes as code, indented blocks as they stand, tables of reST as text."""
    blocks = []
    for paragraph in inspect.cleandoc(text).replace("``", "`").split("\n\n"):
        rigid = paragraph.startswith((" ", "=")) or "\n    " in paragraph
        if rigid:
            paragraph = f"```text\n{paragraph}\n```"
        blocks.append(paragraph)
    return "\n\n".join(blocks)
