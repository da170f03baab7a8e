"""Findings from the outputs on a vehicle's build, load and setup: margins to their limits, and unequal load of the rotors.

Each is one claim with its number, and implicates no rotor. It is measured after take-off, before the landing, and before the first event
that explains the outputs (`ledger.undisturbed`); only flights that hover are examined.

    at the limit    outputs within NEAR of their range's end, for LIMIT_S in all, and in one go or for a fifth of the flight
    heavy           hover, upright and level, takes HEAVY_SHARE of full thrust and more, for HEAVY_S
    apart           the balance w of the commands in hover (whole_flight.py) is SHOWS or more in the direction of one rotor, to a share
                    ALIKE of it, and its output is off by APART
    twisted         not apart, and the mean thrusts of both senses of rotation differ by TWISTED of full thrust
    exhausted       a rotor was lost, and the vehicle sank with an output at its limit because its rotors gave less than its weight
    given up        a rotor was lost, and an output whose moment its own would balance has since been at its lower end most of the time
    capped          outputs stood at one and the same largest value below the limit, for CAPPED_S in all, and came there from below

A load off the middle takes roll and pitch, a twisted mount yaw, one rotor all three alike; so a load on twisted mounts may look like a
rotor, and the claim says so. Both have to show in each half of the flight: later changes do not come from the build. The capability of the
remaining rotors is the largest thrust with no moment, and with no moment but yaw (witnesses/attainable.py).

Sources of the limits. ArduPilot's log analysis (Tools/LogAnalyzer): a throttle above 0.7 that does not climb is too little thrust, and
motors whose mean outputs differ by 150 us fail. Copter (crash_check.cpp): outputs at their limit and sinking for 1 s are a loss of thrust;
yaw is imbalanced where the integrator of its rate has three quarters of its limit, by default 0.38 of full yaw (0.1 when that check was
introduced, pull request 15744). Thrusts of the two senses that differ by all of full thrust are full yaw there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.answer.wording import listed, percent, rotors
from rotorwatch.base.arrays import median
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.tick_table import Ticks
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import AT_LIMIT, CAPPED, EXHAUSTED, GIVEN_UP, HEAVY, STANDS_APART, UNEVEN
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.attainable import margins
from rotorwatch.witnesses.healthy import whole_flight
from rotorwatch.witnesses.healthy.whole_flight import AFTER_TAKE_OFF_S, BEFORE_LANDING_S

SETUP = Source("setup", 15)
Hover = tuple[np.ndarray, np.ndarray]  # `whole_flight.steady`

NEAR = 0.05  # of the range
LIMIT_S = 5.0
BRIDGED_S, SAMPLE_S = 0.5, 1.0  # gaps below the limit that are bridged; longest time that a sample covers
HEAVY_SHARE, HEAVY_S = 0.8, 10.0
TWISTED = 0.18  # 150 us of the 800 between MOT_SPIN_MIN and MOT_SPIN_MAX, as thrust by a usual curve in hover
APART = 0.05  # of the range
SHOWS, ALIKE = 0.04, 0.25  # of w, and of that; healthy vehicles scatter by 0.04 in roll and pitch (population.py)
SAME = 0.05  # tolerance for columns of the effectiveness that are the negative of each other
LOST, LACKS, SINKS_S, SANK_M = 0.5, 0.05, 1.0, 2.0  # shares of a rotor's thrust and of the weight; s; m
USUAL_S = 10.0  # before a loss: the thrust of hover
GONE, IDLE, IDLE_SHARE, AFTER_S, IDLE_S = 0.8, 0.03, 0.5, 1.0, 3.0  # loss; of the range; of the time; s after the loss; s at least
SAME_VALUE, CAPPED_S, AT_ONCE = 1e-3, 2.0, 0.3  # of the range; s in all; longest share of the flight: more is an output that stands still
BELOW, RARER = 1e-2, 3.0  # of the range below a cap, where an output is so many times shorter; a swing stays longer below its top


def claims(flight: Flight, vehicle: Vehicle, table: Ticks, air: Spans, until: float, events: Sequence[Event]) -> tuple[Event, ...]:
    """The claims of the flights `air` ((start, end), ...) s, up to `until` s. table: its ticks; events: those of the rotors."""
    calm = tuple((a, min(b, until + BEFORE_LANDING_S)) for a, b in air if min(b - BEFORE_LANDING_S, until) > a + AFTER_TAKE_OFF_S)
    if not flight.has("motors"):
        return ()
    events_ = []
    if calm:
        hover = whole_flight.steady(flight, vehicle, calm)
        events_ += [
            *at_limit(flight, vehicle, calm),
            *capped(flight, vehicle, calm),
            *heavy(flight, vehicle, hover),
            *unequal(flight, vehicle, calm, hover),
        ]
    return (*events_, *exhausted(flight, vehicle, table, air, events), *given_up(flight, vehicle, events))


def _claim(kind: str, start: float, end: float, reason: str, extra: dict) -> Event:
    return Event(kind, (), start, end, None, (), (), 1.0, (), reason, extra, SETUP)


class _Outputs(NamedTuple):
    """time (m,) s; share (m, n) of the range from no to full thrust; lasts (m,): s that a sample covers."""

    time: np.ndarray
    share: np.ndarray
    lasts: np.ndarray


def _outputs(flight: Flight, vehicle: Vehicle, spans: Spans) -> _Outputs:
    motors, curve = flight["motors"], vehicle.curve
    share = (motors.values - curve.u_min) / (curve.u_max - curve.u_min)
    use = motors.whole & allocation.within(motors.time, spans)
    time = motors.time[use]
    lasts = np.minimum(np.diff(time, append=time[-1:]), SAMPLE_S)
    return _Outputs(time, share[use], lasts)


def _motors(who: Sequence[int]) -> str:
    return f"motor{'s' if len(who) > 1 else ''} {listed([str(k) for k in who])}"


def _spells(time: np.ndarray, there: np.ndarray) -> list[np.ndarray]:
    """The times (m,) s at which a condition holds, in spells; gaps shorter than BRIDGED_S do not separate them."""
    when = time[there]
    return np.split(when, np.flatnonzero(np.diff(when) > BRIDGED_S) + 1) if when.size else []


def at_limit(flight: Flight, vehicle: Vehicle, air: Spans) -> list[Event]:
    """Outputs near their limit, of the motors that were there longest."""
    spans = tuple((a + AFTER_TAKE_OFF_S, b - BEFORE_LANDING_S) for a, b in air)
    seen = _outputs(flight, vehicle, spans)
    there = seen.share >= 1.0 - NEAR
    each, flown = seen.lasts @ there, float(seen.lasts.sum())
    who = [int(k) + 1 for k in np.flatnonzero(each > 0.5 * each.max(initial=0.0))]
    if not who:
        return []
    mine = np.asarray(there[:, [k - 1 for k in who]].any(axis=1))
    total, when = float(seen.lasts[mine].sum()), seen.time[mine]
    longest = max(float(part[-1] - part[0]) for part in _spells(seen.time, mine))
    if total < LIMIT_S or (longest < LIMIT_S and total < whole_flight.LIMITED * flown):
        return []
    reason = (
        f"the output{'s' if len(who) > 1 else ''} of {_motors(who)} {'were' if len(who) > 1 else 'was'} within {percent(NEAR)} of "
        f"{'their' if len(who) > 1 else 'its'} limit for {total:.0f} s of {flown:.0f} s, up to {longest:.1f} s at a time"
    )
    extra = {"motors": who, "seconds": round(total, 1), "of_s": round(flown, 1), "longest_s": round(longest, 1)}
    return [_claim(AT_LIMIT, float(when[0]), float(when[-1]), reason, extra)]


def _most(flight: Flight, vehicle: Vehicle, at: np.ndarray) -> np.ndarray:
    """(k,) share of full thrust of outputs at their limit, with the battery's state at times `at`."""
    motors = flight["motors"]
    limit = replace(motors, values=np.full_like(motors.values, vehicle.curve.u_max, dtype=float))
    full = allocation.motor_thrusts(replace(flight, signals={**flight.signals, "motors": limit}), vehicle)
    known = full.valid.any(axis=1)
    return allocation.hold(full.time[known], full.values[known].max(axis=1), at, before=1.0)


