"""From events to the answer: verdict, reason, headline, main event, state of every rotor, and recommended actions.

Every view - terminal, page, JSON - shows this answer and adds nothing, so that no two can contradict each other.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.answer import advice, fitness, health, ledger, story
from rotorwatch.answer.findings import Evidence, together
from rotorwatch.answer.fitness import GRAVE
from rotorwatch.answer.ledger import main_event
from rotorwatch.answer.wording import SCALE, candidates, grows, headline, interval, listed, percent, rotors, said, seconds, sentence, up_to
from rotorwatch.base.arrays import median
from rotorwatch.engine.events.decisions import MENTIONED, TOTAL_LOSS
from rotorwatch.flight.diagnosis import Event, Fitness, RotorState, StoryLine, Trend
from rotorwatch.flight.kinds import CONTACT, LOST, REPORTED

# Causes of a loss of control that clear the rotors, in words that follow "when".
NOT_A_ROTOR = {
    "disarmed": "the motors were stopped in flight",
    "knock": "something struck the vehicle",
    "controller": "the vehicle left its setpoint although it followed its commands: a sensor, an estimate or the pilot was wrong",
    "saturated": "they were at their limit",
    "power": "the power failed",
}
LEAST_S = 3.0  # of assessed flight, below which no rotor is called healthy
MOST_NOTICES = 3  # notices of no rotor in a headline: the first ones
ALIKE = 0.05  # bounds of rotors that differ by less point to none
LANDED_S = 1.5
REPEATS, REGULAR = 3, 0.15  # cut-outs of one rotor; share of their period by which each may differ
SHORT_S = 20.0  # of flight, below which tenths of a second are shown
UNASSESSED = "Damage present at take-off was not assessed."
INVISIBLE = (0.0, 1.0)
OFF_MIDDLE = "the centre of mass is offset"
AFTER_KNOCK = "Inspect the vehicle, then fly it again for at least 30 s."
UNKNOWING = ("inconclusive", "crashed")  # verdicts that say nothing of the rotors at the end
LOPSIDED = "may have been weak since take-off"  # compared with any build's vehicles: nothing else is known of the rotor


class Conclusion(NamedTuple):
    """verdict, reason, headline: as in the answer. main: index into events of the most important one, or None. rotors: their states.
    advice: recommended actions, sentences. events: those that are shown. story: of a loss of control (`story.narrate`). fit_to_fly, causes:
    as in the answer."""

    verdict: str
    reason: str
    headline: str
    main: int | None
    rotors: tuple[RotorState, ...]
    advice: tuple[str, ...]
    events: tuple[Event, ...]
    story: tuple[StoryLine, ...] = ()
    fit_to_fly: Fitness | None = None
    causes: tuple[Mapping[str, Any], ...] = ()


def conclude(seen: Evidence, doubts: Sequence[str] = ()) -> Conclusion:
    """The answer to a flight. doubts: reasons why the log may not show the real flight; with any, nothing is concluded from its outputs."""
    if doubts:
        seen = Evidence(
            ledger.believed(seen.events), seen.n, assessed_s=seen.assessed_s, places=seen.places, hops=seen.hops, settings=seen.settings
        )
        said_first = _with_reports(seen, None, [_not_assessed(doubts[0])])
        return _concluded(seen, "inconclusive", doubts[0], said_first, None, doubts)
    seen = seen._replace(events=tuple(e.stated() for e in seen.events), hidden=seen.hidden if seen.assessed_s >= LEAST_S else None)
    main = main_event(seen.events)
    verdict, reason = _verdict(seen, main)
    return _concluded(seen, verdict, reason, _headline(seen, verdict, main), main, ())


def _concluded(seen: Evidence, verdict, reason, first, main, doubts) -> Conclusion:
    states = tuple(_state(seen, k, verdict) for k in range(1, seen.n + 1))
    stays = main is not None and (seen.events[main].end_s is None or _landed(seen, seen.events[main].end_s))
    next_steps = advice.advise(
        verdict,
        seen.events,
        main,
        states,
        not seen.comparable,
        seen.places,
        doubts,
        stays,
        bool(seen.missing),
        _better_log(seen, main, verdict),
        seen.settings,
    )
    story_lines = story.narrate(seen.events, main, seen.n, seen.places, seen.hops, not doubts)
    fit, causes = fitness.assess(verdict, seen.events, states, next_steps), () if doubts else fitness.causes(seen, main)
    steps = next_steps.checks + next_steps.surer
    return Conclusion(verdict, reason, first, main, states, steps, tuple(seen.events), story_lines, fit, causes)


# Verdict and words


def _not_assessed(why: str) -> str:
    """The headline of a log without any assessed time: the reason, without its consequences."""
    return sentence(f"not assessed: {re.split('[:;] ', why)[0].rstrip('.')}.")


def _better_log(seen: Evidence, main: int | None, verdict: str) -> str:
    """Advice for a next log that shows what this one did not; empty where it showed enough."""
    if verdict != "inconclusive" or main is not None or seen.missing:
        return ""
    known = seen.hidden is not None and not seen.vague
    return AFTER_KNOCK if known else seen.unassessed.advice


def _bounded(seen: Evidence) -> bool:
    """True if the flight shows no fault, and bounds the loss of each rotor."""
    return seen.hidden is not None and seen.lost is None and not seen.missing


def _crashed(lost: Event) -> bool:
    """True if control was lost for good by a known cause that is no rotor."""
    known = lost.kind == LOST and lost.extra.get("cause") in NOT_A_ROTOR and not lost.alternatives
    return known and lost.end_s in (None, lost.extra.get("impact_s"))


def _verdict(seen: Evidence, main: int | None) -> tuple[str, str]:
    event = None if main is None else seen.events[main]
    whole = seen.compared
    if event is not None and not event.means.accuses:
        verdict = "ambiguous" if event.alternatives else "crashed" if _crashed(event) else "inconclusive"
        return verdict, f"{event.reason}. {_cleared(seen, event)}".strip()
    if event is not None and not event.alternatives:
        reason = _what_happened(seen, event)
        return "fault", reason + _others(seen, event) + _open(seen) + "."
    if whole and whole["verdict"] == "fault":
        return "fault", whole["reason"]
    if event is not None:
        return ("inconclusive" if _any_rotor(seen, event) else "ambiguous"), event.reason + _others(seen, event) + "."
    if whole and whole["verdict"] == "ambiguous":
        return "ambiguous", whole["reason"]
    if seen.hidden is None:
        why = _missing(seen) or seen.unassessed.why
        some = f"; {seen.assessed_s:.1f} s of flight could be assessed" if seen.assessed_s >= 0.1 else ""
        return "inconclusive", f"{why}{some}."
    if (spell := _lasting(seen)) is not None:
        return "ambiguous", f"{_as_if(spell, ())}: a loss masked by wind, or a change of wind."
    if seen.unexplained_evidence:
        spells = [f"{rotors(s.rotors)} from {seconds(s.onset_s)} to {seconds(s.end_s)}" for s in seen.unexplained_evidence]
        return "ambiguous", f"there is evidence against {listed(spells)} that no event explains."
    scope = f"and none from {seen.start} on, compared with its healthy flights" if whole else f"after {seen.start}"
    if seen.bound is not None:
        scope = f"and none more than {up_to(seen.bound)} from {seen.start} on, compared with healthy vehicles of any build"
    slow = "".join(f"; but {rotors([k])} {grows(t)}" for k, t in seen.growing)
    unseen = f"a loss of up to {_bound(seen)} could have gone undetected"
    flown = seen.flown_s
    of = f", of {flown:.{0 if flown > SHORT_S else 1}f} s in the air" if flown > 1.5 * seen.assessed_s else ""
    healthy = f"no rotor lost effectiveness in {seen.assessed_s:.0f} s of assessed flight{of}, {scope}{slow}; {unseen}"
    if seen.missing:
        return "inconclusive", f"{_missing(seen)}, so nothing can be assessed after that; until then {healthy}."
    if seen.vague:
        return "inconclusive", f"{healthy}, and more than {percent(seen.matters)} would matter: {seen.unassessed.why}."
    if seen.knocked_s is not None:
        return "inconclusive", f"{healthy}; damage from the contact at {seconds(seen.knocked_s)} could not be assessed."
    if slow:
        return "ambiguous", f"{healthy}; slowly changing wind or load would look the same."
    if seen.patchy:
        return "inconclusive", f"{healthy}; the rest of {flown:.0f} s in the air was not assessed: {seen.unassessed.why}."
    return "healthy", f"{healthy}."


def _any_rotor(seen: Evidence, event: Event) -> bool:
    """True if any single rotor may explain an event, which then does not indicate which one."""
    alone = {rotors_[0] for rotors_ in (event.rotors, *event.alternatives) if len(rotors_) == 1}
    return len(alone) == seen.n


def _missing(seen: Evidence) -> str:
    """Commands that the log lacks up to the end, in words; empty without any."""
    if not seen.missing:
        return ""
    who = sorted({rotor for gap in seen.missing for rotor in gap.rotors})
    return f"the log has no command for {rotors(who)} from {seconds(seen.missing_s)} on"


def _lasting(seen: Evidence) -> Event | None:
    """A lasting step of the size of a loss (`unseen.suspected`)."""
    return next((s for s in seen.unexplained_evidence if s.interval), None)


def _as_if(spell: Event, places: Sequence[str]) -> str:
    lost = [f"{rotors([r], places)} had lost {interval(*i)}" for r, i in zip(spell.rotors, spell.interval, strict=True)]
    return f"since {seconds(spell.onset_s)} the vehicle has flown as if {listed(lost, 'or')} of thrust"


def _what_happened(seen: Evidence, event: Event) -> str:
    return said(event.means.reason, event, until=_until(seen, event, " until")).removesuffix(": ")


def _cleared(seen: Evidence, lost: Event) -> str:
    """A sentence on the rotors, for a loss of control that no rotor caused."""
    if lost.kind != LOST:
        return ""
    when = min((t for t in lost.extra.get("worked_until_s", ()) if t is not None), default=None)
    until = "" if when is None else f" until {seconds(when)}"
    if lost.extra.get("cause") in NOT_A_ROTOR:
        return f"Not a rotor fault: all {seen.n} followed their commands{until}, when {NOT_A_ROTOR[lost.extra['cause']]}."
    if any(until is None for until in lost.extra.get("worked_until_s", ())) and not lost.rotors:
        return "No rotor fault was found, but the log does not show all of their commands."
    if lost.alternatives:
        return f"It may have been {candidates(replace(lost, rotors=lost.alternatives[0]), seen.places)}, or something else."
    return f"No rotor fault was found: as far as the log shows, all {seen.n} followed their commands{until}."


def _until(seen: Evidence, event: Event, word: str) -> str:
    if event.end_s is None:
        return ""
    return f"{word} {'the landing at ' if _landed(seen, event.end_s) else ''}{seconds(event.end_s)}"


def _others(seen: Evidence, main: Event) -> str:
    rest = [e for e in seen.events if e is not main and e.means.accuses]
    return f"; {len(rest)} more event{'s' if len(rest) > 1 else ''} in this flight" if rest else ""


def _open(seen: Evidence) -> str:
    who = sorted({r for spell in seen.unexplained_evidence for r in spell.rotors})
    return f"; it does not explain later evidence against {rotors(who)}" if who else ""


def _headline(seen: Evidence, verdict: str, main: int | None) -> str:
    """The headline for a pilot: one or two short sentences."""
    event = None if main is None else seen.events[main]
    if event is not None and not event.means.accuses:
        first = said(event.means.headline, event, seen.places, until=_until(seen, event, " until"), again="")
        before = [said(e.means.headline, e) for e in _notices_beside(seen, event)]
        return headline([*before, sentence(first), _cleared(seen, event)], len(before))
    if verdict == "inconclusive" and event is not None and event.means.accuses:
        return _with_reports(seen, event, [f"Something happened at {seconds(event.onset_s)} that any of the rotors could explain."])
    if verdict == "inconclusive":
        return _with_reports(seen, event, [_inconclusive(seen)])
    knocks = [seconds(e.onset_s) for e in seen.events if e.kind == CONTACT]
    first = _matter(seen, verdict, main) if verdict != "healthy" else "All rotors perform as on healthy flights."
    if verdict == "healthy" and (not seen.compared or seen.bound is not None):
        first = f"No rotor lost thrust after {seen.start}."
    if verdict == "healthy" and knocks:
        first = f"No rotor lost thrust in the {seen.assessed_s:.0f} s that were assessed."
    parts, caveats = [first], [UNASSESSED]
    if seen.lost is not None:
        parts.append(said(seen.lost.means.headline, seen.lost))
    if verdict == "healthy" and max(seen.unseen, seen.hidden_pair) >= dict(SCALE)["weak"]:
        parts.append(f"A loss of up to {_bound(seen)} could have gone undetected.")
        caveats.append(parts[-1])
    if event is not None or verdict != "ambiguous":
        parts += [sentence(f"{rotors([k], seen.places)} {grows(t)}.") for k, t in seen.growing]
    if verdict == "healthy" and not seen.compared:
        parts.append(UNASSESSED)
    elif verdict == "healthy" and seen.bound is not None:
        parts.append(_lopsided(seen))
        caveats.append(parts[-1])
    if knocks:  # after each the trim is learned again, with any damage included
        when = f"the contact at {knocks[0]}" if len(knocks) == 1 else f"{len(knocks)} contacts, the first at {knocks[0]},"
        parts.append(f"Damage from {when} was not assessed.")
    for rotor in sorted({r for e in seen.notices for r in e.rotors}):
        of_rotor = [e for e in seen.notices if rotor in e.rotors]
        notices = listed([said(e.means.headline, e) for e in of_rotor])
        parts.append(sentence(f"{rotors([rotor], seen.places)} {notices}, since {seconds(min(e.onset_s for e in of_rotor))}."))
    return _with_reports(seen, event, parts, caveats)


def _with_reports(seen: Evidence, main: Event | None, parts: Sequence[str], caveats: Sequence[str] = ()) -> str:
    """A headline of sentences, the main one first, with the notices that concern no rotor."""
    notices = _notices_beside(seen, main)
    leads = [e for e in notices if main is None and e.extra.get("trouble") in GRAVE]
    rest = [e for e in notices if e not in leads]
    beside = [[said(e.means.headline, e) for e in some] for some in (leads, rest)]
    return headline([*beside[0], *parts, *beside[1]], len(leads), caveats)


def _inconclusive(seen: Evidence) -> str:
    """Reason why a flight without a significant event shows too little."""
    if seen.missing and seen.hidden is not None:
        return f"No rotor lost thrust until {seconds(seen.missing_s)}. After that nothing can be said: {_missing(seen)}."
    if seen.hidden is None:
        return _not_assessed(_missing(seen) or seen.unassessed.why)
    if not seen.vague and seen.knocked_s is not None:
        return f"No loss was detected until the contact at {seconds(seen.knocked_s)}. Damage from it could not be assessed."
    if not seen.vague and seen.patchy:
        return f"No loss was detected in the {seen.assessed_s:.0f} s assessed of {seen.flown_s:.0f} s in the air: {seen.unassessed.why}."
    return f"No loss was detected, but a loss of up to {_bound(seen)} could have gone undetected: {seen.unassessed.why}."


def _notices_beside(seen: Evidence, main: Event | None) -> list[Event]:
    """Notices of no rotor for the headline, in order of time. Beside a loss of control that no rotor explains, only those that compete with
    its cause: later reports are its consequence, as is the report of a motor failure where a rotor is held responsible."""
    notices, lost = [e for e in seen.notices if not e.rotors], seen.lost
    if main is not None and main.means.accuses:
        notices = [e for e in notices if e.extra.get("trouble") != "motor"]
    if lost is not None:
        over = next((b for a, b in seen.hops if a <= lost.onset_s <= b), np.inf) + advice.AFTER_S
        notices = [e for e in notices if e.kind != REPORTED or not lost.onset_s <= e.onset_s <= over]
    if main is not None and main.kind == LOST:
        before = {cause["time_s"] for cause in main.extra.get("before", ())}
        notices = [e for e in seen.notices if e.kind == REPORTED and e.onset_s in before]
    return notices[:MOST_NOTICES]


def _bound(seen: Evidence) -> str:
    """Undetected loss of one rotor and, where larger, of each of two opposite ones, in words."""
    single = seen.unseen
    pair_differs = up_to(seen.hidden_pair) != up_to(single) and seen.hidden_pair > single
    pair = f", or {up_to(seen.hidden_pair)} of each of two opposite rotors," if pair_differs else ""
    return f"{up_to(single)} of one rotor{pair}"


def _lopsided(seen: Evidence) -> str:
    """Bound of a loss since take-off, by healthy vehicles of any build, and its rotor."""
    assert seen.compared
    bounds = seen.bounds
    most = up_to(max(bounds))
    if max(bounds) - min(bounds) < ALIKE:
        return f"Any loss already present at {seen.start} is at most {most} per rotor."
    who = rotors([int(np.argmax(bounds)) + 1], seen.places)
    return f"Any loss already present at {seen.start} is at most {most} in {who}, and less in the others."


def _matter(seen: Evidence, verdict: str, main: int | None) -> str:
    event = None if main is None else seen.events[main]
    whole = seen.compared
    if verdict == "fault" and (event is None or event.alternatives):
        assert whole
        shares = [f"{percent(whole['loss'][r - 1])} ({interval(*whole['interval'][r - 1])})" for r in whole["rotors"]]
        who = sentence(rotors(whole["rotors"], seen.places))
        than = "on healthy flights" if seen.whole else f"a rotor of any healthy vehicle, from {seen.start} on"
        return f"{who} gave less thrust than {than}: loss {', '.join(shares)}."
    if event is None and whole and whole["verdict"] == "ambiguous":
        return _from_the_start(seen, whole)
    if event is None and (spell := _lasting(seen)) is not None:
        return sentence(f"{_as_if(spell, seen.places)}, or the wind changed then.")
    if event is None and (growing := seen.growing):
        grown = listed([f"{rotors([k], seen.places)} {grows(t)}" for k, t in growing], "and")
        return sentence(f"{grown}, or wind or load changed at the same rate.")
    if event is None:
        return "There is evidence of a fault, but the log does not show which rotor."
    others = sum(e.means.accuses for e in seen.events) - 1
    again = f" (the first of {others + 1} events{_period(seen, event)})" if others and event is seen.events[0] else ""
    again = again or (f" (one of {others + 1} events)" if others else "")
    about = {"until": _until(seen, event, " until"), "again": again, "stopped": _stopped(seen, event)}
    return sentence(said(event.means.headline, event, seen.places, **about))


def _period(seen: Evidence, event: Event) -> str:
    """How cut-outs of one rotor repeat, in words: their period where they are regular, else the time in which they happened; empty where
    the events are others."""
    same = [e for e in seen.events if e.means.accuses]
    if len(same) < REPEATS or any((e.kind, e.rotors) != (event.kind, event.rotors) or e.end_s is None for e in same):
        return ""
    onsets = [e.onset_s for e in same]
    steps = np.diff(onsets)
    period = float(median(steps))
    regular = np.abs(steps - period).max() < REGULAR * period
    return f", one every {period:.1f} s" if regular else f" in {onsets[-1] - onsets[0]:.0f} s"


def _from_the_start(seen: Evidence, whole: Mapping[str, Any]) -> str:
    """Explanations of a whole flight's difference, the most likely first; rotors first where a healthy trim is one of them."""
    if whole.get("trim"):
        first, *rest = whole["rotors"], *(c["rotors"] for c in whole["causes"] if c["rotors"] and c["rotors"] != whole["rotors"])
        most = up_to(whole["interval"][first[0] - 1][1])
        lacks = f"{rotors(first, seen.places)} may have lacked up to {most} of its thrust from {seen.start} on"
        others = "".join(f", or {rotors(who, seen.places)}" for who in rest)
        return sentence(f"{lacks}{others}, or {OFF_MIDDLE}, or this is the vehicle's usual trim.")
    causes = sorted((c for c in whole["causes"] if c["probability"] > MENTIONED), key=lambda c: -c["probability"])
    if not any(c["rotors"] for c in causes):
        causes = [{"rotors": whole["rotors"]}, *causes]
    explanations = []
    for c in causes:
        who, lost = c["rotors"], [whole["loss"][r - 1] for r in c["rotors"]]
        size = f" {percent(lost[0])}" if len(who) == 1 and lost[0] > 0.0 else ""
        weak = f"{rotors(who, seen.places)} {'were' if len(who) > 1 else 'was'}{size} weak from {seen.start} on"
        explanations.append(weak if who else "the centre of mass has moved" if seen.whole else OFF_MIDDLE)
    if len(explanations) == 1:
        explanations.append("the centre of mass has moved" if seen.whole else OFF_MIDDLE)
    first, *rest = explanations
    return sentence(f"{first}, or {', or '.join(one.replace(f' from {seen.start} on', '') for one in rest)}.")


