"""What people read: terminal tables and HTML pages. No estimation here; both say the same words, which are below."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rotorwatch.diagnosis import Diagnosis, Event

KINDS = {
    "loss_of_effectiveness": "loss of effectiveness",
    "output_override": "output overridden",
    "common_mode": "common mode",
    "torque_bias": "torque bias",
}
VERDICTS = {"healthy": "Healthy", "fault": "Fault found", "ambiguous": "Ambiguous", "inconclusive": "Inconclusive"}


def percent(share: float, digits: int = 0) -> str:
    """0.374 -> '37 %'. Never '-0 %'."""
    text = f"{100 * share:.{digits}f}"
    return f"{text.lstrip('-') if float(text) == 0 else text} %"


def interval(low: float, high: float) -> str:
    """A 95 % interval of shares: '33–41 %'."""
    return f"{percent(low)[:-2]}–{percent(high)}"


def probability(value: float) -> str:
    """'97 %', but never a certainty that was rounded up: '> 99.9 %'."""
    return "> 99.9 %" if value > 0.999 else percent(value, 1 if value > 0.985 else 0)


def seconds(time: float | None) -> str:
    """'41.2 s'; an event that lasts has no end: '–'."""
    return "–" if time is None else f"{time:.2f} s" if abs(time) < 1000 else f"{time:.1f} s"


def rotors(numbers: Iterable[int]) -> str:
    """(3,) -> 'rotor 3', (1, 2, 4) -> 'rotors 1, 2 and 4', () -> 'no rotor'."""
    names = [str(n) for n in numbers]
    if not names:
        return "no rotor"
    if len(names) == 1:
        return f"rotor {names[0]}"
    return f"rotors {', '.join(names[:-1])} and {names[-1]}"


def candidates(event: Event) -> str:
    """The rotors of an event with what else explains the data: 'rotors 1 and 2, or rotors 3 and 4'."""
    sets = [event.rotors, *(a for a in event.alternatives if tuple(a) != tuple(event.rotors))]
    return ", or ".join(rotors(s) for s in sets)


def losses(event: Event) -> str:
    """'37 % (33–41 %)', one per rotor, in the order of the rotors."""
    return ", ".join(f"{percent(v)} ({interval(*i)})" for v, i in zip(event.loss, event.interval, strict=False))


def sentence(text: str) -> str:
    """With a capital at the beginning."""
    return text[:1].upper() + text[1:]


def kind(event: Event) -> str:
    """The event's kind in words; an unknown one as it is."""
    return KINDS.get(event.kind, event.kind.replace("_", " "))


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in one short sentence a pilot understands; `Diagnosis.reason` says why."""
    faults = [e for e in diagnosis.events if e.kind == "loss_of_effectiveness"]
    stuck = [e for e in diagnosis.events if e.kind == "output_override"]
    if diagnosis.verdict == "healthy":
        return "All rotors pull their weight."
    if diagnosis.verdict == "inconclusive":
        return "This log cannot say."
    if diagnosis.verdict == "ambiguous":
        if faults:
            return f"Something lost thrust at {seconds(faults[0].onset_s)}: {candidates(faults[0])}."
        return "Something is wrong, but the log cannot say which rotor."
    if faults:
        worst = max(faults, key=lambda e: max(e.loss, default=0.0))
        again = f" ({len(faults)} events)" if len(faults) > 1 else ""
        until = f" until {seconds(worst.end_s)}" if worst.end_s is not None else ""
        who, when = sentence(rotors(worst.rotors)), f"{seconds(worst.onset_s)}{until}{again}"
        return f"{who} lost {losses(worst)} of thrust at {when}."
    if stuck:
        who = rotors(stuck[0].rotors)
        return f"The output of {who} stopped following the mixer at {seconds(stuck[0].onset_s)}."
    low = [r for r in diagnosis.rotors if r.status in ("degraded", "failed")]
    if low:
        who = sentence(rotors(r.rotor for r in low))
        detail = ", ".join(f"{percent(r.loss)} ({interval(*r.interval)})" for r in low)
        return f"{who} pulled less than on healthy flights: loss {detail}."
    return "A fault was found."


def frame(diagnosis: Diagnosis) -> str:
    """'hexa X, 6 rotors', as far as the flight says."""
    facts = diagnosis.flight
    parts = [str(facts["frame"])] if facts.get("frame") else []
    if facts.get("rotors"):
        parts.append(f"{facts['rotors']} rotors")
    return ", ".join(parts) or "unknown frame"


def comparison(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]]:
    """Who found what, when and why: our events among the other checks' findings, in time order. Empty without any."""
    ours = [
        ("rotorwatch", candidates(e) if e.rotors else "no single rotor", e.detected_s, kind(e))
        for e in diagnosis.events
    ]
    theirs = [
        (
            str(row.get("detector", "")),
            rotors((row["rotor"],) if row.get("rotor") else ()),
            row["time_s"],
            row.get("reason", ""),
        )
        for row in diagnosis.comparison
    ]
    rows = [(who, what, seconds(at), str(why)) for who, what, at, why in sorted(ours + theirs, key=lambda row: row[2])]
    if ours and not theirs:
        rows.append(_other_checks(str(diagnosis.flight.get("autopilot") or "")))
    return rows


def _other_checks(autopilot: str) -> tuple[str, str, str, str]:
    """The row that says which other checks found nothing, or that there is none: an autopilot's checks run on its own logs alone."""
    from rotorwatch import detectors

    names = ", ".join(module.name for module in detectors.of(autopilot))
    if names:
        return names, "nothing", seconds(None), "as far as this log lets it run"
    return (
        "other checks",
        "none made",
        seconds(None),
        f"no check of {autopilot or 'this autopilot'} itself is known here",
    )


def words(key: str) -> str:
    """'detected_s' -> 'detected', 'torque_bias' -> 'torque bias'."""
    return key.removesuffix("_s").replace("_", " ")


def plain(value: Any) -> str:
    """A value of a free-form part of the answer, short enough to read."""
    if isinstance(value, Mapping):
        return ", ".join(f"{words(str(k))} {plain(v)}" for k, v in value.items())
    if isinstance(value, str) or value is None or isinstance(value, bool):
        return {None: "–", True: "yes", False: "no"}.get(value, str(value))
    if hasattr(value, "__iter__"):
        return ", ".join(plain(v) for v in value)
    return f"{value:.4g}"