def _assumed(vehicle: Vehicle) -> str:
    return "" if vehicle.curve.known else ", with an assumed thrust curve"


def heavy(flight: Flight, vehicle: Vehicle, hover: Hover) -> list[Event]:
    """A vehicle that hovers near full thrust. Without a logged velocity a climb looks the same, and there is no claim."""
    if not flight.has("velocity"):
        return []
    time, share = hover
    takes = share.mean(axis=1) / _most(flight, vehicle, time)
    much = takes >= HEAVY_SHARE
    if much.sum() * whole_flight.BLOCK_S < HEAVY_S:
        return []
    share, start, end = float(takes[much].mean()), float(time[much][0]), float(time[much][-1]) + whole_flight.BLOCK_S
    reason = (
        f"hover takes {percent(share)} of full thrust{_assumed(vehicle)}, for {much.sum() * whole_flight.BLOCK_S:.0f} s: no more than "
        f"{percent(1.0 - share)} is left to climb, to hold against wind or to compensate for a weak rotor"
    )
    return [_claim(HEAVY, start, end, reason, {"hover_share": round(share, 3)})]


def unequal(flight: Flight, vehicle: Vehicle, air: Spans, hover: Hover) -> list[Event]:
    """Rotors with unequal load since take-off: a single one, or else those of one sense of rotation."""
    hovering = whole_flight.features(flight, vehicle, air, hover)
    if not hovering.usable or max(hovering.limited) > whole_flight.LIMITED:
        return []
    start, B = air[0][0] + AFTER_TAKE_OFF_S, vehicle.effectiveness()
    halves = [median(half, axis=0) for half in np.array_split(hover[1], 2)]
    one, *both = (_one(B[:3] @ share / share.sum(), B) for share in (np.array(hovering.share), *halves))
    if one is None or any(half is None or half[:2] != one[:2] for half in both):
        return _twisted(flight, vehicle, np.array(hovering.share), halves, air, start)
    rotor, opposite, loss = one
    share, expo = hovering.share[rotor], vehicle.curve.expo
    # The rotor gives (1 - loss) of its command, which is what its place in the mixer needs.
    excess = _drive(expo, share) - _drive(expo, (1.0 - loss) * share)
    if abs(excess) < APART:
        return []
    side, other, than = ("above", "below", "weaker") if excess > 0.0 else ("below", "above", "stronger")
    too = "" if opposite is None else f", or that of motor {opposite + 1} {other} it,"
    reason = (
        f"since take-off the output of motor {rotor + 1} has been {percent(abs(excess))} of its range {side} what its place in the mixer "
        f"needs{too}{_assumed(vehicle)}: its ESC end points differ, or its motor or propeller is {than} than the others, unless the load "
        "is off-centre and the mounts are twisted"
    )
    motors = [rotor + 1] if opposite is None else [rotor + 1, opposite + 1]
    extra = {"motors": motors, "output": round(float(excess), 3), "thrust": round(loss, 3)}
    return [_claim(STANDS_APART, start, air[-1][1], reason, extra)]


