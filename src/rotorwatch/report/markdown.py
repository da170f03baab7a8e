"""The answer as Markdown for a forum or an issue: GitHub, Discourse (ArduPilot, PX4), Reddit. Short enough to be posted, nothing in it that
only the owner should give away, and no text of a log that a site would take for more than text."""

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
from rotorwatch.flight.diagnosis import Diagnosis, Event
from rotorwatch.report import overview, still
from rotorwatch.report.markdown_text import code, escaped, private

MOST = 9_500  # letters of a post; forums take 10,000 and more
LEAST = 1_500  # letters left, below which no further log gets a section of its own
SECTIONS, ROWS, ROWS_MOST = 10, 25, 3_500  # of a post on several logs
AROUND_S, MESSAGES = 10.0, 8  # messages of the autopilot around the main event
ENDINGS = (".md", ".markdown", ".txt")
SIGNS = {"healthy": "✓", "fault": "✕", "crashed": "✕", "ambiguous": "?", "inconclusive": "?", "error": "!"}
Message = tuple[float, str, str]


class _Size(NamedTuple):
    """How much of an answer a post shows: events, letters of a sentence, steps of advice, and parts of what is folded."""

    events: int
    letters: int
    advice: int
    folded: int


SIZES = (
    _Size(8, 500, 6, 9), _Size(8, 400, 5, 4), _Size(6, 300, 4, 2), _Size(5, 250, 4, 1), _Size(4, 200, 3, 0), _Size(2, 140, 2, 0),
    _Size(1, 100, 1, 0), _Size(0, 60, 0, 0),
)  # fmt: skip


def text(
    diagnosis: Diagnosis,
    identify: bool = False,
    picture: str | None = None,
    messages: Sequence[Message] | None = None,
    most: int = MOST,
) -> str:
    """The post. identify: with the aircraft's serial number, the time of day, and texts as they are in the log; picture: name of the file
    that it shows; messages: those of the autopilot around the main event, of a diagnosis without its trace; most: letters."""
    about = _About(diagnosis, identify, around(diagnosis) if messages is None else tuple(messages))
    made = ""
    for size in SIZES:
        made = "\n\n".join(part for part in about.parts(size, picture) if part) + "\n"
        if len(made) <= most:
            break
    return made


class Written(NamedTuple):
    """A post as written, and why there is no picture, in a sentence; empty where there is one."""

    text: str
    why: str


def write(
    diagnosis: Diagnosis,
    path: str | os.PathLike,
    identify: bool = False,
    picture: bytes | None = None,
    messages: Sequence[Message] | None = None,
) -> Written:
    """Write the post to `path`, and the picture that it shows beside it, as a PNG of the same name. picture, messages: drawn and picked
    before, of a diagnosis without its trace. Raises ConfigError where the place cannot be written to."""
    path, why = Path(path), ""
    target = path.with_suffix(".png")
    if picture is None:
        try:
            picture = picture_of(diagnosis)
        except ConfigError as reason:
            why = str(reason)
    if picture is not None:
        _put(target, picture)
    made = text(diagnosis, identify, None if why else target.name, messages)
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
    """Write a post, all of it or nothing. Raises ConfigError."""
    with files.replacing(path) as unfinished:
        unfinished.write_text(made, encoding="utf-8", newline="\n")


def _put(path: Path, picture: bytes) -> None:
    with files.replacing(path) as unfinished:
        unfinished.write_bytes(picture)


def around(diagnosis: Diagnosis) -> tuple[Message, ...]:
    """The autopilot's messages around the main event, those closest to it, in the order of time; none without one or without a trace."""
    if diagnosis.main is None or diagnosis.trace is None:
        return ()
    event = diagnosis.events[diagnosis.main]
    start, end = event.onset_s - AROUND_S, max(event.onset_s, event.detected_s) + AROUND_S
    near = [m for m in diagnosis.trace.messages if start <= m[0] <= end]
    return tuple(sorted(sorted(near, key=lambda m: abs(m[0] - event.onset_s))[:MESSAGES]))


