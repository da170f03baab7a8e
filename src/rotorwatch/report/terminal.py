"""Tables for a terminal, by rich: readable from 40 to 200 columns, in a pipe and without colours.

Where a table does not fit, its rows become lines: no word and no number is cut.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from rotorwatch import report
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import blocks, sections, words

if TYPE_CHECKING:
    from rotorwatch.report.overview import Row

STYLES = {
    "healthy": "bold green",
    "fault": "bold red",
    "crashed": "bold red",
    "ambiguous": "bold yellow",
    "inconclusive": "bold yellow",
    "error": "bold red",
    "degraded": "red",
    "failed": "bold red",
    "suspect": "yellow",
    "unobservable": "dim",
}
BARS_FROM = 110  # columns from which a table has room for bars


def console(stderr: bool = False) -> Console:
    """Console for tables: colours only in a terminal, 80 columns in a pipe, no markup or emoji from names."""
    out = Console(stderr=stderr, highlight=False, emoji=False, markup=False)
    if not out.is_terminal:
        out = Console(stderr=stderr, highlight=False, emoji=False, markup=False, width=80, color_system=None)
    return out


def diagnosis(result: Diagnosis, verbose: bool = False) -> RenderableType:
    """The answer for one flight: verdict, story, reason, a summary of the sections, the next steps; verbose: all sections in full."""
    if not verbose:
        parts = [part for one in sections.shown(result, "summary") for part in _rendered(one.blocks("summary"))]
        return Group(*_heading(result, brief=True), *parts, *_steps(result), _more(result))
    parts: list[RenderableType] = [*_heading(result), *_steps(result)]
    notes: list[tuple[str, str]] = []
    for one in sections.shown(result, "terminal"):
        if one.has("screen"):
            parts += [Text(), *(one.call("screen", one.data) or ())]
            continue
        words_ = one.blocks()
        notes += [(block.word, str(item)) for block in words_ if isinstance(block, blocks.Notes) for item in block.items]
        parts += _section(str(one.section.title), [block for block in words_ if not isinstance(block, blocks.Notes)])
    if result.timing:
        notes.append(("took", ", ".join(f"{words(k)} {v:.2f} s" for k, v in result.timing.items())))
    return Group(*parts, Text(), Notes(notes))


def _section(title: str, parts: Sequence[Any]) -> list[RenderableType]:
    """A blank line, the title and the blocks; nothing without blocks. A table that comes first has the title as its own."""
    title = next((b.text for b in parts if isinstance(b, blocks.Title)), title)
    rest = [b for b in parts if not isinstance(b, blocks.Title)]
    if not rest:
        return []
    named = isinstance(rest[0], blocks.Table)
    return [Text(), *([] if named else [Text(title, style="bold")]), *_rendered(rest, title if named else "")]


def _rendered(parts: Iterable[Any], title: str = "") -> Iterator[RenderableType]:
    """Blocks, and renderables among them as they are. title: of the first table."""
    for part in parts:
        match part:
            case blocks.Text():
                yield aside(part.text, part.mark) if part.text else Text()
            case blocks.Bullets():
                yield from (aside("".join(item), "• ") for item in part.items)
            case blocks.Pairs():
                pairs = (Text(f"{name}: ", style="dim").append(text, style="default") for name, text in part.rows)
                yield from (Padding(pair, (0, 0, 0, 1)) for pair in pairs)
            case blocks.Table():
                cells = [[_cell(cell) for cell in row] for row in part.rows]
                yield Fitted(title, part.head, cells, right=part.right, wide=part.long, short=part.short)
                title = ""
            case _:
                yield part


def _cell(value: Any) -> Text:
    return Text(str(value), style="bold" if isinstance(value, blocks.Strong) else "")


def _more(result: Diagnosis) -> Text:
    """Hint at --verbose, with the number of warnings, assumptions and events."""
    left = {"warning": len(result.warnings), "assumption": len(result.assumptions), "event": len(result.events)}
    counted = ", ".join(f"{n} {word}{'s' if n > 1 else ''}" for word, n in left.items() if n)
    return Text(f"Details{f' ({counted})' if counted else ''}: --verbose", style="dim")


def aside(text: str, mark: str = "") -> Padding:
    """An indented sentence."""
    return Padding(Text(f"{mark}{text}"), (0, 0, 0, 1))


def line(name: str, result: Diagnosis) -> Text:
    """A flight of several on one line."""
    text = Text(f"{report.VERDICTS[result.verdict].lower():<11}  ", style=STYLES[report.tone(result)])
    return text.append(f"{name}  {result.headline}", style="default not bold")


def overview(title: str, rows: Sequence[Row]) -> RenderableType:
    """Several flights, a line each."""
    return _Overview(title, rows)


class _Overview:
    """A table; reason, time and aircraft where there is room. Paths and sentences wrap; the folder common to all logs is
    printed once."""

    def __init__(self, title: str, rows: Sequence[Row]):
        self.title, self.rows = title, rows

    def __rich_console__(self, console: Console, options):
        paths = [row.path for row in self.rows]
        folder = paths[0].rpartition("/")[0] if paths else ""
        while folder and not all(path.startswith(f"{folder}/") for path in paths):
            folder = folder.rpartition("/")[0]
        skip = len(folder) + 1 if folder else 0
        facts = {
            "verdict": [row.verdict for row in self.rows], "log": [path[skip:] for path in paths],
            "what": [row.headline for row in self.rows], "why": [row.reason for row in self.rows],
            "when": [row.when for row in self.rows], "aircraft": [row.aircraft for row in self.rows],
        }  # fmt: skip
        shown = ["verdict", "log", "what"]
        shown += [name for width, names in ((130, ["why"]), (190, ["when", "aircraft"])) if options.max_width >= width for name in names]
        yield Text(self.title, style="bold")
        if folder:
            yield Text(f"all in {folder}/", style="dim", overflow="fold")
        table = listing("", *shown)
        for name, column in zip(shown, table.columns):
            column.no_wrap = name in ("verdict", "when")
            column.overflow = "fold"
            column.ratio = {"log": 2, "what": 3, "why": 4, "aircraft": 2}.get(name)
        table.expand = True
        for k, row in enumerate(self.rows):
            cells = [Text(facts[name][k]) for name in shown]
            cells[0].stylize(STYLES[row.look])
            table.add_row(*cells)
        yield table


class Fitted:
    """A table where it fits, else a line for each cell, with the cell's name.

    rows: cells (Text). right: columns of numbers. wide: columns that may wrap. bars: columns left out below
    BARS_FROM columns. short: a row is one line then, in which only these places are named.
    """

    def __init__(self, title: str, columns, rows, right=(), wide=(-1,), bars=(), short=None):
        self.title, self.columns, self.rows, self.right, self.bars = title, columns, rows, set(right), set(bars)
        self.short = short
        self.wide = {i % len(columns) for i in wide}

    def __rich_console__(self, console: Console, options):
        shown = [i for i in range(len(self.columns)) if i not in self.bars or options.max_width >= BARS_FROM]
        least = 3 * (len(shown) - 1) + 2  # space between columns and at the edges
        for i in shown:
            cells = [Text(self.columns[i]), *(row[i] for row in self.rows)]
            least += max(_longest_word(c) if i in self.wide else _longest_line(c) for c in cells)
            least += 14 if i in self.wide and any(cell.cell_len > 30 for cell in cells) else 0
        if least <= options.max_width:
            names = [self.columns[i] for i in shown]
            table = listing(self.title, *names, right=[shown.index(i) for i in self.right if i in shown])
            for i, column in zip(shown, table.columns):
                column.no_wrap = i not in self.wide
            for row in self.rows:
                table.add_row(*(row[i] for i in shown))
            yield table
            return
        if self.title:
            yield Text(self.title, style="bold")
        for row in self.rows:
            cells = [i for i in range(len(self.columns)) if i not in self.bars and row[i].plain]
            first = cells[0]
            if self.short is not None:
                bits = [f"{self.columns[i]} {row[i].plain}" if i in self.short else row[i].plain for i in cells]
                yield Padding(Text(", ".join(bits), style=row[cells[-1]].style or ""), (0, 0, 0, 1))
                continue
            yield Text(f"{self.columns[first]} ", style="dim").append_text(Text(" ").join(row[first].split()))
            for i in cells[1:]:
                name = Text(f"{self.columns[i]}: " if self.columns[i] else "", style="dim")
                yield Padding(name.append_text(Text(" ").join(row[i].split())), (0, 0, 0, 2))


def _longest_word(text: Text) -> int:
    return max((Text(word).cell_len for word in text.plain.split()), default=0)


def _longest_line(text: Text) -> int:
    return max((piece.cell_len for piece in text.split()), default=0)


def _heading(result: Diagnosis, brief: bool = False) -> list[RenderableType]:
    facts = result.flight
    text = Text(report.verdict(result).upper(), style=STYLES[report.tone(result)])
    text.append("  ").append(result.headline, style="default bold")
    what = [str(facts["name"])] if facts.get("name") else []
    what += [report.frame(result), *(str(facts[k]) for k in ("autopilot",) if facts.get(k))]
    what += [] if brief else [str(facts[k]) for k in ("profile",) if facts.get(k)]
    what += [f"{float(facts.get('duration_s') or 0):.0f} s", *filter(None, [report.day(result)])]
    reason = report.sentence(result.reason)
    known = brief and (bool(result.story) or _said(reason, result.headline))
    return [text, Text(" · ".join(what), style="dim"), *_story(result), *([] if known else [Text(reason)])]


def _said(reason: str, headline: str) -> bool:
    """True if a headline contains all of a reason."""
    plain_ = [re.sub(r"[^a-z0-9]+", " ", text.lower()).strip() for text in (reason, headline)]
    return plain_[0] in plain_[1]


def _steps(result: Diagnosis) -> list[RenderableType]:
    return [aside(step, "→ ") for step in result.advice]


def _story(result: Diagnosis) -> list[RenderableType]:
    """Course of a loss of control, a line for each sentence."""
    lines = [aside(f"{k}. {line.text}") for k, line in enumerate(result.story, start=1)]
    return [Text(), Text("What happened", style="bold"), *lines, Text()] if lines else []


def listing(title: str, *columns: str, right: Iterable[int] = ()) -> Table:
    """An empty table with a title and columns; right: columns of numbers."""
    table = Table(title=title or None, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    for i, name in enumerate(columns):
        number = i in set(right)
        table.add_column(name, justify="right" if number else "left", no_wrap=number, header_style="default")
    return table


def _cells(rows: Iterable[Iterable[Any]]) -> list[list[Text]]:
    return [[Text(str(cell)) for cell in row] for row in rows]


class Notes:
    """Sentences with a word before each: in two columns, or one after the other on a narrow terminal."""

    def __init__(self, rows: Iterable[tuple[str, str]]):
        self.rows = list(rows)

    def __rich_console__(self, console: Console, options):
        room = options.max_width - 2 - max((len(name) for name, _ in self.rows), default=0)
        side_by_side = options.max_width >= 60 and all(_longest_word(Text(text)) <= room for _, text in self.rows)
        grid = Table.grid(padding=(0, 2))
        grid.add_column(no_wrap=True)
        grid.add_column(overflow="fold")
        for name, text in self.rows:
            style = "yellow" if name == "warning" else "dim"
            if side_by_side:
                grid.add_row(Text(name, style=style), Text(text))
            else:
                yield Text(f"{name}: ", style=style).append(text, style="default not dim")
        if side_by_side:
            yield grid


def info(facts: Mapping[str, Any]) -> RenderableType:
    """Tables of `rotorwatch info`; facts as from `rotorwatch.info`."""
    autopilot = "" if facts["autopilot"] in facts["firmware"] else f"{facts['autopilot']} "
    entries = {
        "log": facts["name"],
        "format": facts["format"],
        "autopilot": f"{autopilot}{facts['firmware']}",
        "vehicle": facts["frame"] or facts["vehicle_type"] or "unknown",
        "rotors": facts["rotors"] or "no commands found",
        "duration": f"{facts['duration_s']:.1f} s",
        "airborne": ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in facts["airborne_s"]) or "never found airborne",
        "parameters": facts["parameters"],
    }
    grid = Notes((key, str(value)) for key, value in entries.items() if value not in ("", None))
    signals = [  # 99.9 % valid is not all of it
        (s["name"], f"{s['rate_hz']:.4g} Hz", s["unit"], s["frame"], f"{int(100 * s['valid'])} %", s["source"]) for s in facts["signals"]
    ]
    head = ("signal", "rate", "unit", "frame", "valid", "source")
    parts: list[RenderableType] = [grid, Text(), Fitted("Signals", head, _cells(signals), (1, 4), short=(4,)), Text()]
    if facts["messages"]:
        messages = [(f"{m['time_s']:.1f} s", m["kind"], m["text"]) for m in facts["messages"]]
        parts += [Fitted("Messages", ("at", "what", "text"), _cells(messages), (0,), short=()), Text()]
    parts.append(Text("For a diagnosis", style="bold"))
    ready = "This log has what a diagnosis needs." if facts["ready"] else "This log cannot be diagnosed as it is."
    parts.append(Text(f" {ready}", style="green" if facts["ready"] else "red"))
    list_ = Table.grid(padding=(0, 1))
    for gap in facts["missing"]:
        tint = "red" if gap["needed"] else "dim"
        list_.add_row(Text(" •", style=tint), Text(gap["why"]).append(f" {gap['setting']}", "dim"))
    hears = facts["hears"]
    if hears["ready"]:
        list_.add_row(Text(" •", style="dim"), Text(f"It shows each rotor's balance, by {hears['sensor']}."))
    else:
        list_.add_row(
            Text(" •", style="dim"), Text(f"It does not show the rotors' balance: {hears['why']}.").append(f" {hears['setting']}", "dim")
        )
    for sentence in facts["warnings"]:
        list_.add_row(Text(" !", style="yellow"), Text(sentence))
    return Group(*parts, list_)