# Rotors


def _state(seen: Evidence, rotor: int, verdict: str) -> RotorState:
    """The rotor at the end of the assessed flight, by the first of these that applies: nothing could be assessed; a certain loss that
    lasts; damage from take-off on; a certain impairment; suspicion; healthy."""
    whole = seen.compared
    from_takeoff = _from_takeoff(whole, rotor, verdict, seen)

    def state(loss, bounds, status, note="", since=None):
        low, high = float(bounds[0]), float(bounds[1])
        clear = status not in ("unobservable", "suspect") or (status == "suspect" and _growth(seen, rotor) is not None)
        interval = since if since is not None and from_takeoff in ("not assessed", "bounded") else (low, high)
        # The steady state before control was lost does not hold for the rotor after it.
        trend = seen.trends[rotor - 1] if clear and seen.trends and seen.lost is None else None
        vague = status == "unobservable" or (status == "healthy" and seen.lost is not None)
        grade = health.UNGRADED if vague else health.grade(interval[0], interval[1], trend)
        place = seen.places[rotor - 1] if rotor <= len(seen.places) else ""
        return RotorState(rotor, float(loss), (low, high), status, place, since, from_takeoff, note, grade, trend)

    if verdict in UNKNOWING and not _bounded(seen):
        return state(0.0, INVISIBLE, "unobservable", _worked(seen, rotor))
    claims = [e for e in seen.losses if rotor in e.suspects]
    lasting = [e for e in claims if e.end_s is None]
    landed = [e for e in claims if _landed(seen, e.end_s)]
    maybe = [e for e in lasting if e.alternatives]
    if len(maybe) < len(lasting):
        e = [e for e in lasting if not e.alternatives][-1]
        loss, (low, high) = e.loss[e.rotors.index(rotor)], e.interval[e.rotors.index(rotor)]
        bounds = low, together([high, *(m.most(rotor) for m in maybe)])
        return state(loss, bounds, _broken(loss), f"weak since {seconds(e.onset_s)}", bounds)
    if whole and from_takeoff == "damaged":
        loss, than = whole["loss"][rotor - 1], "on healthy flights" if seen.whole else "in any healthy vehicle"
        return state(loss, whole["interval"][rotor - 1], _broken(loss), f"weaker than {than}")
    impaired = [e for e in seen.events if e.means.impairs and rotor in e.rotors and e.end_s is None and not e.alternatives]
    if impaired and seen.hidden is not None:
        bounds = 0.0, float(seen.hidden[rotor - 1])
        return state(0.0, bounds, "degraded", said(impaired[-1].means.now, impaired[-1]), bounds)
    suspicions = _suspicions(seen, rotor, maybe, landed, claims)
    known = [e.loss[e.rotors.index(rotor)] for e in (*maybe, *landed) if rotor in e.rotors]
    loss, high = known[-1] if known else 0.0, together([bound for _, bound in suspicions])
    if whole and from_takeoff == "suspect":
        suspicions.append(("may have been weaker than on healthy flights" if seen.whole else LOPSIDED, 1.0))
        loss, high = max(loss, whole["loss"][rotor - 1]), max(high, whole["interval"][rotor - 1][1])
    if suspicions:
        return state(loss, (0.0, max(high, loss)), "suspect", "; ".join(why for why, _ in suspicions))
    if seen.hidden is None or seen.missing:
        return state(0.0, INVISIBLE, "unobservable", _worked(seen, rotor))
    since, note = (0.0, float(seen.hidden[rotor - 1])), _past(seen, rotor, claims)
    if seen.knocked_s is not None and verdict in UNKNOWING:
        return state(0.0, INVISIBLE, "unobservable", note)
    if since[1] > seen.matters:
        return state(0.0, since, "unobservable", note, since)
    if whole:
        bounds = 0.0, together([since[1], float(whole["interval"][rotor - 1][1])])
        return state(whole["loss"][rotor - 1], bounds, "healthy", note, since)
    return state(0.0, since, "healthy", note, since)