def _one(w: np.ndarray, B: np.ndarray) -> tuple[int, int | None, float] | None:
    """(rotor, opposite, loss): the rotor, from 0, that alone explains the balance w (3,) of a vehicle of effectiveness B (4, n); the
    opposite one, if any, that explains it with the contrary sign; and the share of thrust that the rotor lacks, negative for an excess.
    None without such."""
    size = np.einsum("k,kn,n->n", w, B[:3], 1.0 / (B[:3] ** 2).sum(axis=0))
    left = np.abs(w[:, None] - size * B[:3]).max(axis=0)
    best = int(np.argmin(left / np.maximum(np.abs(size), 1e-9)))
    if abs(size[best]) < SHOWS or left[best] > ALIKE * abs(size[best]):
        return None
    contrary = np.flatnonzero(np.abs(B[:3] + B[:3, best, None]).max(axis=0) < SAME)
    if contrary.size and size[best] < 0.0:  # a weak rotor is likelier than a strong one
        best, contrary = int(contrary[0]), np.array([best])
    n, share = B.shape[1], (np.linalg.pinv(B) @ B)[best, best]
    lacks = n * size[best] / (1.0 - size[best])  # w = B e / (n + e), as in whole_flight.py
    return best, int(contrary[0]) if contrary.size else None, float(lacks / (1.0 + share * lacks))


def _drive(expo: float, thrust: float) -> float:
    return float(allocation.drive(expo, np.array(max(thrust, 0.0))))


