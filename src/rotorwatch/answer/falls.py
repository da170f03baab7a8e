"""The events of a flight with those of its losses of control: the rotors to which the fall points, and the announced losses that it
explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rotorwatch.engine.events.decisions import CREDIBLE, SAME_S, SURE
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import CONTACT, LOSS, LOST, ORDER, OVERRIDE, REPORTED

if TYPE_CHECKING:
    from rotorwatch.witnesses.upset.explain import Explanation
    from rotorwatch.witnesses.upset.find import Assessed
    from rotorwatch.witnesses.upset.loss_of_control import LossOfControl
    from rotorwatch.witnesses.upset.spinning import FliesOn, Off

SPIN = Source("spin")  # of losses found in a vehicle that spins and flies on
OFF = 0.4  # the motion shows a rotor on or off: one that lost half of its thrust is nearer to off, one that lost 30 % to on
TOUCHED_S = 1.0  # from a blow in flight to the loss of control that it causes
# Time before control is lost within which the autopilot's reports compete as the cause; a low battery stays low.
REPORTED_S, LOW_S = 30.0, 300.0
SAME_ONSET_S = 0.4  # of an announcement: the ticks around it tell the onset better, later ones that of a total loss after a partial one
SOON_S = 0.1  # before an onset: its accuracy
EARLIER_S = 3.0  # a partial loss of the rotor that then stops
STOPPED_S = 1.0  # after that, within which the stop of the motors is logged


def events(found: Sequence[Assessed], known: Sequence[Event], n: int) -> tuple[Event, ...]:
    """The events `known` of a flight of n rotors with those of its losses of control.

    Announcements after control was lost, by a method that assumes hover, are replaced."""
    out = list(known)
    for upset in found:
        out = _merged(out, upset, n)
    out = [_with_reports(e, out) if e.kind == LOST else e for e in out]
    return tuple(sorted(out, key=lambda e: e.detected_s))


def _with_reports(lost: Event, events_: Sequence[Event]) -> Event:
    """A loss of control with the autopilot's reports before it. Whether a rotor is responsible rests on other evidence; a knock as the
    cause needs no report."""
    cause = lost.extra["cause"]
    before = [] if cause == "knock" else [e for e in events_ if e.kind == REPORTED and _competes(e, lost)]
    if not before:
        return lost
    quoted = [f"before that, at {e.onset_s:.1f} s, {e.reason}" for e in before]
    causes = [{"trouble": e.extra["trouble"], "time_s": e.onset_s} for e in before]
    return replace(lost, reason="; ".join((lost.reason, *quoted)), extra={**lost.extra, "before": causes})


def _competes(report: Event, lost: Event) -> bool:
    ahead, trouble = lost.onset_s - report.onset_s, report.extra["trouble"]
    if trouble == "stopped":
        return -STOPPED_S <= ahead <= STOPPED_S and lost.extra["cause"] == "disarmed"
    return 0.0 < ahead <= (LOW_S if trouble in ("battery", "power") else REPORTED_S)


def _weak(events_, left: LossOfControl) -> Event | None:
    """The largest loss that was known long before control was lost."""
    before = [
        e
        for e in events_
        if e.kind == LOSS and not e.alternatives and e.onset_s < left.onset - SAME_S
        and (e.end_s is None or e.end_s > left.onset)
    ]  # fmt: skip
    return max(before, key=lambda e: max(e.loss), default=None)


def _announced_near(events_, left: LossOfControl) -> Event | None:
    """The loss that was announced in flight as control was lost."""
    near = [e for e in events_ if e.kind == LOSS and abs(e.onset_s - left.onset) < SAME_S and e.detected_s <= left.lost]
    return near[0] if near else None


def _merged(events_: list[Event], assessed: Assessed, n: int) -> list[Event]:
    """The events with the loss of control and the losses of its rotors, less those that it explains."""
    left, window = assessed.left, assessed.window
    if assessed.spin is not None and assessed.spin.off:
        return _flown(events_, assessed, n)
    weak = _weak(events_, left)
    if weak is not None and assessed.cause in ("rotor", "saturated", "unknown", "controller"):
        since = f"{_who(weak.rotors)} had been weak since {weak.onset_s:.1f} s"
        assessed = assessed._replace(cause="rotor", found=(), evidence=(since,))
        return [*events_, _control_lost(assessed, n, weak.rotors, (), left.lost)]
    touched = any(e.kind == CONTACT and 0.0 <= assessed.onset - e.onset_s < TOUCHED_S for e in events_)
    if assessed.cause == "unknown" and touched:
        assessed = assessed._replace(cause="knock", evidence=("something had struck the vehicle just before",))
    announced = _announced_near(events_, left)
    cleared = assessed.found and assessed.found[0].kind == "healthy" and assessed.probability[0] > SURE
    if announced is not None and assessed.cause in ("controller", "saturated", "unknown") and not cleared:
        assessed = assessed._replace(cause="rotor", found=(), evidence=(announced.reason,))
        return [*events_, _control_lost(assessed, n, announced.rotors, announced.alternatives, left.lost)]
    decided = left.lost if window is None else float(window.time[-1])
    rotors = [(e, float(p)) for e, p in zip(assessed.found, assessed.probability) if e.kind == "rotor" and p >= CREDIBLE]
    whole = [p for e, p in zip(assessed.found, assessed.probability) if e.kind == "common" and p >= CREDIBLE]
    others = tuple((e.rotors[0] + 1,) for e, _ in rotors[1:]) + ((tuple(range(1, n + 1)),) if whole else ())
    rotor_probability = sum(p for _, p in rotors)
    # An explanation that is likelier than others and leaves motion that it does not explain accuses no rotor.
    doubted = assessed.cause == "unknown" and rotor_probability > 1.0 - SURE and bool(rotors) and rotors[0][0].fits
    accused = (assessed.cause == "rotor" and bool(rotors)) or doubted
    rotor = (rotors[0][0].rotors[0] + 1,) if accused else ()
    # Announcements before the departure stay, unless the departure shows another rotor.
    stands = -np.inf if accused or assessed.cause == ORDER else left.onset
    result, same = [], None
    for e in events_:
        late = e.onset_s > left.onset - SAME_S and e.kind in (LOSS, OVERRIDE) and bool(assessed.found)
        if late and e.kind == LOSS and e.rotors == rotor and same is None:
            same = e
        elif not late or e.detected_s < stands or (e.kind == OVERRIDE and e.onset_s <= left.lost):
            result.append(e)
    held = [e for e in result if e.kind == OVERRIDE and left.onset - SAME_S < e.onset_s <= left.lost]
    if held and assessed.cause not in ("rotor", ORDER):  # an output that overrides the mixer is the cause
        assessed = assessed._replace(cause="rotor", evidence=(held[0].reason,))
        return [*result, _control_lost(assessed._replace(found=()), n, held[0].rotors, (), decided)]
    if accused:
        best, p = rotors[0]
        sure = p > SURE and assessed.cause == "rotor" and best.low > 0.0  # a fault has a loss above 0
        others = () if sure else others or (tuple(range(1, n + 1)),)
        if same is None or others != same.alternatives:
            result.append(_loss(best, p, others, n, decided, assessed))
        else:  # announced already, from a few ticks after hover: a certain result from the fall prevails
            sizes = {"loss": (best.size,), "interval": ((best.low, best.high),)}
            result.append(replace(same, **sizes) if best.low > same.interval[0][1] else same)
        result.append(_control_lost(assessed, n, rotor, others, decided))
    elif assessed.cause == ORDER:
        others = tuple(
            tuple(r + 1 for r in e.rotors)
            for e, p in zip(assessed.found[1:], assessed.probability[1:])
            if e.kind == "order" and p >= CREDIBLE and assessed.probability[0] < SURE
        )
        result.append(_order(assessed.found[0], float(assessed.probability[0]), others, decided))
        result.append(_control_lost(assessed, n, tuple(r + 1 for r in assessed.found[0].rotors), others, decided))
    else:
        result.append(
            _control_lost(assessed, n, (), tuple((e.rotors[0] + 1,) for e, _ in rotors) if assessed.cause == "unknown" else (), decided)
        )
    return result


def _flown(events_: list[Event], assessed: Assessed, n: int) -> list[Event]:
    """The events of a vehicle that spins and flies on without rotors: the balance at any attitude and rate replaces what assumes hover,
    from the first loss on. An announcement of the same rotor stays, as the earlier one."""
    spin = assessed.spin
    assert spin is not None
    begun = min(o.onset for o in spin.off) - SAME_S
    left = list(spin.off)
    result, named = [], []
    for e in events_:
        if e.kind == CONTACT and begun + SAME_S - SOON_S < e.onset_s <= spin.until:
            continue  # a rotor that stops jerks the vehicle, and turning makes forces that no hover does
        if e.kind not in (LOSS, OVERRIDE) or (e.onset_s <= begun and not _first(e, left)):
            result.append(e)
        elif e.kind == LOSS and (off := _first(e, left)) is not None:
            left.remove(off)
            onset = off.onset if abs(off.onset - e.onset_s) < SAME_ONSET_S else e.onset_s
            named.append(replace(e, onset_s=onset, alternatives=(), interval=((e.interval[0][0], 1.0),), end_s=off.end))
    named += [_went_off(off) for off in left]
    first = min(named, key=lambda e: e.onset_s)
    assessed = assessed._replace(cause="rotor", found=(), onset=max(assessed.onset, first.onset_s), evidence=(first.reason,))
    return [*result, *named, _control_lost(assessed, n, first.rotors, (), assessed.left.lost)]


def _first(event: Event, off: Sequence[Off]) -> Off | None:
    """The rotor off that a loss has announced: the first time that it went off, and as it did, or before it stopped for good."""
    if event.kind != LOSS or event.alternatives or len(event.rotors) != 1:
        return None
    same = next((o for o in off if (o.rotor + 1,) == event.rotors), None)
    return same if same is not None and -EARLIER_S < event.onset_s - same.onset < SAME_S else None


def _went_off(off: Off) -> Event:
    rotor = off.rotor + 1
    reason = f"from {off.onset:.1f} s on force and torque on the spinning vehicle were those of the other rotors, without rotor {rotor}"
    return Event(
        LOSS, (rotor,), off.onset, off.detected, off.end, (1.0,), ((OFF, 1.0),), off.probability, (), reason,
        {"live": False, "loss_2s": [1.0]}, SPIN,
    )  # fmt: skip


def _who(rotors: Sequence[int]) -> str:
    return ("rotor " if len(rotors) == 1 else "rotors ") + " and ".join(map(str, rotors))


def _loss(best: Explanation, p: float, others, n: int, decided: float, assessed: Assessed) -> Event:
    rotor = best.rotors[0] + 1
    onset = min(best.onset, assessed.left.onset)
    how = f"as it would without {'the' if best.size > 0.5 else 'part of the'} thrust of rotor {rotor}"
    if best.gives:
        how = f"as if rotor {rotor} were stuck at {best.gives:.1f} times hover thrust"
    reason = f"from {onset:.1f} s on the vehicle turned {how}"
    if others:
        who = ", ".join("all rotors alike" if len(o) == n else "+".join(map(str, o)) for o in others)
        reason += f", but {who} may have failed instead"
    reason += "; found in hindsight from the motion up to the impact" if assessed.left.impact else "; found in hindsight"
    return Event(
        LOSS, (rotor,), onset, decided, None, (best.size,), ((best.low, best.high),), p, others, reason,
        {"live": False, "loss_2s": [best.size], **({"gives": round(best.gives, 2)} if best.gives else {})},
    )  # fmt: skip


def _order(best: Explanation, p: float, others, decided: float) -> Event:
    if best.kind == "yaw":
        reason = "the vehicle yawed against its commands from the first movement on: propellers or motors turn in the wrong direction"
        return Event(ORDER, (), best.onset, decided, None, (), (), p, others, reason, {"live": False, "yaw_reversed": True})
    i, j = (r + 1 for r in best.rotors)
    reason = f"from the first movement on the vehicle turned as if the outputs of motors {i} and {j} were swapped"
    if others:
        reason += ", but " + ", ".join("+".join(map(str, o)) for o in others) + " may be swapped instead"
    return Event(ORDER, (i, j), best.onset, decided, None, (), (), p, others, reason, {"live": False})


CAUSES = {
    "rotor": "a rotor lost its thrust",
    ORDER: "motors are connected in the wrong order",
    "disarmed": "the motors were stopped in flight",
    "knock": "something struck the vehicle",
    "controller": "the vehicle did what was commanded, and the commands were wrong",
    "saturated": "the rotors were at their limit",
    "power": "the power failed",
    "unknown": "the cause is unknown",
}


def _control_lost(assessed: Assessed, n: int, named, others, decided: float) -> Event:
    left = assessed.left
    fell = assessed.fell
    end = left.ground if fell and left.end is None else left.end
    worked = _worked(assessed, n, named, others, decided)
    spin = assessed.spin
    how = left.what if spin is None else f"turning {spin.turns:.0f} times a second"
    reason = f"the vehicle departed controlled flight at {assessed.onset:.1f} s, {how}: {CAUSES[assessed.cause]}"
    reason += "".join(f"; {disarmed}" for disarmed in assessed.evidence)
    if spin is not None:
        reason += f"; it flew on, spinning, from {spin.since:.1f} to {spin.until:.1f} s"
    if fell:
        reason += f"; it hit the ground at {left.ground:.1f} s"
    p = (
        float(sum(assessed.probability[k] for k, e in enumerate(assessed.found) if e.kind == "rotor"))
        if assessed.cause == "rotor" and assessed.found
        else 1.0
    )
    return Event(
        LOST, tuple(named), assessed.onset, left.lost, end, (), (), p, others, reason,
        {
            "cause": assessed.cause, "live": True, "worked_until_s": worked, "impact_s": left.ground if fell else None,
            "evidence": list(assessed.evidence), "how": how, **({} if spin is None else _spun(spin)),
        },
    )  # fmt: skip


def _spun(spin: FliesOn) -> dict[str, float]:
    """The fields of a spin in which the vehicle flew on."""
    return {"spins_from_s": spin.since, "spins_until_s": spin.until, "turns_per_s": round(spin.turns, 2)}


def _worked(assessed: Assessed, n: int, named, others, decided: float) -> list[float | None]:
    """Time until which each rotor was seen to work [s]; None where unknown."""
    until, known = _until(assessed, n, named, others, decided), assessed.commanded or (np.inf,) * n
    return [None if a is None or b is None else min(a, b) for a, b in zip(until, known)]


def _until(assessed: Assessed, n: int, named, others, decided: float) -> list[float | None]:
    """The same, of rotors with known commands."""
    suspects = {r for who in others for r in who}
    if not assessed.found:
        return [None if r in named or r in suspects else assessed.onset for r in range(1, n + 1)]
    if assessed.cause == ORDER:
        return [None if r in named else decided for r in range(1, n + 1)]
    if assessed.left.impact is not None and assessed.left.impact > assessed.onset:
        decided = min(decided, assessed.left.impact)
    until = decided if assessed.cause in ("rotor", "controller", "saturated") else assessed.onset
    start = assessed.found[0].onset if assessed.found[0].kind == "rotor" else assessed.onset
    return [start if r in named else assessed.onset if r in suspects else until for r in range(1, n + 1)]
