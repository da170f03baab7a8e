"""A diagnosis as Markdown for a forum or an issue: GitHub, Discourse (ArduPilot, PX4), Reddit. Short enough for a post, without private
data, and with text from logs escaped."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from rotorwatch import __version__, report
from rotorwatch.base import files, optional
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import blocks, overview, sections, still
from rotorwatch.report.markdown_text import code, escaped, private

MOST = 9_500  # letters of a post; forums take 10,000 and more
LEAST = 1_500  # letters left, below which no further log gets a section of its own
SECTIONS, ROWS, ROWS_MOST = 10, 25, 3_500  # of a post on several logs
ENDINGS = (".md", ".markdown", ".txt")
SIGNS = {"healthy": "✓", "fault": "✕", "crashed": "✕", "ambiguous": "?", "inconclusive": "?", "error": "!"}


class _Size(NamedTuple):
    """Limits of a post: events (and rows, bullets), letters of a sentence, steps of advice, folded sections."""

    events: int
    letters: int
    advice: int
    folded: int


SIZES = (
    _Size(8, 500, 6, 9), _Size(8, 400, 5, 4), _Size(6, 300, 4, 2), _Size(5, 250, 4, 1), _Size(4, 200, 3, 0), _Size(2, 140, 2, 0),
    _Size(1, 100, 1, 0), _Size(0, 60, 0, 0),
)  # fmt: skip


def text(diagnosis: Diagnosis, identify: bool = False, picture: str | None = None, parts: Sequence[Part] = (), most: int = MOST) -> str:
    """The post. identify: with the aircraft's serial number, the time of day, and texts as they are in the log; picture: name of the file
    that it shows; parts: as `prepared` made them, of a diagnosis that has lost its trace since; most: letters."""
    about = _About(diagnosis, identify, parts or prepared(diagnosis))
    made = ""
    for size in SIZES:
        made = "\n\n".join(part for part in about.parts(size, picture) if part) + "\n"
        if len(made) <= most:
            break
    return made


def line(diagnosis: Diagnosis) -> str:
    """The answer as one line of plain text, without private data: whether to fly, the headline, what flew."""
    facts, fit = diagnosis.flight, diagnosis.fit_to_fly
    firmware, maker = (str(facts.get(name) or "") for name in ("firmware", "autopilot"))
    flown = [report.frame(diagnosis), firmware if maker in firmware else f"{maker} {firmware}".strip()]
    word = (fit.word if fit else report.VERDICTS[diagnosis.verdict]).upper()
    said = private(f"{word}: {diagnosis.headline or diagnosis.reason}", diagnosis.aircraft)
    about = private(", ".join(part for part in flown if part), diagnosis.aircraft, True)
    return files.one_line(f"{said} ({about}; rotorwatch {__version__})", MOST)


class Part(NamedTuple):
    """A section of the post. top: above the fold."""

    title: str
    top: bool
    blocks: tuple[Any, ...]


def prepared(diagnosis: Diagnosis) -> tuple[Part, ...]:
    """The sections of the post, those above the fold first, then the most important first: of the folded ones the last are left out
    where there is no room."""
    shown = sections.shown(diagnosis, "post")
    shown.sort(key=lambda one: getattr(one.section, "post_order", one.section.order))
    made = (Part(str(s.section.title), getattr(s.section, "post_top", False), s.blocks()) for s in shown)
    return tuple(sorted((part for part in made if part.blocks), key=lambda part: not part.top))


class Written(NamedTuple):
    """A post as written, and why there is no picture, in a sentence; empty where there is one."""

    text: str
    why: str


def write(
    diagnosis: Diagnosis, path: str | os.PathLike, identify: bool = False, picture: bytes | None = None, parts: Sequence[Part] = ()
) -> Written:
    """Write the post to `path`, and the picture that it shows beside it, as a PNG of the same name. picture, parts: made before, of a
    diagnosis that has lost its trace since. Raises ConfigError where the place cannot be written to."""
    path, why = Path(path), ""
    target = path.with_suffix(".png")
    if picture is None:
        try:
            picture = picture_of(diagnosis)
        except ConfigError as reason:
            why = str(reason)
    if picture is not None:
        _put(target, picture)
    made = text(diagnosis, identify, None if why else target.name, parts)
    save(path, made)
    return Written(made, why)


def picture_of(diagnosis: Diagnosis) -> bytes:
    """The picture of a post: PNG. Raises ConfigError without matplotlib, or where there is nothing to draw."""
    kind = still.shows(diagnosis)
    optional.library("matplotlib.figure", "The picture of a post")
    out = io.BytesIO()
    still.figure(diagnosis, kind).savefig(out, format="png")
    return out.getvalue()


def save(path: str | os.PathLike, made: str) -> None:
    """Write a post atomically. Raises ConfigError."""
    with files.replacing(path) as unfinished:
        unfinished.write_text(made, encoding="utf-8", newline="\n")


def _put(path: Path, picture: bytes) -> None:
    with files.replacing(path) as unfinished:
        unfinished.write_bytes(picture)


@dataclass(frozen=True)
class _About:
    """The parts of a post on one flight."""

    diagnosis: Diagnosis
    identify: bool
    sections: Sequence[Part]

    def own(self, words: Any, most: int = 600) -> str:
        """A sentence as Markdown, escaped; without private data unless `identify`."""
        return escaped(words if self.identify else private(words, self.diagnosis.aircraft), most)

    def quoted(self, words: Any, most: int = 160, logged: bool = False) -> str:
        """Text of others as code."""
        return code(words if self.identify else private(words, self.diagnosis.aircraft, logged), most)

    def parts(self, size: _Size, picture: str | None) -> Iterator[str]:
        """Parts in order, some of them empty."""
        d = self.diagnosis
        headline = self.own(d.headline or d.reason, max(size.letters, 160))
        yield f"**{SIGNS[report.tone(d)]} {report.verdict(d)}: {headline}**"
        yield self._what_flew()
        if picture:
            yield f"![{_alternative(d)}]({quote(picture)})"
        story = [self.own(line.text, size.letters) for line in d.story]
        yield _numbered("What happened", story)
        yield self.own(report.sentence(d.reason), size.letters) if d.reason != d.headline else ""
        yield from (self._section(part, size) for part in self.sections if part.top)
        checks, surer = (some[: size.advice] for some in report.steps(d))
        yield _bullets("What to check", (self.own(step, size.letters) for step in checks))
        yield _bullets("What would make the answer surer", (self.own(step, size.letters) for step in surer[: size.advice - len(checks)]))
        below = (self._section(part, size) for part in self.sections if not part.top)
        folded = [part for part in below if part][: size.folded]
        if folded:
            inside = "\n\n".join(folded)
            yield f"<details><summary>Rotors, evidence, assumptions and warnings</summary>\n\n{inside}\n\n</details>"
        method = f", estimator {self.own(d.estimator, 60)}" if d.estimator != "default" else ""
        yield f"*rotorwatch {escaped(__version__)}{method}. Times are in seconds from the first record of the log.*"

    def _section(self, part: Part, size: _Size) -> str:
        """Title and blocks, without the title above the fold; empty without blocks."""
        made = "\n\n".join(filter(None, self._blocks(part.blocks, size)))
        title = next((b.text for b in part.blocks if isinstance(b, blocks.Title)), part.title)
        return f"**{self.own(title)}**\n\n{made}" if made and not part.top else made

    def _blocks(self, parts: Iterable[Any], size: _Size) -> Iterator[str]:
        notes: list[str] = []
        for block in (*parts, None):
            if isinstance(block, blocks.Notes):
                word = f"{block.word.capitalize()}: " if block.named else ""
                notes += [report.sentence(f"{word}{item}") for item in block.items]
                continue
            yield _items(self.own(note, size.letters) for note in _first(notes, size))
            notes = []
            match block:
                case blocks.Text():
                    yield self.own(block.text, size.letters)
                case blocks.Bullets():
                    yield _items(self._pieces(item, size.letters) for item in block.items[: size.events])
                case blocks.Pairs():
                    yield _items(self.own(f"{name}: {text}", size.letters) for name, text in block.rows)
                case blocks.Table():
                    yield self._table(block, size)

    def _pieces(self, item: str | tuple[str, ...], most: int) -> str:
        return self._cell(item, most) if isinstance(item, str) else " ".join(self._cell(piece, most) for piece in item)

    def _cell(self, cell: Any, most: int = 160) -> str:
        if isinstance(cell, blocks.Logged):
            return self.quoted(cell, min(most, 160), True)
        made = self.own(cell, most)
        return f"**{made}**" if made and isinstance(cell, blocks.Strong) else made

    def _table(self, block: blocks.Table, size: _Size) -> str:
        """The first rows, or the most important ones in their order, and how many there are more."""
        count = len(block.rows) if block.most is None else block.most
        chosen = range(len(block.rows))[:count] if block.ranks is None else sorted(block.ranks[: size.events])
        if not chosen:
            return ""
        left = len(block.rows) - len(chosen)
        are = f"{block.noun} is" if left == 1 else f"{block.noun}s are"
        rows = ([self._cell(cell) for cell in block.rows[k]] for k in chosen)
        return table([self.own(name, 60) for name in block.head], rows) + (f"\n\n{left} more {are} not shown." if left else "")

    def _what_flew(self) -> str:
        facts = self.diagnosis.flight
        airborne = facts.get("airborne_s") or ()
        up = f", airborne {airborne[0]:.0f} to {airborne[1]:.0f} s" if len(airborne) == 2 else ""
        firmware = str(facts.get("firmware") or "")
        maker = str(facts.get("autopilot") or "")
        cells = [
            self.quoted(_name(facts.get("name")), 80),
            self.own(report.frame(self.diagnosis), 80),
            *((escaped(maker, 40),) if maker and maker not in firmware else ()),
            code(firmware, 60),
            f"{float(facts.get('duration_s') or 0):.0f} s{up}",
        ]
        if self.identify:
            cells += [escaped(report.day(self.diagnosis)), code(self.diagnosis.aircraft, 120)]
        return " · ".join(cell for cell in cells if cell)


def _name(name: Any) -> str:
    """The name of a file without its folder, whatever system it is of."""
    return str(name or "").replace("\\", "/").rstrip("/").rpartition("/")[2]


def _alternative(diagnosis: Diagnosis) -> str:
    """Alternative text of the picture."""
    moment = diagnosis.picture and diagnosis.picture.get("commands")
    shown = "The moment: attitude and motor commands" if moment else "Loss and command of every rotor over the flight"
    return f"{shown}. {report.VERDICTS[diagnosis.verdict]}."


def _first(sentences: Sequence[str], size: _Size) -> list[str]:
    """The first sentences, and the number of those left out."""
    left = len(sentences) - size.events
    return [*sentences[: size.events], *([f"{left} more."] if left > 0 else [])]


def _items(lines: Iterable[str]) -> str:
    return "\n".join(f"- {line}" for line in lines if line)


def _bullets(title: str, lines: Iterable[str]) -> str:
    items = _items(lines)
    return f"**{title}**\n\n{items}" if items else ""


def _numbered(title: str, lines: Sequence[str]) -> str:
    items = "\n".join(f"{k}. {line}" for k, line in enumerate(lines, start=1))
    return f"**{title}**\n\n{items}" if items else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; cells are Markdown already."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


# Several logs


@dataclass(frozen=True)
class _Section:
    row: overview.Row
    diagnosis: Diagnosis
    parts: Sequence[Part]
    picture: bytes | None


@dataclass
class Several:
    """A post on several logs, filled as results arrive: a table, worst first, and a part for each log as far as there is room."""

    identify: bool = False
    rows: overview.Rows = field(default_factory=overview.Rows)
    sections: list[_Section] = field(default_factory=list)

    def add(self, row: overview.Row, diagnosis: Diagnosis | None = None, parts: Sequence[Part] = (), picture: bytes | None = None) -> None:
        """A log's row, and its answer, where it has one. picture: PNG."""
        self.rows.add(row)
        if diagnosis is not None:
            self.sections.append(_Section(row, diagnosis, parts, picture))
            self.sections = sorted(self.sections, key=lambda s: s.row.rank)[:SECTIONS]

    def write(self, path: Path) -> None:
        """The post, and beside it the pictures that it shows. Raises ConfigError."""
        save(path, self.text(path))

    def text(self, beside: Path | None = None) -> str:
        """The post. beside: the file that it is written to, next to which pictures are written."""
        parts = [f"**{escaped(self.rows.title())}**", self._overview()]
        room = MOST - sum(map(len, parts)) - 200
        shown = 0
        for section in self.sections:
            if room < LEAST:
                break
            share = max(LEAST, room // (len(self.sections) - shown)) - 20
            name = self._picture(section, beside, shown + 1)
            made = f"---\n\n{text(section.diagnosis, self.identify, name, section.parts, share)}"
            parts.append(made)
            room -= len(made) + 2
            shown += 1
        left = sum(self.rows.counts.values()) - self.rows.counts["error"] - shown
        if left:
            parts.append(f"{left} more {'log has' if left == 1 else 'logs have'} no section here.")
        return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"

    def _picture(self, section: _Section, beside: Path | None, number: int) -> str | None:
        if beside is None or section.picture is None:
            return None
        path = beside.with_name(f"{beside.stem}-{number}.png")
        _put(path, section.picture)
        return path.name

    def _overview(self) -> str:
        lines, letters = [], 0
        for row in self.rows.worst()[:ROWS]:
            name = _name(row.path)
            headline = row.headline.replace(row.path, name)
            cells = [
                f"{SIGNS[row.verdict]} {row.verdict}",
                code(name if self.identify else private(name), 80),
                escaped(headline if self.identify else private(headline), 200),
            ]
            letters += sum(map(len, cells)) + 10
            if letters > ROWS_MOST:
                break
            lines.append(cells)
        made = table(("verdict", "log", ""), lines)
        left = sum(self.rows.counts.values()) - len(lines)
        return made + (f"\n\n{left} more {'log is' if left == 1 else 'logs are'} not in this table." if left else "")