def _from_takeoff(whole: Mapping[str, Any] | None, rotor: int, verdict: str, seen: Evidence) -> str:
    """The state of a rotor from take-off on, by the comparison with healthy flights or vehicles."""
    if not whole or (verdict in UNKNOWING and not _bounded(seen)):
        return "not assessed"
    # Those of healthy vehicles are only the explanations that are not excluded.
    likely = {r for c in whole.get("causes", ()) if c["probability"] > MENTIONED or not seen.whole for r in c["rotors"]}
    if whole["verdict"] == "fault" and rotor in whole["rotors"]:
        return "damaged"
    if whole["verdict"] != "healthy" and rotor in {*whole["rotors"], *likely}:
        return "suspect"
    return "healthy" if seen.whole else "bounded"


def _suspicions(seen: Evidence, rotor: int, maybe, landed, claims) -> list[tuple[str, float]]:
    """(reason, loss that it implies) of each suspicion against a rotor in flight."""
    suspicions = []
    for e in (*maybe, *landed):
        later = ", not assessed again after landing" if e in landed else ""
        suspicions.append((f"{said(e.means.now, e)}{later}", e.most(rotor)))
    for e in _other_faults(seen):
        who = e.rotors if e.means.now.unsure is None else e.suspects
        if rotor in who and e.means.ongoing(None if _landed(seen, e.end_s) else e.end_s):
            suspicions.append((said(e.means.now, e, other=listed([str(r) for r in e.rotors if r != rotor])), 1.0))
    for s in seen.unexplained_evidence:
        if rotor in s.rotors and s.interval:
            lost = interval(*s.interval[s.rotors.index(rotor)])
            suspicions.append((f"may have lost {lost} since {seconds(s.onset_s)}, or the wind changed then", s.most(rotor)))
        elif rotor in s.rotors:
            span = f"from {seconds(s.onset_s)} to {seconds(s.end_s)}"
            suspicions.append((f"evidence against it {span} that no event explains", 1.0))
    if (t := _growth(seen, rotor)) is not None:
        grown = min(1.0, t.interval[1] * (t.end_s - t.start_s) / 60.0)
        suspicions.append((f"{grows(t)}, or wind or load changed at the same rate", grown))
    if seen.lost is not None and not claims and any(rotor in who for who in seen.lost.alternatives):
        suspicions.append((said(seen.lost.means.now, seen.lost), 1.0))
    return suspicions


