"""The losses of control of a flight, their causes, and the rotors that may be responsible; `answer/falls.py` makes events of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.base.physics import G0
from rotorwatch.engine.events.decisions import CREDIBLE, SURE
from rotorwatch.engine.intake import contact
from rotorwatch.engine.intake.airborne import LEVER_M
from rotorwatch.engine.motion import allocation, tick_table
from rotorwatch.engine.motion.knocks import LEAST_GAIN
from rotorwatch.engine.motion.tick_table import Sensed
from rotorwatch.flight import Flight
from rotorwatch.flight.kinds import ORDER
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses import battery
from rotorwatch.witnesses.upset import loss_of_control, spinning
from rotorwatch.witnesses.upset.balance import INERTIA, Offset, Window
from rotorwatch.witnesses.upset.explain import Explanation, explain
from rotorwatch.witnesses.upset.loss_of_control import HIT_S, LossOfControl, held, thrust_axis
from rotorwatch.witnesses.upset.spinning import BEFORE_S, FliesOn

AFTER_S = 3.0  # of the upset that are used, at most, with BEFORE_S
EARLIER_S, LATER_S = 0.7, 0.3  # around its onset, in which a cause may have begun
SHOWS_S = 0.5  # before control is lost: later onsets are no cause
CALM_S = 0.4  # of controlled flight before, to estimate the offset of the torques
CALM_SD, UNKNOWN_SD = 0.1, 0.15
FIRST_S = 3.0  # after lift-off: a fault that shows now was present on the ground
# Hover thrusts: a vehicle on the ground is held or pushed while no rotor gives more. To tip it about its gear, two rotors have to lift its
# weight by twice the lever of its centre of mass, or more.
TIPS = 0.5
STIRS = 2.0, 0.2  # rad/s^2, rad/s: the vehicle moves
LIES = 0.15, 1.5  # rad/s, rad/s^2: below both for three ticks, a vehicle that has turned over lies on the ground
STOPS_S, TURNED_OVER = 0.5, 1.0  # s within which the ground stops it; rad/s that it stops
PINNED = 3.0  # rad/s: the ranges of gyros end above
MOST_TICKS = 60
HOVER_PARAMETERS = ("MOT_THST_HOVER", "MPC_THR_HOVER")
USUAL_HOVER = 0.35

TURNED = 1.4  # as FITS, of torques: the rotors turned the vehicle as commanded
STRAYS, STRAYS_THRUST = 3.0, 1.5  # standard deviations of torque and of thrust: the motion deviates from the commands
JOINS_S = 0.5  # a departure that began earlier in the residuals is the same
KNOCK_S = 0.3
# Over which lift is averaged, and the time before that it is compared with [s]; g by which air changes it at most so soon, as
# engine/intake/contact.py says.
PUSH_S, STEADY_S, PUSHES = 0.06, 0.5, 0.2
DISARMED_S = 1.0
# m/s^2, standard deviation on one axis: beyond, ArduPilot's and PX4's guides call vibration a cause of failing estimates. A broken
# propeller shakes a vehicle so, and the torques of a balance that is blurred by it fit everything.
SHAKES, LEAST_FORCES = 30.0, 10
UNSAID = "the battery voltage fell, and without a logged current it is not clear whether as cause or as effect"
LIMIT, LIMIT_SHARE = 0.97, 0.5  # of full thrust; of the last second before the onset in which an output was there
LEVEL_DEG = 40.0
TRIM = 0.1  # arm lengths: healthy vehicles are commanded less of roll and pitch in calm flight (witnesses/healthy/population.py, 95 %)


class Assessed(NamedTuple):
    """A loss of control with its cause. explanations with their probabilities, () where the log shows too little; window; onset [s];
    evidence: sentences; commanded: time up to which the log holds commands of each rotor, infinite where up to the onset, None where never
    [s]; spin: in which the vehicle flies on, or None."""

    left: LossOfControl
    cause: str
    found: tuple[Explanation, ...]
    probability: np.ndarray
    window: Window | None
    onset: float
    evidence: tuple[str, ...]
    commanded: tuple[float | None, ...] = ()
    spin: FliesOn | None = None

    @property
    def fell(self) -> bool:
        """True if the loss of control lasted until the vehicle hit the ground."""
        return self.left.ground is not None and self.left.ground - self.onset > HIT_S


def assessed(flight: Flight, vehicle: Vehicle, air, progress: Callable[[float], object] | None = None) -> tuple[Assessed, ...]:
    """Every loss of control of a flight with its cause. air: intervals ((start, end), ...) s in the air. progress: called with the finished
    share, 0..1."""
    verdicts = (assess(flight, vehicle, air, left) for left in loss_of_control.find(flight, air, progress))
    return tuple(verdict._replace(commanded=_commanded(flight, verdict.onset)) for verdict in verdicts)


def _commanded(flight: Flight, onset: float) -> tuple[float | None, ...]:
    """`Assessed.commanded`."""
    if not flight.has("motors"):
        return ()
    motors = flight["motors"].between(-np.inf, onset)
    known = [motors.time[column] for column in motors.valid.T]
    return tuple(None if not t.size else np.inf if t[-1] == motors.time[-1] else float(t[-1]) for t in known)


def assess(flight: Flight, vehicle: Vehicle, air, left: LossOfControl) -> Assessed:
    """One loss of control: its cause, and whether the vehicle flew on."""
    if left.landed:
        return Assessed(left, "unknown", (), np.empty(0), None, left.onset, ("it had landed before, under control",))
    start = _lift_off(air, left)
    assessed = _assess(flight, vehicle, start, left)
    spin = spinning.find(flight, vehicle, assessed.left, start)
    if spin is not None and assessed.cause in ("controller", "saturated"):  # no command asks for a spin
        assessed = assessed._replace(cause="unknown", evidence=())
    return assessed._replace(spin=spin)


def follow(flight: Flight, vehicle: Vehicle, air, known: Assessed) -> Assessed:
    """A loss of control whose cause is known, with the spin as it looks now."""
    return known._replace(spin=spinning.find(flight, vehicle, known.left, _lift_off(air, known.left), known.spin))


def _lift_off(air, left: LossOfControl) -> float:
    """Start of the flight with this loss of control [s]."""
    return next((a for a, b in air if a - 1.0 <= left.onset <= b + 1.0), left.onset)


def _assess(flight: Flight, vehicle: Vehicle, start: float, left: LossOfControl) -> Assessed:
    got = window_of(flight, vehicle, left, start)
    if got is None:
        return Assessed(left, "disarmed" if left.falls else "unknown", (), np.empty(0), None, left.onset, ())
    window, offset, onsets, at_take_off, ground = got
    found, probability = explain(window, vehicle.effectiveness(), offset, onsets, at_take_off, battery.sagged(flight, left.onset))
    healthy = next(e for e in found if e.kind == "healthy")
    onset = left.onset if left.falls else _strays(window, healthy.residual, left.onset)
    cause, evidence = _cause(flight, vehicle, start, left, found, probability, window, onset)
    held_by = _kept(window, at_take_off)
    if held_by and cause in ("rotor", ORDER, "knock", "unknown"):
        return Assessed(left, "unknown", (), np.empty(0), None, left.onset, (held_by,))
    if cause == "rotor":  # residuals of brisk flight may have strayed before
        onset = min(found[0].onset, left.onset)
    if cause == "controller" and np.abs(offset.mean[:2]).max() > TRIM * len(vehicle.rotors):
        cause, evidence = ("unknown", ("its rotor commands had been out of balance since take-off, compared with healthy vehicles",))
    if left.impact is None and ground is not None:
        left = left._replace(impact=ground, ground=ground if left.end is None else None)
    if cause in ("rotor", "unknown") and not at_take_off:
        rotor = next(e for e in found if e.kind == "rotor")
        if pushed := _pushed_up(flight, window, rotor, onset):
            return Assessed(left, "unknown", (), np.empty(0), None, onset, (pushed,))
    return Assessed(left, cause, found, probability, window, onset, evidence)


def _kept(window: Window, at_take_off: bool) -> str:
    """What shows that something else than its rotors holds the vehicle, else nothing: on a bench or a stand no balance of torques holds."""
    turned = window.rate[window.torque_ok.all(axis=1)]
    if len(turned) and np.ptp(turned, axis=0).max() < loss_of_control.RESTS_RAD_S:
        return "it did not turn"
    return "its rotors gave too little thrust to tip it over" if at_take_off and window.thrust.max() < TIPS else ""


def _cause(
    flight, vehicle, start: float, left: LossOfControl, found, probability, window: Window, onset: float
) -> tuple[str, tuple[str, ...]]:
    """The cause of a loss of control, and the sentences of evidence for it."""
    if left.falls:
        disarmed = any(m.kind == "armed" and not m.value and abs(m.time - left.onset) < DISARMED_S for m in flight.messages)
        near = (m.text for m in flight.messages if abs(m.time - left.onset) < DISARMED_S)
        by = next((text.partition(": ")[2] for text in near if text.startswith("disarmed: ")), "")
        says = f", and the autopilot says disarmed{f' ({by})' if by else ''}" if disarmed else ""
        return "disarmed", (f"all outputs went to idle in flight{says}",)
    best, p = found[0], float(probability[0])
    rotor = sum(float(q) for e, q in zip(found, probability) if e.kind == "rotor")
    struck = _struck(window, vehicle.effectiveness(), onset)
    if rotor > SURE and best.fits and not struck:
        without = f"stuck at {best.gives:.1f} times hover thrust" if best.gives else "without thrust"
        return "rotor", (f"the motion matches {_names(found, probability)} {without}",)
    order = sum(float(q) for e, q in zip(found, probability) if e.kind in ("order", "yaw"))
    if best.kind in ("order", "yaw") and order > SURE and best.fits:
        return ORDER, ("the first movement opposed the commands",)
    blow = left.impact is not None and left.impact - onset <= HIT_S and not loss_of_control.low(flight, onset, start)
    if struck or blow:
        return "knock", ("an external force pushed the vehicle harder than its rotors can",)
    sagged = battery.sagged(flight, onset)
    if sagged:
        return "power", ("the battery's voltage collapsed, by more than its current explains",)
    early = (window.time > onset - 1.0) & (window.time <= onset)
    limit = (window.thrust[early] > LIMIT * window.full).any(axis=1)
    if best.kind == "healthy" and p > SURE and early.any() and limit.mean() > LIMIT_SHARE:
        return "saturated", ("outputs had been at their limits before control was lost",)
    flying = window.time < (np.inf if left.impact is None else left.impact)
    torque = next(e for e in found if e.kind == "healthy").residual[flying, :3]
    turned = left.onset - start > FIRST_S and torque.size > 0 and bool((np.sqrt((torque**2).mean(axis=0)) < TURNED).all())
    # Air may have taken the thrust, too: without that explanation, the torques must not implicate a rotor either.
    nobody = best.kind == "common" and rotor < (1.0 - SURE) * float(probability[1:].sum())
    if (best.kind == "healthy" and p > SURE and best.fits and turned) or (nobody and turned and _level(flight, left, onset)):
        if _shaken(flight, onset):
            return "unknown", ("vibration was too strong for the motion to show what the rotors did",)
        return "controller", (
            "all rotors turned the vehicle as commanded, so the commands were wrong: from a sensor, an estimate or the pilot",
        )
    unsaid = sagged is None and battery.fell(flight, onset)
    return "unknown", (UNSAID,) if unsaid else ()


def _shaken(flight: Flight, onset: float) -> bool:
    """True if vibration before the departure was so strong that the motion clears no rotor."""
    if not flight.has("accel"):
        return False
    force = flight["accel"].wholes().between(onset - BEFORE_S, onset - KNOCK_S).values
    return len(force) >= LEAST_FORCES and float(force.std(axis=0).max()) > SHAKES


def _struck(window: Window, B: np.ndarray, onset: float) -> bool:
    """True if the vehicle turned, as control was lost, in a way that the loss of no two rotors explains. Sizes as for knocks in flight."""
    n, torque = B.shape[1], (window.thrust @ B.T)[:, :3]
    near = np.abs(window.time - onset) <= KNOCK_S
    with_it = np.maximum(np.sign(window.rate_dot) * torque, 0.0)
    most = np.sort(np.maximum(window.thrust, window.before), axis=1)[:, -2:].sum(axis=1)
    beyond = (LEAST_GAIN * n * np.abs(window.rate_dot) - with_it).max(axis=1) - most
    return bool((beyond[near & window.torque_ok.all(axis=1)] > 0.0).any())


def _pushed_up(flight: Flight, window: Window, rotor: Explanation, onset: float) -> str:
    """What shows that the vehicle touched something as control was lost, else nothing: lift rose above what was commanded and what a rotor
    stuck at its thrust adds. A rotor that fails takes lift away. rotor: the best explanation by a rotor."""
    if not flight.has("accel"):
        return ""
    force = flight["accel"].wholes().between(onset - KNOCK_S - PUSH_S - STEADY_S, onset + PUSH_S)
    time, lift = force.time, -force.values[:, 2] / G0
    total, asked = np.append(0.0, np.cumsum(lift)), window.thrust.mean(axis=1)
    most = np.maximum(np.maximum(window.thrust, window.before), window.after).mean(axis=1)
    swings = LEVER_M / G0 * (np.abs(window.rate_dot).max(axis=1) + (window.rate**2).sum(axis=1))
    for t in time[time > onset - KNOCK_S]:
        a, b, c = np.searchsorted(time, [t - PUSH_S - STEADY_S, t - PUSH_S, t], side="right")
        calm = (window.time > t - PUSH_S - STEADY_S) & (window.time <= t - PUSH_S)
        near = np.abs(window.time - t) <= np.abs(window.time - t).min() + 1e-9
        if b - a < LEAST_FORCES or c - b < 2 or not calm.any():
            continue
        rise = (total[c] - total[b]) / (c - b) - (total[b] - total[a]) / (b - a)
        shakes = contact.SHAKES * float(lift[a:b].std()) / np.sqrt(c - b)
        more = max(float(most[near].max() - asked[calm].mean()), 0.0) + max(rotor.gives - 1.0, 0.0) / window.thrust.shape[1]
        if rise - more - max(shakes, float(swings[near].max())) > PUSHES:
            return f"it was pushed up, by {rise:.1f} g more than before, as no failing rotor does"
    return ""


def _names(found, probability) -> str:
    who = [e.rotors[0] + 1 for e, p in zip(found, probability) if e.kind == "rotor" and p >= CREDIBLE]
    return "rotor " + " or ".join(str(r) for r in who)


def _level(flight: Flight, left: LossOfControl, onset: float) -> bool:
    """True if the autopilot estimated an upright attitude during the departure."""
    if not flight.has("attitude"):
        return False
    q, age = held(flight["attitude"], np.linspace(onset, left.onset, 5))
    return bool((age < 1.0).all() and (thrust_axis(q)[:, 2] > np.cos(np.radians(LEVEL_DEG))).all())


def _strays(window: Window, residual: np.ndarray, onset: float) -> float:
    """Onset [s] of the deviation of the motion from the commands, for a loss of control that showed at `onset` [s]."""
    far = (np.abs(residual[:, :3]) > STRAYS).any(axis=1) | (np.abs(residual[:, 3]) > STRAYS_THRUST)
    first = onset
    for k in np.flatnonzero(far & (window.time < onset))[::-1]:
        if first - window.time[k] > JOINS_S:
            break
        first = float(window.time[k])
    return first


def spins(found: Sequence[Assessed]) -> tuple[tuple[float, float], ...]:
    """((start, end), ...) s in which the vehicle spins and flies on."""
    return tuple((j.spin.since, j.spin.until) for j in found if j.spin is not None)


def until_impact(flight: Flight, air, found: Sequence[Assessed]) -> tuple[tuple[float, float], ...]:
    """`loss_of_control.until_impact` for losses of control whose onset is known. What strikes a vehicle that spins on is no end of it, and
    the hover model no longer holds."""
    left = (j.left if j.spin is None else j.left._replace(impact=None, end=None) for j in found)
    return loss_of_control.until_impact(flight, air, tuple(d._replace(onset=min(j.onset, d.onset)) for j, d in zip(found, left)))


def window_of(
    flight: Flight, vehicle: Vehicle, left: LossOfControl, start: float
) -> tuple[Window, Offset, np.ndarray, bool, float | None] | None:
    """The ticks around an upset, the torques' offset before it, indices of the ticks of possible onsets, whether it came with the take-off,
    and when the vehicle lay on the ground, or None [s]; None where the log shows no commands or rates there. start: of the flight [s]."""
    first, last = left.onset - BEFORE_S, min(left.lost + AFTER_S, np.inf if left.end is None else left.end)
    if left.impact is not None and left.impact > left.onset + HIT_S:
        last = min(last, left.impact)
    part = replace(flight, signals={k: s.between(first - 3.0, last + 1.0) for k, s in flight.signals.items()})
    if not part.has("motors") or not (part.has("gyro") or part.has("rates")):
        return None
    thrust = allocation.rotor_thrusts(part, vehicle)
    if len(thrust) < 4:
        return None
    how = tick_table.plan(part, thrust, 0.0)
    seen = tick_table.sense(part, thrust, how)
    at_take_off = left.onset - start < FIRST_S
    hover = _hover(flight, seen, vehicle, left.onset, at_take_off)
    stirs = (np.abs(seen.rate_dot).max(axis=1) > STIRS[0]) | (np.abs(seen.rate).max(axis=1) > STIRS[1])
    stirs &= seen.rate_ok & (seen.share.max(axis=1) > 0.05) & (seen.time > start - FIRST_S)
    began = float(seen.time[np.argmax(stirs)]) - how.dt if at_take_off and stirs.any() else first
    still = (np.abs(seen.rate).max(axis=1) < LIES[0]) & (np.abs(seen.rate_dot).max(axis=1) < LIES[1]) & seen.rate_ok
    still &= seen.time > max(left.onset + LATER_S, left.lost - loss_of_control.LASTS_S)
    lies = np.flatnonzero(still[2:] & still[1:-1] & still[:-2])
    turning = np.abs(seen.rate).max(axis=1)
    stopped = last
    for k in lies:  # and the ground stopped it
        before = np.flatnonzero((seen.time <= seen.time[k]) & (seen.time >= max(seen.time[k] - STOPS_S, left.onset)))
        if before.size and turning[before].max() > TURNED_OVER:
            stopped = float(seen.time[before[np.argmax(turning[before])]])
            break
    ground, last = (stopped if stopped < last else None), min(last, stopped)
    first = max(first, began, left.onset - MOST_TICKS * how.dt / 3.0)
    inside = np.flatnonzero((seen.time >= first) & (seen.time <= last + (how.lag_s if ground is None else 0.0)) & seen.some)[:MOST_TICKS]
    commanded = np.flatnonzero(seen.share[inside].max(axis=1, initial=0.0) > loss_of_control.REST)
    if commanded.size and not left.falls:  # with its motors stopped, the vehicle's motion shows nothing
        inside = inside[: commanded[-1] + 2]
    shown = (seen.time[inside] > left.onset - EARLIER_S) & (seen.time[inside] < max(left.lost, left.onset + LATER_S))
    if inside.size < 3 or not shown.any():  # motors at idle long before; or nothing moved but the estimate of the attitude
        return None
    T = seen.share / hover
    window = Window(
        seen.time[inside], T[inside], 1.0 / hover, seen.rate[inside], seen.rate_dot[inside], seen.load[inside],
        seen.rate_ok[inside, None] & ~_pinned(seen.rate[inside], seen.rate_dot[inside]), seen.load_ok[inside],
        T[np.maximum(inside - 1, 0)], T[np.minimum(inside + 1, len(seen) - 1)], left.onset,
    )  # fmt: skip
    causes = np.flatnonzero((window.time >= left.onset - EARLIER_S) & (window.time <= max(left.onset + LATER_S, left.lost - SHOWS_S)))
    onsets = np.union1d([0], causes) if at_take_off or not causes.size else causes
    return (window, _offset(window, vehicle.effectiveness(), left.onset - EARLIER_S, at_take_off), onsets, at_take_off, ground)


def _pinned(rate: np.ndarray, rate_dot: np.ndarray) -> np.ndarray:
    """(K, 3) bool: a gyro at the end of its range, where it shows no acceleration."""
    most = np.abs(rate).max(axis=0)
    there = (np.abs(rate) > 0.97 * most) & (np.abs(rate_dot) < STIRS[0]) & (most > PINNED)
    return there & (there.sum(axis=0) >= 4)


def _hover(flight: Flight, seen: Sensed, vehicle: Vehicle, until: float, at_take_off: bool) -> float:
    """Mean share of full thrust that carries the vehicle: as learned from healthy flights, of the ticks before `until` [s] at which about
    one g was carried, or as the autopilot has learned it."""
    known = tick_table.known_hover(vehicle)
    if known:
        return known
    mean = seen.share.mean(axis=1)
    load = np.where(seen.load_ok, seen.load, 1.0)
    carried = seen.some & (mean > 0.02) & (np.abs(seen.rate).max(axis=1) < 1.0) & (load > 0.7) & (load < 1.6) & (seen.time < until)
    if not at_take_off and carried.any():
        return float(np.clip(median(mean[carried] / load[carried]), 0.05, 1.0))
    learned = [flight.parameters[name] for name in HOVER_PARAMETERS if 0.05 < flight.parameters.get(name, 0.0) < 0.8]
    return float(learned[0]) if learned else USUAL_HOVER


def _offset(window: Window, B: np.ndarray, until: float, at_take_off: bool) -> Offset:
    """Trim: the torques commanded in calm flight before `until` [s]."""
    calm = np.flatnonzero((window.time < until) & window.torque_ok.all(axis=1))
    if at_take_off or calm.size < 2 or window.time[calm[-1]] - window.time[calm[0]] < CALM_S:
        return Offset(np.zeros(3), np.full(3, UNKNOWN_SD))
    w = (window.thrust @ B.T)[calm, :3] - B.shape[1] * INERTIA * window.rate_dot[calm]
    return Offset(-median(w, axis=0), CALM_SD + 0.5 * w.std(axis=0))