def _twisted(flight: Flight, vehicle: Vehicle, share: np.ndarray, halves: Sequence[np.ndarray], air: Spans, start: float) -> list[Event]:
    """share (n,): of full thrust in hover; halves: the same in each half of the flight."""
    spin, lower = (np.array([getattr(r, name) for r in vehicle.rotors], float) for name in ("spin", "lower"))
    if not (spin > 0).any() or not (spin < 0).any() or abs(spin @ lower) > 0.0:
        return []  # the thrust of lower rotors is assumed, and all of them turn one way
    yaw, *both = (float(s[spin > 0].mean() - s[spin < 0].mean()) for s in (share, *halves))
    if min(np.sign(yaw) * one for one in (yaw, *both)) < TWISTED:
        return []
    heavier = np.sign(yaw) * spin > 0
    ratio = float(share[heavier].mean() / share[~heavier].mean() - 1.0)
    harder, others = ([int(k) + 1 for k in np.flatnonzero(side)] for side in (heavier, ~heavier))
    warns = flight.parameters.get("ATC_RAT_YAW_IMAX")
    limit = f", and ArduPilot itself warns from {percent(0.75 * warns)} on" if warns else ""
    reason = (
        f"since take-off {rotors(harder)} have given {percent(ratio)} more than {rotors(others).removeprefix('rotors ')}"
        f"{_assumed(vehicle)}: {percent(abs(yaw))} of full yaw is needed to hold heading{limit}"
    )
    extra = {"harder": harder, "more": round(ratio, 3), "yaw_share": round(abs(yaw), 3)}
    return [_claim(UNEVEN, start, air[-1][1], reason, extra)]


def exhausted(flight: Flight, vehicle: Vehicle, table: Ticks, air: Spans, events: Sequence[Event]) -> list[Event]:
    """Sinking of a vehicle of more than four rotors after the loss of one or more: at most one claim, of the longest fall."""
    n = len(vehicle.rotors)
    # A rotor that does not follow its command is excluded: it has not lost its thrust.
    gone = [e for e in events if e.means.weakens and max(e.loss, default=0.0) > LOST and "gives" not in e.extra]
    span = next(((a, b) for a, b in air if gone and a <= gone[0].onset_s < b), None)
    if span is None or n < 5 or not flight.has("velocity"):
        return []
    onset, end = gone[0].onset_s, min([span[1], *(e.end_s for e in gone if e.end_s is not None)])
    before = (table.time > onset - USUAL_S) & (table.time < onset) & table.thrust.any(axis=1) & table.valid[:, 3]
    after = (table.time > onset) & (table.time <= end) & table.thrust.any(axis=1)
    if not before.any() or not after.any():
        return []
    weight = n * float(median(table.thrust[before].mean(axis=1) / np.clip(table.load[before], 0.5, 2.0)))
    alive = _left(gone, n)
    time, given = table.time[after], (table.thrust[after] @ alive.T).max(axis=1) / weight
    seen, velocity = _outputs(flight, vehicle, ((onset, end),)), flight["velocity"]
    known = velocity.valid[:, 2]
    down = allocation.hold(velocity.time[known], velocity.values[known, 2], time)
    full = allocation.hold(seen.time, seen.share, time) >= 1.0 - NEAR
    lacks = full.any(axis=1) & (given < 1.0 - LACKS) & (down > 0.0)
    falls = _spells(time, lacks)
    if not falls:
        return []
    fall = max((np.isin(time, part) & lacks for part in falls), key=lambda one: down[one].sum())
    seconds, sank = float(fall.sum() * table.dt), float(down[fall].sum() * table.dt)
    if seconds < SINKS_S or sank < SANK_M:
        return []
    most = _most(flight, vehicle, time[fall][:1])[0] / float(median(table.hover[before]))
    lifts = [
        [margins(B, weight, free_yaw=yaw).lift for yaw in (False, True)]
        for B in vehicle.effectiveness()[[3, 0, 1, 2]] * (alive * most)[:, None]
    ]
    held, free = np.max(lifts, axis=0)
    if held > 1.0:
        who = [int(k) + 1 for k in np.flatnonzero(full[fall].mean(axis=0) > 0.5)]
        at = f" with the output of {_motors(who)} at its limit" if who else ""
        so = f"the mixer limited them to keep the vehicle level{at}"
    else:
        so = "that is enough only without yaw control" if free > 1.0 else "it could not have stayed up"
    gave = float(given[fall].mean())
    yawing = f", or {percent(free)} without yaw control" if percent(free) != percent(held) else ""
    reason = (
        f"without {', or '.join(rotors(one) for one in gone[0].explanations)} the vehicle sank by {sank:.0f} m in {seconds:.1f} s with an "
        f"output at its limit: the others gave {percent(gave)} of its weight and could carry {percent(held)} in balance{yawing}"
        f"{_assumed(vehicle)}; {so}"
    )
    numbers = {"given": gave, "sank_m": sank, "seconds": seconds, "lift": held, "lift_without_yaw": free}
    extra = {name: round(float(value), 3) for name, value in numbers.items()}
    return [_claim(EXHAUSTED, float(time[fall][0]), float(time[fall][-1]), reason, extra)]


