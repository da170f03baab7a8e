"""Several flights: a row for each, worst first, and the page that lists them, made from answers as JSON (docs/json.md)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from datetime import datetime, timedelta
from html import escape
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from rotorwatch import __version__
from rotorwatch.answer.wording import sentence
from rotorwatch.base import files
from rotorwatch.report import TONES

ORDER = ("error", "crashed", "fault", "ambiguous", "inconclusive", "healthy")
"""Worst first."""
MOST = 10_000
"""Most rows shown; further ones are only counted."""
# The page may run its own inline script and style only, and fetch nothing.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'"
STYLE = """
.tools { margin: 18px 0 8px; } .tools input { font: inherit; width: 100%; max-width: 420px; padding: 6px 10px; color: inherit;
  background: var(--card); border: 1px solid var(--line); border-radius: 8px; }
td.path { overflow-wrap: anywhere; min-width: 300px; }
td.word { color: var(--tint); font-weight: 650; white-space: nowrap; } .error { --tint: var(--fault); }
td.when { white-space: nowrap; font-variant-numeric: tabular-nums; } a { color: inherit; }
"""
SCRIPT = """
const box = document.getElementById("find"), rows = [...document.querySelectorAll("tbody tr")], shown = document.getElementById("shown");
box.addEventListener("input", () => {
  const words = box.value.toLowerCase().split(/\\s+/).filter(Boolean);
  let count = 0;
  for (const row of rows) {
    row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
    count += !row.hidden;
  }
  shown.textContent = words.length ? `${count} of ${rows.length} shown` : "";
});
"""


class Row(NamedTuple):
    """One flight. path: full; when: UTC where the log has it, else on its own clock; loss: the largest of a rotor; page: its report's
    file name, where there is one; reason: why, where the headline does not say so already; tone: as of `report.tone`."""

    verdict: str
    path: str
    aircraft: str
    when: str
    headline: str
    loss: float = 0.0
    page: str | None = None
    reason: str = ""
    tone: str = ""

    @property
    def look(self) -> str:
        """The verdict whose colour it gets."""
        return self.tone or self.verdict

    @property
    def rank(self) -> tuple[int, float, str]:
        """Sort key: the worst flight has the least."""
        return ORDER.index(self.verdict), -self.loss, self.path


def row(path: str, answer: Mapping[str, Any], page: str | None = None) -> Row:
    """The row of an answer as `Diagnosis.to_dict` gives it, or of an error."""
    if "error" in answer:
        why = answer["error"].removeprefix(f"{path}: ").removeprefix(f"{answer['flight']['name']}: ")
        return Row("error", path, "", "", why, page=page)
    facts, losses = answer["flight"], [r["loss"] or 0.0 for r in answer["rotors"]]
    aircraft = facts.get("aircraft") or " · ".join(str(facts[k]) for k in ("frame", "firmware") if facts.get(k))
    what, why = str(answer["headline"]), sentence(str(answer["reason"]))
    why = "" if why.rstrip(".").lower() in what.lower() else why
    tone = TONES.get((answer.get("fit_to_fly") or {}).get("word", ""), "")
    return Row(answer["verdict"], path, str(aircraft), when(answer), what, max(losses, default=0.0), page, why, tone)


def when(answer: Mapping[str, Any]) -> str:
    """Onset of the main event: '2026-11-21 07:41:07 UTC', else on the autopilot's or the log's own clock; without an event the
    start of the log in UTC, where known."""
    facts, main = answer["flight"], answer.get("main_event")
    since = None if main is None else float(answer["events"][main]["onset_s"])
    if facts.get("utc_start"):
        start = datetime.fromisoformat(str(facts["utc_start"]).replace("Z", "+00:00"))
        return f"{start + timedelta(seconds=since or 0.0):%Y-%m-%d %H:%M:%S} UTC"
    if since is None:
        return ""
    return f"{facts['boot_s'] + since:.2f} s since boot" if facts.get("boot_s") else f"{since:.2f} s"


class Rows:
    """Flights of a call: the worst rows, and the number of each verdict."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._rows: list[Row] = []

    def add(self, row: Row) -> None:
        """Count a row; keep it while it is among the MOST worst."""
        self.counts[row.verdict] += 1
        self._rows.append(row)
        if len(self._rows) > 2 * MOST:
            self._rows = self.worst()

    def worst(self) -> list[Row]:
        """Rows that are shown, worst first."""
        return sorted(self._rows, key=lambda row: row.rank)[:MOST]

    def title(self) -> str:
        """'23 logs: 1 error, 9 fault, 13 healthy'."""
        total = sum(self.counts.values())
        parts = [f"{self.counts[word]} {word}" for word in ORDER if self.counts[word]]
        more = f" (the {MOST} worst are listed)" if total > MOST else ""
        return f"{total} {'log' if total == 1 else 'logs'}: {', '.join(parts)}{more}"


def write(rows: Rows, path: Path) -> None:
    """Write the page that lists the flights, worst first, with links to their reports; it opens offline. Raises ConfigError."""
    with files.replacing(path) as unfinished:
        Path(unfinished).write_text(page(rows), encoding="utf-8")


def css() -> str:
    """The style of pages that list flights."""
    return (Path(__file__).parent / "page.css").read_text(encoding="utf-8") + STYLE


def page(rows: Rows) -> str:
    """The page's HTML text."""
    title = rows.title()
    head = "".join(f"<th>{name}</th>" for name in ("verdict", "log", "aircraft", "when", "what", "why"))
    lines = "\n".join(_line(r) for r in rows.worst())
    worst = next((word for word in ORDER if rows.counts[word]), "healthy")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)} – rotorwatch</title>\n<style>{css()}</style>\n</head>\n<body>\n"
        f'<div class="masthead"><b>{escape(title)}</b><span class="brand">rotorwatch {escape(__version__)}</span></div>\n'
        f'<main id="logs">\n<section class="verdict {worst}"><div class="word">Worst first</div><h1>{escape(title)}</h1></section>\n'
        '<div class="tools"><label>Find <input id="find" type="search" placeholder="words of a path, an aircraft, a verdict"></label> '
        '<span id="shown" class="small" role="status"></span></div>\n'
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{lines}\n</tbody></table></div>\n</main>\n<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def _line(row: Row) -> str:
    path = escape(printable(row.path))
    link = f'<a href="{escape(quote(row.page))}">{path}</a>' if row.page else path
    return (
        f'<tr class="{row.look}"><td class="word">{row.verdict}</td><td class="path">{link}</td><td>{escape(row.aircraft)}</td>'
        f'<td class="when">{escape(row.when)}</td><td>{escape(printable(row.headline))}</td>'
        f"<td>{escape(printable(row.reason))}</td></tr>"
    )


def printable(text: str) -> str:
    """Text without bytes that are not UTF-8, as file names may hold."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