def _growth(seen: Evidence, rotor: int) -> Trend | None:
    """The growing loss of a rotor, in a flight in which no event accuses any."""
    if any(e.means.accuses for e in seen.events):
        return None
    return dict(seen.growing).get(rotor)


def _past(seen: Evidence, rotor: int, claims) -> str:
    """Events of the flight on a rotor that is healthy at the end, in words."""
    over = sorted((e for e in claims if e.end_s is not None), key=lambda e: bool(e.alternatives))
    notes = [said(e.means.past, e) for e in (*over, *_other_faults(seen)) if rotor in e.suspects]
    notes += [_worked(seen, rotor)]
    notes += [said(e.means.past, e) for e in seen.notices if rotor in e.rotors]
    return listed([note for note in notes if note])


def _other_faults(seen: Evidence) -> list[Event]:
    """Faults without a loss of a rotor's thrust."""
    return [e for e in seen.events if e.means.accuses and not e.means.weakens]


def _stopped(seen: Evidence, event: Event) -> str:
    """Outcome of a motor that lost step, in words: it stopped for good, or recovered."""
    after = (e for e in seen.losses if e.rotors == event.rotors and not e.alternatives and e.onset_s >= event.onset_s)
    last = next((e for e in after if e.end_s is None and e.loss and e.loss[0] > TOTAL_LOSS), None)
    return "" if last is None else f", and gave no thrust from {seconds(last.onset_s)} on"


def _broken(loss: float) -> str:
    return "failed" if loss > TOTAL_LOSS else "degraded"


def _worked(seen: Evidence, rotor: int) -> str:
    """Until when a rotor was seen to work, in a flight with a loss of control; from when commands are missing that this requires."""
    until = seen.lost.extra.get("worked_until_s", ()) if seen.lost is not None else ()
    known = rotor <= len(until) and until[rotor - 1] is not None
    notes = [f"seen to work until {seconds(until[rotor - 1])}"] if known else []
    commands_end = min((gap.start for gap in seen.missing if rotor in gap.rotors), default=np.inf)
    if np.isfinite(commands_end):
        notes.append(f"no command for it in the log since {seconds(commands_end)}")
    if seen.missing_s < commands_end:
        notes.append(f"not assessed since {seconds(seen.missing_s)}")
    return listed(notes)


def _landed(seen: Evidence, end_s: float | None) -> bool:
    """True if an event ended with a landing, before another take-off: its continuation was not assessed."""
    return end_s is not None and any(abs(end_s - down) < LANDED_S for _, down in seen.hops[:-1])