def capped(flight: Flight, vehicle: Vehicle, air: Spans) -> list[Event]:
    """Outputs that stood at one largest value below their limit, of all motors that have it: at most one claim."""
    seen = _outputs(flight, vehicle, air)
    if not seen.time.size:
        return []
    top = seen.share.max(axis=0)
    highest, flown = float(top.max()), float(seen.lasts.sum())
    at = seen.share >= top - SAME_VALUE
    total, below = seen.lasts @ at, seen.lasts @ ((seen.share >= top - BELOW - SAME_VALUE) & ~at)
    who = [k for k in np.flatnonzero(np.abs(top - highest) <= SAME_VALUE) if max(CAPPED_S, RARER * below[k]) <= total[k] <= AT_ONCE * flown]
    if highest >= 1.0 - NEAR or not who:
        return []
    moves = [len(_spells(seen.time, at[:, k])) >= 2 for k in who]  # it comes from below, and returns
    if not all(moves):
        return []
    motors, mine = [int(k) + 1 for k in who], at[:, who].any(axis=1)
    seconds_ = float(seen.lasts[mine].sum())
    several = len(motors) > 1
    reason = (
        f"the output{'s' if several else ''} of {_motors(motors)} never exceeded {percent(highest)} of {'their' if several else 'its'} "
        f"range and stood there for {seconds_:.1f} s: {'they are' if several else 'it is'} capped"
    )
    extra = {"motors": motors, "seconds": round(seconds_, 1), "output": round(highest, 3)}
    return [_claim(CAPPED, float(seen.time[mine][0]), float(seen.time[mine][-1]), reason, extra)]


def given_up(flight: Flight, vehicle: Vehicle, events: Sequence[Event]) -> list[Event]:
    """Outputs at their lower end since a rotor was lost, which balance it: one claim for each certain loss."""
    B, found = vehicle.effectiveness(), []
    fell = [e.onset_s for e in events if e.means.wrong and not e.means.accuses]
    for e in events:
        if not (e.means.weakens and len(e.rotors) == 1 and not e.alternatives and e.loss[0] > GONE and "gives" not in e.extra):
            continue
        lost = e.rotors[0] - 1
        end = min([np.inf if e.end_s is None else e.end_s, *(t for t in fell if t > e.onset_s)])
        before, after = (_outputs(flight, vehicle, (span,)) for span in ((-np.inf, e.onset_s), (e.onset_s + AFTER_S, end)))
        if not before.time.size or float(after.lasts.sum()) < IDLE_S:
            continue
        idle = np.average(after.share <= IDLE, axis=0, weights=after.lasts)
        opposes = B[:2].T @ B[:2, lost] < 0.0
        opposes[lost] = False
        who = [int(k) + 1 for k in np.flatnonzero(opposes & (idle >= IDLE_SHARE) & (np.median(before.share, axis=0) > 2.0 * IDLE))]
        if not who:
            continue
        several = len(who) > 1
        reason = (
            f"the output{'s' if several else ''} of {_motors(who)} {'have' if several else 'has'} been at the lower end for "
            f"{percent(float(min(idle[k - 1] for k in who)))} of the time since {e.onset_s:.1f} s because rotor {lost + 1} gives nothing: "
            "the mixer gave up what its thrust would balance"
        )
        found.append(_claim(GIVEN_UP, e.onset_s, float(after.time[-1]), reason, {"motors": who}))
    return found


def _left(gone: Sequence[Event], n: int) -> np.ndarray:
    """(s, n) remaining effectiveness of each rotor by each explanation of the first loss, with all certain losses."""
    sets = gone[0].explanations
    alive = np.ones((len(sets), n))
    for row, who in zip(alive, sets, strict=True):
        row[[r - 1 for r in who]] = 1.0 - max(gone[0].loss)
    for e in gone:
        if not e.alternatives:
            alive[:, [r - 1 for r in e.rotors]] = 1.0 - np.array(e.loss)
    return alive
