"""The HTML report: one self-contained file that opens offline. Everything that comes from a log is escaped."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any

from rotorwatch import __version__, report
from rotorwatch.base import files, optional
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Diagnosis, RotorState
from rotorwatch.report import colours, drawing, figures, lanes, markdown, track, upset, words

UNIT = re.compile(r"(\d) (%|s|Hz|ms|V|g)(?![\w])")
RANGE = re.compile(r"(\d)(–)(?=\d)")
SYMBOLS = {"healthy": "✓", "fault": "✕", "crashed": "✕", "ambiguous": "?", "inconclusive": "?"}
# A button; for it the page holds the post as `diagnose --markdown` writes it; where a browser lets nothing be copied, it is shown selected.
COPY = (
    '<div class="copy"><button type="button" id="copy-markdown">Copy for a forum</button> <span role="status" id="copied"></span>'
    '<textarea id="post" readonly hidden aria-label="Post for a forum, as Markdown" rows="8"></textarea></div>'
)
# The page may run its own inline scripts and styles and nothing else; in particular it may not fetch anything.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:"
)


def write(diagnosis: Diagnosis, path: str | os.PathLike) -> None:
    """Write the page to `path`: all of it or nothing. Raises ConfigError when the place cannot be written to."""
    text = page(diagnosis)
    try:
        with files.replacing(path) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
    except ConfigError as why:
        raise ConfigError(f"The report {why}") from None


def page(diagnosis: Diagnosis) -> str:
    """The page's HTML text. Raises ConfigError without Bokeh."""
    optional.library("bokeh", "An HTML report")
    title = str(diagnosis.flight.get("name") or "flight")
    plots = {**upset.plots(diagnosis), **figures.plots(diagnosis)}
    scripts, divs = embed(plots)
    common, blind = report.common_mode(diagnosis), diagnosis.trace.blind if diagnosis.trace is not None else ()
    body = [
        masthead(title),
        '<main id="report">',
        _verdict(diagnosis),
        _moment(diagnosis, divs),
        _overview(diagnosis),
        _health(diagnosis),
        _events(diagnosis, "loss" in divs),
        _baseline(diagnosis),
        _plots(diagnosis, divs),
        _context(diagnosis, divs),
        f"<h2>All rotors together</h2><p>{_text(common)}</p>" if common else "",
        _comparison(report.comparison(diagnosis)),
        _messages(diagnosis),
        _list("Warnings", diagnosis.warnings, "warnings"),
        _list("Assumptions", [f"Baseline: {diagnosis.baseline}", *diagnosis.assumptions]),
        _list("Times that could not be assessed", (f"{start:.1f} to {end:.1f} s: {why}" for start, end, why in blind)),
        "</main>",
        _footer(diagnosis, title),
    ]
    data = diagnosis.to_json()
    post = json.dumps(markdown.text(diagnosis))
    blocks = [_data("diagnosis", data), _data("markdown", post), scripts]
    return document(f"{title}: {report.VERDICTS[diagnosis.verdict]}", [*body, *blocks])


def document(title: str, parts: Iterable[str]) -> str:
    """A whole page of these parts, in the report's style; empty ones are left out."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)} – rotorwatch</title>\n"
        f"<style>{_own('page.css')}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body>\n</html>\n"
    )


def _data(name: str, text: str) -> str:
    """JSON for the page's script; inside a script element no tag may begin."""
    safe = text.replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{safe}</script>'


