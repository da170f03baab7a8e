"""The answer as terminal tables and HTML pages. No estimation here; the words that both use are below."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timedelta
from itertools import pairwise
from typing import Any

import numpy as np

from rotorwatch.answer.wording import (  # noqa: F401 - its words are the report's, too
    BASELINE,
    SCALE,
    VERDICTS,
    candidates,
    interval,
    listed,
    losses,
    percent,
    probability,
    rate,
    rotors,
    seconds,
    sentence,
    up_to,
)
from rotorwatch.flight.diagnosis import Diagnosis, Event, RotorState
from rotorwatch.flight.kinds import LOSS


def frame(diagnosis: Diagnosis) -> str:
    """'hexa X, 6 rotors', as far as the flight says."""
    facts = diagnosis.flight
    parts = [str(facts["frame"])] if facts.get("frame") else []
    if facts.get("rotors"):
        parts.append(f"{facts['rotors']} rotors")
    return ", ".join(parts) or "unknown frame"


def places(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Where each rotor is, in words; empty texts when unknown."""
    return tuple(r.place for r in diagnosis.rotors)


def who(event: Event, diagnosis: Diagnosis) -> str:
    """The rotors of an event with their places, and what else explains it; what it is about when no single rotor is."""
    return candidates(event, places(diagnosis))


def moment(diagnosis: Diagnosis, time: float | None) -> str:
    """A time of the log on the autopilot's own clock and in UTC, where the log has them: '95.21 s since boot, 14:03:27.2 UTC'."""
    boot, start = diagnosis.flight.get("boot_s"), diagnosis.flight.get("utc_start")
    parts = [f"{boot + time:.2f} s since boot"] if time is not None and boot else []
    if time is not None and start:
        parts.append(f"{_utc(start, time):%H:%M:%S.%f}"[:-5] + " UTC")
    return ", ".join(parts)


def day(diagnosis: Diagnosis) -> str:
    """When the log began: '2026-11-21 07:40:36 UTC'; empty when it does not say."""
    start = diagnosis.flight.get("utc_start")
    return f"{_utc(start, 0.0):%Y-%m-%d %H:%M:%S} UTC" if start else ""


def _utc(start: str, time: float) -> datetime:
    return datetime.fromisoformat(str(start).replace("Z", "+00:00")) + timedelta(seconds=time)


def rotor_loss(state: RotorState) -> str:
    """'37.0 %', '?' when the loss is not observable, 'none seen' where none was found but damage from take-off was not looked for."""
    if state.status == "unobservable" or (state.status == "suspect" and state.loss == 0.0):
        return "?"
    only_in_flight = state.status == "healthy" and state.from_takeoff in ("not judged", "bounded")
    return "none seen" if only_in_flight else percent(state.loss, 1)


def rotor_interval(state: RotorState) -> str:
    """The 95 % interval in words: of the loss, or of the change since take-off where no more than that was judged."""
    if state.status == "unobservable":
        return f"up to {up_to(state.since_takeoff[1])} unseen" if state.since_takeoff else ""
    if state.status == "healthy" and state.from_takeoff in ("not judged", "bounded") and state.since_takeoff:
        at_all = f" (take-off {up_to(state.interval[1])})" if state.from_takeoff == "bounded" else " in flight"
        return f"at most {up_to(state.since_takeoff[1])}{at_all}"
    return interval(*state.interval)


def rotors_title(diagnosis: Diagnosis) -> str:
    """What the rotor table shows."""
    if all(r.status == "unobservable" for r in diagnosis.rotors):
        if diagnosis.story and any(r.note for r in diagnosis.rotors):
            return "Rotors: last time each was seen working"
        return "Rotors: none could be assessed"
    if diagnosis.story:
        return "Rotors, up to the loss of control and after it"
    return "Rotors at the end of the assessed flight"


def scope(diagnosis: Diagnosis) -> str:
    """What the rotor table does not show, and whose its intervals are where a published method was used; empty when it shows all."""
    said = _scope(diagnosis)
    if diagnosis.own is None or not said:
        return said
    name = diagnosis.estimator
    shared = (
        f"Losses and intervals are those of the decision stage common to all methods, fed with the estimates of {name}"
    )
    return f"{said} {shared}; {name}'s own are listed separately."