@dataclass(frozen=True)
class _About:
    """The parts of a post on one flight."""

    diagnosis: Diagnosis
    identify: bool
    messages: tuple[Message, ...]

    def own(self, words: Any, most: int = 600) -> str:
        """A sentence as Markdown."""
        return escaped(words if self.identify else private(words, self.diagnosis.aircraft), most)

    def quoted(self, words: Any, most: int = 160, logged: bool = False) -> str:
        """A text of others as code."""
        return code(words if self.identify else private(words, self.diagnosis.aircraft, logged), most)

    def parts(self, size: _Size, picture: str | None) -> Iterator[str]:
        """In their order; empty ones among them."""
        d = self.diagnosis
        headline = self.own(d.headline or d.reason, max(size.letters, 160))
        yield f"**{SIGNS[d.verdict]} {report.VERDICTS[d.verdict]}: {headline}**"
        yield self._what_flew()
        if picture:
            yield f"![{_alternative(d)}]({quote(picture)})"
        story = [self.own(line.text, size.letters) for line in d.story]
        yield _numbered("What happened", story)
        yield self.own(report.sentence(d.reason), size.letters) if d.reason != d.headline else ""
        yield self._events(size)
        yield _bullets("What to check next", (self.own(step, size.letters) for step in d.advice[: size.advice]))
        folded = [part for part in self._folded(size) if part][: size.folded]
        if folded:
            inside = "\n\n".join(folded)
            yield f"<details><summary>Rotors, evidence, assumptions and warnings</summary>\n\n{inside}\n\n</details>"
        method = f", estimator {self.own(d.estimator, 60)}" if d.estimator != "default" else ""
        yield f"*rotorwatch {escaped(__version__)}{method}. Times are in seconds from the first record of the log.*"

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

    def _events(self, size: _Size) -> str:
        d = self.diagnosis
        if not d.events or not size.events:
            return ""
        chosen = d.important(size.events)
        rows = (self._event(d.events[k], len(d.events) > 1 and k == d.main) for k in chosen)
        left = len(d.events) - len(chosen)
        more = f"\n\n{left} more {'event is' if left == 1 else 'events are'} not shown." if left else ""
        return table(("what", "rotor", "since", "found after", "loss (95 % interval)", "how sure"), rows) + more

    def _event(self, event: Event, main: bool) -> tuple[str, ...]:
        lasted = event.end_s is not None and event.end_s > event.onset_s
        until = f" until {report.seconds(event.end_s)}" if lasted else ""
        loss = report.losses(event) or report.size(event)
        what = self.own(event.means.noun, 60)
        return (
            f"**{what}**" if main else what,
            self.own(report.who(event, self.diagnosis), 160),
            f"{report.seconds(event.onset_s)}{until}",
            f"{event.detected_s - event.onset_s:.2f} s",
            escaped(loss or "–", 160),
            escaped(report.probability(event.probability)),
        )

    def _folded(self, size: _Size) -> Iterator[str]:
        """The most important first: what there is no room for is left out from the end."""
        d = self.diagnosis
        yield self._rotors(size)
        yield _bullets("Warnings", (self.own(w, size.letters) for w in _first(d.warnings, size)))
        assumed = (f"Baseline: {d.baseline}", *d.assumptions)
        yield _bullets("Assumed", (self.own(report.sentence(a), size.letters) for a in _first(assumed, size)))
        reasons = [
            f"{report.seconds(e.onset_s)}: {self.own(e.reason, size.letters)}"
            for e in d.events[: size.events]
            if e.reason
        ]
        yield _bullets("Evidence", reasons)
        said = (
            f"{report.seconds(t)} {escaped(kind, 40)}: {self.quoted(words, 120, True)}"
            for t, kind, words in self.messages
        )
        yield _bullets("Messages of the autopilot around the main event", said)
        checks = [[self.own(cell, 160) for cell in row] for row in report.comparison(d)[:8]]
        yield f"**Detections by method**\n\n{table(('check', 'found', 'at', 'why'), checks)}" if checks else ""
        common = report.common_mode(d)
        yield f"**All rotors together:** {self.own(common, size.letters)}" if common else ""

    def _rotors(self, size: _Size) -> str:
        d = self.diagnosis
        if not d.rotors:
            return ""
        rows = [
            (str(r.rotor), self.own(r.place, 40), self.own(r.status, 40), report.rotor_loss(r), report.rotor_interval(r),
             self.own(r.note, 120))
            for r in d.rotors
        ]  # fmt: skip
        made = table(("rotor", "where", "status", "loss", "95 % interval", ""), rows)
        scope = report.scope(d)
        return f"**{escaped(report.rotors_title(d))}**\n\n{made}" + (
            f"\n\n{self.own(scope, size.letters)}" if scope else ""
        )


def _name(name: Any) -> str:
    """The name of a file without its folder, whatever system it is of."""
    return str(name or "").replace("\\", "/").rstrip("/").rpartition("/")[2]


def _alternative(diagnosis: Diagnosis) -> str:
    """What the picture shows, for whoever does not see it."""
    moment = diagnosis.picture and diagnosis.picture.get("commands")
    shown = "The moment: attitude and motor commands" if moment else "Loss and command of every rotor over the flight"
    return f"{shown}. {report.VERDICTS[diagnosis.verdict]}."


def _first(sentences: Sequence[str], size: _Size) -> list[str]:
    """The first sentences, and how many there are more."""
    left = len(sentences) - size.events
    return [*sentences[: size.events], *([f"{left} more."] if left > 0 else [])]


def _bullets(title: str, lines: Iterable[str]) -> str:
    items = "\n".join(f"- {line}" for line in lines if line)
    return f"**{title}**\n\n{items}" if items else ""


def _numbered(title: str, lines: Sequence[str]) -> str:
    items = "\n".join(f"{k}. {line}" for k, line in enumerate(lines, start=1))
    return f"**{title}**\n\n{items}" if items else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of cells that are Markdown already."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


# Several logs


@dataclass(frozen=True)
class _Section:
    row: overview.Row
    diagnosis: Diagnosis
    messages: tuple[Message, ...]
    picture: bytes | None


@dataclass
class Several:
    """A post on several logs, filled as the answers come: a table of them, worst first, and a section for each as far as there is room."""

    identify: bool = False
    rows: overview.Rows = field(default_factory=overview.Rows)
    sections: list[_Section] = field(default_factory=list)

    def add(
        self,
        row: overview.Row,
        diagnosis: Diagnosis | None = None,
        messages: Sequence[Message] = (),
        picture: bytes | None = None,
    ) -> None:
        """A log's row, and its answer, where it has one. picture: PNG."""
        self.rows.add(row)
        if diagnosis is not None:
            self.sections.append(_Section(row, diagnosis, tuple(messages), picture))
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
            made = f"---\n\n{text(section.diagnosis, self.identify, name, section.messages, share)}"
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