def _own(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


def embed(plots: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """The scripts (library, data, our own) and one element per plot. Without plots only our own script."""
    own = f"<script>{_own('page.js')}</script>"
    if not plots:
        return own, {}
    from bokeh.document import Document
    from bokeh.embed import components
    from bokeh.resources import Resources

    document = Document()
    with document.models.freeze():  # all plots at once: the data that they share are searched only once
        for plot in plots.values():
            document.add_root(plot)

    # Only the core library: no widgets, no tables, no GL, no MathJax.
    library = Resources(mode="inline", components=["bokeh"]).render_js()
    data, divs = components(dict(plots))
    return f"{library}\n{data}\n{own}", divs


def masthead(title: str) -> str:
    brand = f'<span class="brand">rotorwatch {escape(__version__)}</span>'
    return f'<header class="masthead"><b>{escape(title)}</b>{brand}</header>'


def _text(value: Any) -> str:
    """Escaped, with numbers, their ranges and their units kept on one line."""
    text = UNIT.sub("\\1\u00a0\\2", escape(str(value)))
    return RANGE.sub("\\1\u2060\\2\u2060", text)


def _verdict(diagnosis: Diagnosis) -> str:
    word = f"{SYMBOLS[diagnosis.verdict]} {report.VERDICTS[diagnosis.verdict]}"
    steps = "".join(f"<li>{_text(step)}</li>" for step in diagnosis.advice)
    return (
        f'<section class="verdict {escape(diagnosis.verdict)}"><div class="word">{escape(word)}</div>'
        f"<h1>{_text(diagnosis.headline)}</h1>{_story(diagnosis)}<p>{_text(report.sentence(diagnosis.reason))}</p>"
        + (f'<h2>What to do next</h2><ul class="advice">{steps}</ul>' if steps else "")
        + COPY
        + "</section>"
    )


def _story(diagnosis: Diagnosis) -> str:
    """What happened when control was lost."""
    items = "".join(f"<li>{_text(s.text)}</li>" for s in diagnosis.story)
    return f'<h2>What happened</h2><ol class="story">{items}</ol>' if items else ""


def _moment(diagnosis: Diagnosis, divs: Mapping[str, str]) -> str:
    """The picture around a loss of control, or a desync."""
    names = [name for name in upset.NAMES if name in divs]
    if not names:
        return ""
    looks = colours.looks(diagnosis)
    keys = " &ensp; ".join(
        f'<span class="nowrap">{_line(*looks[r.rotor])}{_text(report.rotors([r.rotor], report.places(diagnosis)))}</span>'
        for r in diagnosis.rotors
    )
    return (
        '<section class="moment" id="moment"><h2>The moment in one picture</h2><p>Attitude and rates: blue as it flew, dashed the '
        "setpoint. Commands: of each rotor, in percent of full thrust; a thick line is the rotor that is named above.</p>"
        + "".join(_plot(name, divs) for name in names)
        + f'<p class="note">{keys}</p></section>'
    )


def _overview(diagnosis: Diagnosis) -> str:
    facts = diagnosis.flight
    airborne = facts.get("airborne_s") or ()
    boot = f"{facts['boot_s']:.2f} s since boot" if facts.get("boot_s") else ""
    entries = {
        "airframe": report.frame(diagnosis),
        "autopilot": facts.get("autopilot"),
        "format": facts.get("format"),
        "duration": f"{float(facts.get('duration_s') or 0):.1f} s",
        "airborne": f"{float(airborne[0]):.1f} to {float(airborne[1]):.1f} s" if len(airborne) == 2 else None,
        "second 0 of the log": ", ".join(filter(None, (report.day(diagnosis), boot))),
        "logging": facts.get("profile"),
    }
    head = _row(("rotor", "where", "status", "loss", "95 % interval", "0 to 100 %"), cell="th", right=(3,), wide=(5,))
    looks = colours.looks(diagnosis)
    table = _table(head, "".join(_rotor(r, looks[r.rotor][0]) for r in diagnosis.rotors), "rotors")
    return (
        f'{_facts(entries)}<div class="top"><div><h2>{escape(report.rotors_title(diagnosis))}</h2>'
        f"<p>{_text(report.scope(diagnosis))}</p>{table}</div>{drawing.airframe(diagnosis)}</div>"
    )


def _health(diagnosis: Diagnosis) -> str:
    head = _row(("rotor", "where", "grade", "trend (95 % interval)"), cell="th")
    table = _table(head, "".join(_row(row) for row in report.health(diagnosis)), "health")
    return f"<h2>Health of every rotor</h2><p>{_text(report.health_scale(diagnosis))}</p>{table}" if table else ""


def _table(head: str, rows: str, name: str = "") -> str:
    """A table of lines that are there already; empty without any."""
    about = f' class="{name}"' if name else ""
    whole = f'<div class="scroll"><table{about}><thead>{head}</thead><tbody>{rows}</tbody></table></div>'
    return whole if rows else ""


def _rotor(r: RotorState, tint: str) -> str:
    """A line of the rotor table; the chip and the bar are drawing, not text, hence put in after escaping."""
    unknown = r.status in ("unobservable", "suspect")
    bar = f'<span class="bar"><i style="width:{100 * min(max(r.loss, 0.0), 1.0):.1f}%"></i></span>'
    cells = ("CHIP", r.place, "STATUS", report.rotor_loss(r), report.rotor_interval(r), "" if unknown else "BAR")
    note = f'<div class="why">{_text(report.sentence(r.note))}</div>' if r.note else ""
    line = _row(cells, r.status, right=(3,), wide=(5,), style=f"--rotor:{tint}")
    chip = f'<span class="chip"></span>{r.rotor}'
    return line.replace("CHIP", chip).replace("STATUS", f"{escape(r.status)}{note}").replace("BAR", bar)


def _row(cells: Iterable[Any], name: str = "", *, cell: str = "td", right=(), wide=(), style: str = "") -> str:
    """A line of a table, escaped. right: columns of numbers; wide: columns that a phone has no room for; style: CSS of the line."""
    classes = {**dict.fromkeys(wide, ' class="wide"'), **dict.fromkeys(right, ' class="n"')}
    inner = "".join(f"<{cell}{classes.get(i, '')}>{_text(c)}</{cell}>" for i, c in enumerate(cells))
    about = f' class="{escape(name)}"' if name else ""
    about += f' style="{escape(style)}"' if style else ""
    return f"<tr{about}>{inner}</tr>"


def _facts(entries: Mapping[str, Any]) -> str:
    cells = (f"<div><dt>{escape(k)}</dt><dd>{_text(v)}</dd></div>" for k, v in entries.items() if v not in (None, ""))
    return f'<dl class="facts">{"".join(cells)}</dl>'


def _events(diagnosis: Diagnosis, shown: bool = False) -> str:
    """shown: there are plots in which the moment of an event can be shown."""
    items = []
    for number, e in enumerate(diagnosis.events, 1):
        several = number - 1 == diagnosis.main and len(diagnosis.events) > 1
        main = ' <span class="main">main event</span>' if several else ""
        items.append(
            f'<li style="--tint:{colours.of_event(e)}"><h3>{number}. {escape(report.sentence(e.means.noun))}: '
            f"{_text(report.who(e, diagnosis))}{main}</h3>"
            f"{_facts(report.event_rows(e, diagnosis))}<p>{_text(report.sentence(e.reason))}</p>"
            + (f'<p><a href="#t={e.onset_s:.2f}">Show where it began</a></p>' if shown else "")
            + "</li>"
        )
    return f'<h2>Events</h2><ol class="events">{"".join(items)}</ol>' if items else ""


def _baseline(diagnosis: Diagnosis) -> str:
    rows = "".join(f"<dt>{escape(name)}</dt><dd>{_text(value)}</dd>" for name, value in report.whole_flight(diagnosis))
    if not rows:
        return ""
    return f'<h2>Against healthy flights of this build</h2><dl class="pairs">{rows}</dl>{drawing.baseline(diagnosis)}'


def _messages(diagnosis: Diagnosis) -> str:
    messages = report.messages(diagnosis)
    if not messages:
        return ""
    rows = (_row((report.seconds(t), report.moment(diagnosis, t), *what)) for t, *what in messages[:MOST_MESSAGES])
    table = _table(_row(("at", "clock", "what", "text"), cell="th"), "".join(rows))
    more = f"<p>The first {MOST_MESSAGES} of {len(messages)}.</p>" if len(messages) > MOST_MESSAGES else ""
    return f"<details><summary>Modes and messages of the autopilot ({len(messages)})</summary>{table}{more}</details>"


MOST_MESSAGES = 300
PLOTS = (
    (("command",), "Motor commands", "The autopilot's command of each rotor; a weak rotor gets a higher one."),
    (
        ("evidence",),
        "Evidence",
        "Odds of each explanation against a healthy aircraft, as powers of ten. The thick grey line is the threshold. "
        "Click a name to hide it.",
    ),
    (
        tuple(f"rate_{axis}" for axis in figures.ANGLES),
        "Rates: sticks and gyro",
        "Blue: measured. Dashed: the pilot's setpoint, after rates and expo. A vehicle with a weak motor lags behind, "
        "or shakes, on the axes of that motor.",
    ),
    (
        tuple(f"angle_{angle}" for angle in figures.ANGLES),
        "Attitude: setpoint and actual",
        "Blue: actual. Dashed: the controller's setpoint. A vehicle at its limit no longer follows it.",
    ),
    (
        figures.CHANNELS,
        "Residuals",
        "The part of the motion that the commands do not explain, with the ±2 sd band of a healthy aircraft; "
        "in units of the hover thrust (torques: times the arm).",
    ),
)
MARKS = {"mark": "onset", "mark full": "announced", "mark end": "end", "ground": "on the ground", "blind": "blind"}


def _plots(diagnosis: Diagnosis, divs: Mapping[str, str]) -> str:
    if "loss" not in divs:
        return ""
    looks = colours.looks(diagnosis)
    chips = "".join(chip(f"rotor {r.rotor}", *looks[r.rotor]) for r in diagnosis.rotors)
    marks = " &ensp; ".join(f'<span class="key {name}"></span>{text}' for name, text in MARKS.items())
    parts = [
        "<h2>Loss of each rotor over the flight</h2><p>The estimate as a live observer would have had it, with its "
        "95 % band. Drag over a time span to zoom all plots; the arrow in a plot's corner resets it.</p>",
        f'<div class="chips" role="group" aria-label="Rotors shown">{chips}</div>',
        _plot("loss", divs),
        _plot("lane", divs) if "lane" in divs else "",
        f'<p class="note">{marks}</p>',
        _moment_form(diagnosis),
        *_own_estimate(diagnosis, divs),
    ]
    for names, title, note in PLOTS:
        if names[0] in divs:
            parts += [f"<h2>{title}</h2><p>{note}</p>", *(_plot(name, divs) for name in names)]
    return "".join(parts)


def _own_estimate(diagnosis: Diagnosis, divs: Mapping[str, str]) -> list[str]:
    """What a published method itself says, with its own interval or bound; nothing by the default method."""
    if diagnosis.own is None or f"{figures.OWN}_loss" not in divs:
        return []
    name = diagnosis.own.method
    rest = "".join(
        _plot(plot, divs) for plot in divs if plot.startswith(f"{figures.OWN}_") and plot != f"{figures.OWN}_loss"
    )
    return [
        f"<h2>{escape(name)}: own estimates</h2><p>{_text(diagnosis.own.whose)} Nothing is held, clipped or decided; the losses above are "
        "those of the decision stage common to all methods.</p>",
        _plot(f"{figures.OWN}_loss", divs),
        f"<details><summary>States and innovations of {escape(name)}</summary>{rest}</details>",
    ]


def _moment_form(diagnosis: Diagnosis) -> str:
    """Where the moment that all plots mark is set by keyboard and its address is copied."""
    assert diagnosis.trace is not None
    first, last = float(diagnosis.trace.time[0]), float(diagnosis.trace.time[-1])
    return (
        f'<form class="at" id="at"><label for="at-time">Moment</label> <input id="at-time" type="number" inputmode="decimal" step="0.1" '
        f'min="{first:.2f}" max="{last:.2f}" aria-describedby="at-help"> s <span id="at-set" hidden>'
        '<button type="button" id="at-copy" aria-label="Copy link to this moment">Copy link</button> '
        '<button type="button" id="at-clear">Clear</button></span> '
        '<span role="status" id="at-status"></span><span class="help" id="at-help">Click in a plot or type a time: all plots mark that '
        "moment, and the address of this page leads to it.</span></form>"
    )


def _context(diagnosis: Diagnosis, divs: Mapping[str, str]) -> str:
    """Track, altitude, speed, battery, vibration and modes, folded; and what of them the log does not hold."""
    trace = diagnosis.trace
    if trace is None or "loss" not in divs:
        return ""
    gone = lanes.absent(trace)
    note = f'<p class="note">Not in this log: {_text(", ".join(gone))}.</p>' if gone else ""
    shown = [name for name in (*lanes.LANES, "modes") if name in divs]
    picture = track.svg(diagnosis)
    if not shown and not picture:
        return note
    keys = '<span class="spot start"></span>lift-off &ensp; <span class="spot end"></span>end'
    if diagnosis.events:
        tint = colours.of_event(diagnosis.events[diagnosis.main or 0])
        keys += f' &ensp; <span class="spot numbered" style="--tint:{tint}"></span>where the event of that number began'
    _, north, east = track.flown(trace)
    facts = {"farthest from the lift-off": track.metres(track.reach(north, east))} if picture else {}
    about = _facts(facts | lanes.summary(trace))
    drawn = f"<figure>{picture}<figcaption>{keys}</figcaption></figure>" if picture else ""
    return (
        '<details class="context" id="context"><summary>Track, altitude, battery and vibration</summary>'
        f'<div class="where">{drawn}{about}</div>'
        + "".join(_plot(name, divs) for name in shown)
        + (f'<p class="note">{VIBRATION}</p>' if "vibration" in divs else "")
        + f"{note}</details>"
    )


VIBRATION = (
    "Vibration: standard deviation of the accelerometer over half a second, without the motion (below about 2 Hz), along the body's "
    "axes x (forward), y (right) and z (down)."
)


def chip(name: str, tint: str, dash: str) -> str:
    """A button that shows and hides the lines of that name, such as a rotor's; it doubles as the legend."""
    line = _line(tint, dash)
    return f'<button type="button" aria-pressed="true" data-rotor="{escape(name)}">{line}{escape(name)}</button>'


def _line(tint: str, dash: str) -> str:
    """A piece of a rotor's line, for legends."""
    pattern = {"solid": "", "dashed": "6 3", "dotted": "2 3", "dotdash": "2 3 6 3", "dashdot": "6 3 2 3"}[dash]
    dashes = f' stroke-dasharray="{pattern}"' if pattern else ""
    path = f'<path d="M0 4h24" stroke-width="3" stroke="{tint}"{dashes}/>'
    return f'<svg class="piece" viewBox="0 0 24 8" aria-hidden="true">{path}</svg>'


def _plot(name: str, divs: Mapping[str, str]) -> str:
    return f'<div class="plot" id="plot-{name}">{divs[name]}</div>'


def _comparison(rows: Iterable[tuple[str, str, str, str]]) -> str:
    head = _row(("check", "found", "at", "why"), cell="th", right=(2,))
    table = _table(head, "".join(_row(row, right=(2,)) for row in rows))
    return f"<h2>Detections by method</h2>{table}" if table else ""


def _list(title: str, sentences: Iterable[str], name: str = "") -> str:
    items = "".join(f"<li>{escape(s)}</li>" for s in sentences)
    return f'<h2>{title}</h2><ul class="plain {name}">{items}</ul>' if items else ""


def _footer(diagnosis: Diagnosis, title: str) -> str:
    durations = ", ".join(f"{words(k)} {v:.2f} s" for k, v in diagnosis.timing.items())
    name = f"{title.partition('.')[0] or 'flight'}.json"
    return (
        f"<footer>Written by rotorwatch {escape(__version__)}, estimator {escape(diagnosis.estimator)}."
        f"{f' Time taken: {escape(durations)}.' if durations else ''} Times are in seconds from the first record of the log. "
        f'<button type="button" id="save-json" data-name="{escape(name)}">Save the answer as JSON</button></footer>'
    )