def _scope(diagnosis: Diagnosis) -> str:
    if all(r.status == "unobservable" for r in diagnosis.rotors):
        return ""
    since = "Changes from take-off until control was lost" if diagnosis.story else "Changes since take-off"
    if all(r.from_takeoff == "not judged" for r in diagnosis.rotors):
        more = ", and no loss in this flight" if diagnosis.whole_flight else ""
        needs = f": that needs healthy flights of the same build{more}" if more or BASELINE in diagnosis.advice else ""
        return f"{since}, with 95 % intervals. Damage present at take-off was not assessed{needs}."
    if diagnosis.whole_flight:
        return "Losses compared with the healthy flights of this build, with 95 % intervals."
    return (
        f"{since}, with 95 % intervals. Damage present at take-off is bounded by the spread of healthy vehicles of any build; "
        "healthy flights of this build show more."
    )


def health(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]]:
    """The grade and the trend of every rotor, in words: (rotor, where, grade, trend); empty where nothing was judged or control
    was lost."""
    if all(r.status == "unobservable" for r in diagnosis.rotors) or diagnosis.story:
        return []  # grades and trends of a flight that ended out of control would be of the time before
    rows = [(str(r.rotor), r.place, grade(r), _trend(r)) for r in diagnosis.rotors]
    return rows if any(grade or trend for _, _, grade, trend in rows) else []


def grade(state: RotorState) -> str:
    """A rotor's grade in words: 'worn', 'at most worn', 'weak or critical'; empty where it may be anything."""
    least, _, most = state.grade.partition(" to ")
    if least == "not judged":
        return ""
    return least if not most else f"at most {most}" if least == SCALE[0][0] else f"{least} or {most}"


def health_line(diagnosis: Diagnosis) -> str:
    """The rotors whose loss grows or shrinks, a sentence; empty where none does."""
    return " ".join(
        f"Rotor {r.rotor}: {_trend(r)}."
        for r in diagnosis.rotors
        if r.trend and r.trend.word in ("growing", "shrinking")
    )


def _trend(state: RotorState) -> str:
    """Empty where nothing is known: a trend that may be anything within VAGUE says nothing."""
    t = state.trend
    if t is None or (t.word in ("no trend", "unclear") and max(abs(t.interval[0]), abs(t.interval[1])) > VAGUE):
        return ""
    if t.word in ("growing", "shrinking"):
        return f"{t.word}: {rate(t.per_minute)} a minute ({rate(t.interval[0])[:-2]} to {rate(t.interval[1])})"
    return f"{t.word} (within {rate(max(abs(t.interval[0]), abs(t.interval[1])))} a minute)"


def health_scale(diagnosis: Diagnosis) -> str:
    """What the grades mean, and of which part of the flight the trends are."""
    steps = [f"{name} below {percent(least)}" for (name, _), (_, least) in pairwise(SCALE)]
    spans = [(r.trend.start_s, r.trend.end_s) for r in diagnosis.rotors if r.trend]
    start, end = map(seconds, min(spans, default=(None, None)))
    of = f" Trends: growth of the loss from {start} to {end}, 95 % intervals." if spans else ""
    return f"Grades of the loss: {', '.join(steps)}, else {SCALE[-1][0]}.{of}"


APART = ("history", "loss_2s", "size", "unit", "own_loss", "own_interval", "own_at_s")
"""Of an event's fields, those that have a row of their own, or none."""


def event_rows(event: Event, diagnosis: Diagnosis) -> dict[str, str]:
    """Label -> text of an event's fields, in the order of importance; only fields that it has."""
    lasts = event.end_s is None and event.means.lasts
    later = event.detected_s - event.onset_s
    own = event.extra.get("own_loss", ())
    rows = {
        "since": seconds(event.onset_s),
        "clock": moment(diagnosis, event.onset_s),
        "announced": f"{seconds(event.detected_s)} ({later:.2f} s later)",
        "until": "it lasts" if lasts else seconds(event.end_s) if event.end_s is not None else "",
        "loss (95 % interval)": losses(event),
        "estimate 2 s later": ", ".join(percent(v) for v in event.extra.get("loss_2s", ())),
        f"{diagnosis.estimator}'s own estimate": "; ".join(
            f"{percent(loss)} ({interval(*bounds)})" for loss, bounds in zip(own, event.extra.get("own_interval", ()))
        )
        + (f" at {seconds(event.extra['own_at_s'])}" if own else ""),
        "how sure": probability(event.probability),
        "size": size(event),
    }
    rest = {k: v for k, v in event.extra.items() if k not in APART}
    return {k: v for k, v in rows.items() if v} | {words(str(k)): plain(v) for k, v in rest.items()}


def size(event: Event) -> str:
    """How hard a contact was, '3.2 g'; how often a motor lost step, '7 times'."""
    if "count" in event.extra:
        return f"{event.extra['count']} time{'' if event.extra['count'] == 1 else 's'}"
    value = event.extra.get("size")
    return f"{value:.2g} {event.extra.get('unit', '')}".strip() if value is not None else ""


