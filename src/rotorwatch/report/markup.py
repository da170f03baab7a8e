"""HTML of the report's parts: texts, tables, legends, and a section's blocks. Everything that comes from a log is escaped."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

from rotorwatch.report.blocks import Bullets, Notes, Pairs, Strong, Table, Text, Title
from rotorwatch.report.sections import Shown

UNIT = re.compile(r"(\d) (%|s|Hz|ms|V|g)(?![\w])")
RANGE = re.compile(r"(\d)(–)(?=\d)")


def text(value: Any) -> str:
    """Escaped, with numbers, their ranges and their units kept on one line."""
    made = RANGE.sub("\\1\u2060\\2\u2060", UNIT.sub("\\1\u00a0\\2", escape(str(value))))
    return f"<b>{made}</b>" if isinstance(value, Strong) else made


def table(head: str, rows: str, name: str = "") -> str:
    """A table of rows made by `row`; empty without any. name: CSS class."""
    about = f' class="{escape(name)}"' if name else ""
    whole = f'<div class="scroll"><table{about}><thead>{head}</thead><tbody>{rows}</tbody></table></div>'
    return whole if rows else ""


def row(cells: Iterable[Any], name: str = "", *, cell: str = "td", right=(), wide=(), style: str = "") -> str:
    """A table row, escaped. right: columns of numbers; wide: columns hidden on a phone; style: CSS of the row."""
    classes = {**dict.fromkeys(wide, ' class="wide"'), **dict.fromkeys(right, ' class="n"')}
    inner = "".join(f"<{cell}{classes.get(i, '')}>{text(c)}</{cell}>" for i, c in enumerate(cells))
    about = f' class="{escape(name)}"' if name else ""
    about += f' style="{escape(style)}"' if style else ""
    return f"<tr{about}>{inner}</tr>"


def facts(entries: Mapping[str, Any]) -> str:
    """Names with their values; empty values are left out."""
    cells = (f"<div><dt>{escape(k)}</dt><dd>{text(v)}</dd></div>" for k, v in entries.items() if v not in (None, ""))
    return f'<dl class="facts">{"".join(cells)}</dl>'


def chip(name: str, tint: str, dash: str) -> str:
    """A button that shows and hides the lines of that name, such as a rotor's; it doubles as the legend."""
    return f'<button type="button" aria-pressed="true" data-rotor="{escape(name)}">{line(tint, dash)}{escape(name)}</button>'


def line(tint: str, dash: str) -> str:
    """A sample of a rotor's line (SVG), for legends."""
    pattern = {"solid": "", "dashed": "6 3", "dotted": "2 3", "dotdash": "2 3 6 3", "dashdot": "6 3 2 3"}[dash]
    dashes = f' stroke-dasharray="{pattern}"' if pattern else ""
    path = f'<path d="M0 4h24" stroke-width="3" stroke="{tint}"{dashes}/>'
    return f'<svg class="piece" viewBox="0 0 24 8" aria-hidden="true">{path}</svg>'


def plot(name: str, div: str) -> str:
    """The place of a figure; div: its HTML element."""
    return f'<div class="plot" id="plot-{escape(name)}">{div}</div>'


def section(shown: Shown, divs: Mapping[str, str]) -> str:
    """A section: its own HTML, or title, blocks and figures; empty where it has neither words nor figures. divs: of all figures."""
    mine = {name: divs[name] for name in shown.figures}
    if shown.has("page"):
        return shown.call("page", shown.data, mine) or ""
    blocks = shown.blocks()
    named = next((b.text for b in blocks if isinstance(b, Title)), str(shown.section.title))
    inner = "".join(rendered(blocks, str(shown.section.name))) + "".join(plot(*item) for item in mine.items())
    return f"<h2>{text(named)}</h2>{inner}" if inner else ""


def rendered(blocks: Iterable[Any], name: str) -> Iterable[str]:
    """HTML of blocks; notes that follow each other are one list. name: CSS class of lists."""
    notes: list[str] = []
    for block in (*blocks, None):
        if isinstance(block, Notes):
            word = f"{block.word.capitalize()}: " if block.named else ""
            notes += [f"{word}{sentence}" for sentence in block.items]
            continue
        if notes:
            yield _list(notes, name)
            notes = []
        match block:
            case Text():
                yield f"<p>{text(block.text)}</p>"
            case Bullets():
                yield _list(("".join(item) for item in block.items), name)
            case Pairs():
                rows = "".join(f"<dt>{text(k)}</dt><dd>{text(v)}</dd>" for k, v in block.rows)
                yield f'<dl class="pairs">{rows}</dl>'
            case Table():
                rows = "".join(row(cells, right=block.right) for cells in block.rows)
                yield table(row(block.head, cell="th", right=block.right), rows, block.name)


def _list(items: Iterable[str], name: str) -> str:
    inner = "".join(f"<li>{text(item)}</li>" for item in items)
    return f'<ul class="plain {escape(name)}">{inner}</ul>' if inner else ""
