"""The sequence of a loss of control in order of time: the last normal state, the initiating event, the loss of control, its end, and other
notices, such as the autopilot's reports. It describes the first loss of control of a flight; a flight without one has no story."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.answer.wording import candidates, rotors, said, seconds, sentence
from rotorwatch.flight.diagnosis import Event, StoryLine
from rotorwatch.flight.kinds import LOST, Span, Weight

FIRST_S = 3.0  # after lift-off: the vehicle never flew normally, and its last normal state is on the ground
SOON_S = 0.1  # a tick of slow logs: closer times count as one
# Causes that clear the rotors: {who}: all of them; {when}: until when they were seen to work.
FOLLOWED = "{who} followed their commands until {when}"
CLEARED = {
    "disarmed": f"{FOLLOWED}, when the motors were disarmed in flight.",
    "knock": f"{FOLLOWED}, when something struck the vehicle.",
    "power": f"{FOLLOWED}, when the power failed.",
    "saturated": "At {onset} {who} were at their limit; as far as the log shows, they followed their commands until {when}.",
    "controller": "At {onset} the vehicle left its setpoint although, as far as the log shows, {who} followed their commands until "
    "{when}: a sensor, an estimate or the pilot was wrong.",
    "unknown": f"No rotor fault was found: as far as the log shows, {FOLLOWED}.",
}


def narrate(
    events: Sequence[Event],
    main: int | None,
    n: int,
    places: Sequence[str] = (),
    hops: Sequence[tuple[float, float]] = (),
    trusted: bool = True,
) -> tuple[StoryLine, ...]:
    """The story of a flight of n rotors; empty where control was not lost.

    events: of the answer; main: index of the one that matters, or None; places: `places.names`; hops: ((take-off, landing), ...) s.
    trusted: False where the log contradicts itself, and may not show what the rotors did."""
    upsets = [e for e in events if e.kind == LOST]
    if not upsets:
        return ()
    lost = upsets[0]
    first = initiating_event(events, main) if trusted else None
    began = lost.onset_s if first is None else min(first.onset_s, lost.onset_s)
    up = next((a for a, b in hops if a <= began <= b), None)
    if up is not None and began - up < FIRST_S:
        good = StoryLine(up, f"The vehicle lifted off at {seconds(up)}.")
    else:
        good = StoryLine(began, f"Until {seconds(began)} the vehicle flew as commanded.")
    out = [good]
    if first is not None:
        out.append(StoryLine(first.onset_s, _initiating_sentence(first, lost, places)))
    elif trusted:
        out.append(StoryLine(lost.onset_s, _no_rotor(lost, n, places)))
    end = _end(lost, upsets[1:], hops)
    when = lost.detected_s if lost.detected_s <= end.time_s else max(lost.onset_s, out[-1].time_s)
    notices = [e for e in events if e.means.weight is Weight.NOTICE and not e.rotors]
    beside = [StoryLine(e.onset_s, sentence(said(e.means.headline, e))) for e in notices]
    beside += _spin(lost, when, [e for e in events if e is not first], places)
    lines = (*out, StoryLine(when, _lost(lost, when, first, n)), *beside, end)
    return tuple(sorted(lines, key=lambda line: line.time_s))


def initiating_event(events: Sequence[Event], main: int | None) -> Event | None:
    """The event that started the sequence: the main one when it came before control was lost, else the first that lasted until then."""
    lost = next((e for e in events if e.kind == LOST), None)
    if lost is None:
        return None
    faults = [e for e in events if e.means.accuses and e.means.span is not Span.SPELLS]  # a momentary desync is over
    before = [e for e in faults if e.onset_s <= lost.detected_s]
    if main is not None and events[main] in before:
        return events[main]
    lasted = [e for e in before if e.end_s is None or e.end_s >= lost.onset_s]
    return min(lasted, key=lambda e: e.onset_s, default=None)


def _initiating_sentence(event: Event, lost: Event, places: Sequence[str]) -> str:
    over = f", until {seconds(event.end_s)}" if event.end_s is not None and event.end_s < lost.onset_s else ""
    return said(event.means.began, event, places, over=over)


def _no_rotor(lost: Event, n: int, places: Sequence[str]) -> str:
    """The sentence on the rotors where no event names one."""
    if lost.alternatives:
        return f"At {seconds(lost.onset_s)} {' or '.join(rotors(a, places) for a in lost.alternatives)} may have failed, or something else."
    if lost.rotors:
        return f"At {seconds(lost.onset_s)} {candidates(lost, places)} stopped following the command."
    return sentence(_cleared(lost, n))


def _cleared(lost: Event, n: int) -> str:
    until = [t for t in lost.extra.get("worked_until_s", ()) if t is not None]
    when = seconds(min(until, default=lost.onset_s))
    text = CLEARED.get(str(lost.extra.get("cause")), CLEARED["unknown"])
    return sentence(text.format(who=f"all {n} rotors", when=when, onset=seconds(lost.onset_s)))


def _lost(lost: Event, when: float, first: Event | None, n: int) -> str:
    how = str(lost.extra.get("how") or "")
    since = "" if when - lost.onset_s < SOON_S else f"; the departure began at {seconds(lost.onset_s)}"
    text = f"Control was lost at {seconds(when)}{f', {how}' if how else ''}{since}."
    named = frozenset() if first is None else first.suspects
    other = not named & lost.suspects
    if first is not None and lost.extra.get("cause") in CLEARED and other:
        text += f" {_cleared(lost, n)}"  # an earlier event is not the cause
    return text


def _spin(lost: Event, when: float, others: Sequence[Event], places: Sequence[str]) -> list[StoryLine]:
    """That it flew on spinning after control was lost at `when` [s], and what else it lost until the end of that."""
    since, until = lost.extra.get("spins_from_s"), lost.extra.get("spins_until_s")
    if since is None or until is None:
        return []
    flew = f"It flew on for {until - since:.0f} s, turning {lost.extra['turns_per_s']:.0f} times a second."
    later = [e for e in others if e.means.weakens and since - FIRST_S < e.onset_s <= until]
    return [StoryLine(max(since, when), flew), *(StoryLine(e.onset_s, said(e.means.began, e, places, over="")) for e in later)]


def _end(lost: Event, later: Sequence[Event], hops: Sequence[tuple[float, float]]) -> StoryLine:
    again = f" It was lost again at {seconds(later[0].onset_s)}." if later else ""
    impact = lost.extra.get("impact_s")
    if impact is not None:
        back = f" Control was regained at {seconds(lost.end_s)}." if lost.end_s not in (None, impact) else ""
        return StoryLine(impact, f"It hit the ground at {seconds(impact)}.{back}{again}")
    if lost.end_s is not None:
        return StoryLine(lost.end_s, f"Control was regained at {seconds(lost.end_s)}.{again}")
    last = max((b for _, b in hops), default=lost.detected_s)
    last = max(last, lost.detected_s, lost.extra.get("spins_until_s", -np.inf))
    return StoryLine(last, f"No impact was seen; control had not been regained by {seconds(last)}.{again}")