def common_mode(diagnosis: Diagnosis) -> str:
    """What all rotors share, as a sentence; empty when it was not judged."""
    facts = diagnosis.common_mode
    shift = facts.get("thrust_shift")
    if shift is None:
        return plain(facts) if facts else ""
    count = max(1, len(diagnosis.rotors))
    share, low, high = (float(x) / count for x in (shift, *facts.get("interval", (shift, shift))))
    within = max(abs(low), abs(high))
    if low <= 0.0 <= high or within < SMALL_SHIFT:
        if within > VARIED:
            return "The total thrust varied too much in this flight to compare its end with its beginning."
        same = "The total commanded thrust was the same at the end as at the beginning"
        return f"{same}, within {percent(max(within, SMALL_SHIFT))}."
    more, why = "less", "a lighter vehicle, denser air or a fresher battery"
    if share > 0:
        more, why = "more", "a weaker battery, more weight, thinner air, or a loss common to all rotors"
    return (
        f"For the same motion {percent(abs(share))} {more} total thrust was commanded at the end than at the beginning "
        f"(95 % interval {percent(min(abs(low), abs(high)))} to {percent(within)}): {why}. This is not a fault of a single rotor."
    )


SMALL_SHIFT = 0.02
VAGUE = 0.1  # a minute: a loss that may grow by more is not known to stay
VARIED = 0.2  # share of the thrust from which "the same" would mean nothing


def whole_flight(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """The comparison with healthy flights, as (name, sentence) rows; empty without one."""
    facts = diagnosis.whole_flight
    if not facts:
        return []
    count, share = facts.get("flights"), float(np.expm1(facts.get("common") or 0.0))
    verdict = VERDICTS.get(str(facts.get("verdict")), plain(facts.get("verdict"))).lower()
    likely = [c for c in facts.get("causes") or () if c.get("probability", 0) >= 0.05]
    rows = {
        "answer": f"{verdict}: {facts.get('reason', '')}",
        "compared with": "" if count is None else f"{count} healthy flight{'s' if count != 1 else ''} of this build",
        "what explains the difference": "; ".join(
            f"{cause(c, diagnosis)} {probability(float(c['probability']))}" for c in likely
        ),
    }
    if facts.get("common") is not None and facts.get("verdict") != "inconclusive":
        rows["all rotors together"] = (
            f"{percent(abs(share))} {'more' if share > 0 else 'less'} command than on the healthy flights (battery, payload and air "
            "density also change it)"
        )
    return [(name, text) for name, text in rows.items() if text]


def cause(facts: Mapping[str, Any], diagnosis: Diagnosis) -> str:
    """'rotor 3 (front left)', 'a shifted centre of mass'."""
    if facts.get("rotors"):
        return rotors(facts["rotors"], places(diagnosis))
    return f"a shifted {words(str(facts.get('kind', '')))}"


def messages(diagnosis: Diagnosis) -> list[tuple[float, str, str]]:
    """Modes, errors and texts of the autopilot: (time s, kind, text), empty without a trace."""
    return list(diagnosis.trace.messages) if diagnosis.trace is not None else []


def comparison(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]]:
    """Detections by method and why: our events among the other checks' findings, in time order. Empty without any."""
    method = "rotorwatch" if diagnosis.estimator == "default" else diagnosis.estimator
    rows = [
        (method if e.kind == LOSS else "rotorwatch", candidates(e), e.detected_s, e.means.noun)
        for e in diagnosis.events
    ]
    for row in diagnosis.comparison:
        named = rotors((row["rotor"],) if row.get("rotor") else ())
        rows.append((str(row.get("detector", "")), named, row["time_s"], row.get("reason", "")))
    found = [(who, what, seconds(at), str(why)) for who, what, at, why in sorted(rows, key=lambda row: row[2])]
    if diagnosis.events and not diagnosis.comparison:
        found.append(_other_checks(str(diagnosis.flight.get("autopilot") or "")))
    return found


def _other_checks(autopilot: str) -> tuple[str, str, str, str]:
    """The row of other checks that found nothing, or that there is none: an autopilot's checks run on its own logs alone."""
    from rotorwatch import detectors

    names = ", ".join(module.name for module in detectors.for_autopilot(autopilot))
    if names:
        return names, "nothing", seconds(None), "as far as this log allows"
    why = f"no built-in check of {autopilot or 'this autopilot'} is available here"
    return "other checks", "none made", seconds(None), why


def words(key: str) -> str:
    """'detected_s' -> 'detected', 'high_current' -> 'high current'."""
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
