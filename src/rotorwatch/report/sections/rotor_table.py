"""Every rotor: its status, its loss with the 95 % interval, and its place on the airframe."""

from __future__ import annotations

from typing import Any

from rotorwatch import report
from rotorwatch.answer.wording import BASELINE
from rotorwatch.flight.diagnosis import Diagnosis, RotorState
from rotorwatch.report import colours, drawing, markup
from rotorwatch.report.blocks import Block, Table, Text, Title

name, title, order = "rotors", "Rotors", 30
post_order = 10
HEAD = ("rotor", "where", "status", "loss", "95 % interval")


def data(diagnosis: Diagnosis) -> Diagnosis:
    return diagnosis


def words(data: Diagnosis) -> list[Block]:
    if not data.rotors:
        return []
    rows = [(str(r.rotor), r.place, r.status, report.rotor_loss(r), report.rotor_interval(r), r.note) for r in data.rotors]
    table = Table((*HEAD, ""), rows, most=None)
    return [Title(heading(data)), table, *([Text(text)] if (text := scope(data)) else [])]


def page(data: Diagnosis, divs: dict[str, str]) -> str:
    head = markup.row((*HEAD, "0 to 100 %"), cell="th", right=(3,), wide=(5,))
    looks = colours.looks(data)
    table = markup.table(head, "".join(_line(r, looks[r.rotor][0]) for r in data.rotors), "rotors")
    return (
        f'<div class="top"><div><h2>{markup.text(heading(data))}</h2>'
        f"<p>{markup.text(scope(data))}</p>{table}</div>{drawing.airframe(data)}</div>"
    )


def _line(r: RotorState, tint: str) -> str:
    """Row of the table; the chip and the bar are drawings, hence put in after escaping."""
    unknown = r.status in ("unobservable", "suspect")
    bar = f'<span class="bar"><i style="width:{100 * min(max(r.loss, 0.0), 1.0):.1f}%"></i></span>'
    cells = ("CHIP", r.place, "STATUS", report.rotor_loss(r), report.rotor_interval(r), "" if unknown else "BAR")
    note = f'<div class="why">{markup.text(report.sentence(r.note))}</div>' if r.note else ""
    line = markup.row(cells, r.status, right=(3,), wide=(5,), style=f"--rotor:{tint}")
    chip = f'<span class="chip"></span>{r.rotor}'
    return line.replace("CHIP", chip).replace("STATUS", f"{markup.text(r.status)}{note}").replace("BAR", bar)


def screen(data: Diagnosis) -> list[Any]:
    notes = [f"Rotor {r.rotor}: {r.note}." for r in data.rotors if r.note]
    return _screen(data, [*notes, scope(data)])


def summary(data: Diagnosis) -> list[Any]:
    """The table, where anything is known of a rotor."""
    known = (r for r in data.rotors if report.rotor_loss(r) != "?" or report.rotor_interval(r) or _news(r, data))
    notes = [f"Rotor {r.rotor}: {r.note}." for r in data.rotors if _news(r, data)]
    return ["", *_screen(data, notes)] if any(True for _ in known) else []


def _screen(data: Diagnosis, notes: list[str]) -> list[Any]:
    from rich.text import Text as Line

    from rotorwatch.report import terminal

    if not data.rotors:
        return [Line("The log shows no rotors.")]
    rows = []
    for r in data.rotors:
        style = terminal.STYLES.get(r.status, "")
        full = round(20 * min(max(r.loss, 0.0), 1.0))
        bar = Line("█" * full, style=style).append("·" * (20 - full), style="dim")
        numbers = map(Line, (report.rotor_loss(r), report.rotor_interval(r)))
        known = r.status not in ("unobservable", "suspect")
        start = (Line(str(r.rotor)), Line(r.place), Line(r.status, style=style))
        rows.append([*start, *numbers, bar if known else Line("")])
    look: dict[str, Any] = dict(right=(0, 3), wide=(4,), bars=(5,), short=(0, 3))
    table = terminal.Fitted(heading(data), (*HEAD, ""), rows, **look)
    return [table, *(terminal.aside(note) for note in notes if note)]


def _news(state: RotorState, diagnosis: Diagnosis) -> bool:
    """True if a rotor's note says more than the story: that the rotor worked until control was lost."""
    known = bool(diagnosis.story) and state.note.startswith("seen to work until") and " and " not in state.note
    return bool(state.note) and not known


def heading(diagnosis: Diagnosis) -> str:
    """Title of the rotor table."""
    if all(r.status == "unobservable" for r in diagnosis.rotors):
        if diagnosis.story and any(r.note for r in diagnosis.rotors):
            return "Rotors: last time each was seen working"
        return "Rotors: none could be assessed"
    if diagnosis.story:
        return "Rotors, up to the loss of control and after it"
    return "Rotors at the end of the assessed flight"


def scope(diagnosis: Diagnosis) -> str:
    """Limits of the rotor table, and with a published method the origin of its intervals; empty where there are none."""
    said = _scope(diagnosis)
    if diagnosis.own is None or not said:
        return said
    name = diagnosis.estimator
    shared = f"Losses and intervals are those of the decision stage common to all methods, fed with the estimates of {name}"
    return f"{said} {shared}; {name}'s own are listed separately."


def _scope(diagnosis: Diagnosis) -> str:
    if all(r.status == "unobservable" for r in diagnosis.rotors):
        return ""
    since = "Changes from take-off until control was lost" if diagnosis.story else "Changes since take-off"
    if all(r.from_takeoff == "not assessed" for r in diagnosis.rotors):
        more = ", and no loss in this flight" if diagnosis.whole_flight else ""
        needs = f": that needs healthy flights of the same build{more}" if more or BASELINE in diagnosis.advice else ""
        return f"{since}, with 95 % intervals. Damage present at take-off was not assessed{needs}."
    if diagnosis.whole_flight:
        return "Losses compared with the healthy flights of this build, with 95 % intervals."
    return (
        f"{since}, with 95 % intervals. Damage present at take-off is bounded by the spread of healthy vehicles of any build; "
        "healthy flights of this build show more."
    )
