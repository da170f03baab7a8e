"""From logged commands to rotor thrusts, and what rotor thrusts cannot tell apart.

A rotor's command u is logged slowly (ArduPilot: 10 Hz), the rate controller's output c = (roll, pitch, yaw, throttle)
often fast. The autopilot turns c into thrust demands with its mixer M and its gain g (air density),

    t = g M c,        m(u) = t        with m the thrust curve the autopilot believes in (battery compensation included),

so that the slow m(u) verifies and scales a fast rebuilt t, from which u and the thrust f(u) follow. ArduPilot's m is f;
PX4 often believes in a straight line (THR_MDL_FAC 0) that no motor follows: ``vehicle.extra["mixer_expo"]``.

All functions here are causal: a value at time s uses nothing logged after s.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import ThrustCurve, Vehicle

Spans = tuple[tuple[float, float], ...]
PART = 0.05  # share of full thrust by which rebuilt and logged thrust may differ before the rebuilt one is not trusted
FLYING = 0.05  # share of full thrust above which a rotor does enough for a comparison
PART_STILL = 0.015  # the same for an output that does not move at all
GAIN_MEMORY_S = 20.0  # air density changes with height, slowly
PAIR_WITHIN_S = 0.15  # a command further than this from any control sample has no partner
PROVEN = 20  # comparisons a mixer must have passed before it can accuse an output
GIVEN_UP = np.linspace(0.0, 1.0, 11)  # shares of yaw that a mixer at its limits may give up
UNEXPLAINED = 0.25  # share of what outputs part by that a mixer may leave unexplained before it is not believed
AGREEING = 0.7  # share of the other outputs that must agree on what is common to all before one can be accused
CONFIRM_S, CONFIRM_SAMPLES = 0.25, 3  # how long an output must differ
STUCK_S = 1.0  # an output that does not move for this long while it should have, whatever limits the others, is stuck
SILENT_S = 0.5  # an output that does not move for this long while all others do is stuck
NOISE_SD = 0.004  # rounding to 1 us, and the controller moving between its own log lines and those of the outputs


def motor_thrusts(flight: Flight, vehicle: Vehicle) -> Signal:
    """Share of full thrust f(u) of every rotor, columns r1..rN, unit 1, at the times of signal ``motors``.

    The battery ratio is the last one logged (signal ``lift``), 1 where none is; an airframe whose ``extra`` has
    ``full_voltage`` drives its motors straight from the battery, whose voltage (signal ``battery``) then counts.
    """
    motors = flight["motors"]
    ratio, full = battery_ratio(flight, motors.time), vehicle.extra.get("full_voltage")
    if full and "battery" in flight.signals:
        battery = flight["battery"]
        ok = battery.valid[:, 0] & (battery.values[:, 0] > 0.5 * full)
        ratio = hold(battery.time[ok], battery.values[ok, 0] / full, motors.time, before=1.0)
    thrust = vehicle.curve(motors.values, ratio[:, None])
    return Signal(motors.time, thrust, motors.columns, "1", "body", motors.source, motors.valid)


def battery_ratio(flight: Flight, times: np.ndarray) -> np.ndarray:
    """Battery voltage as a share of full, filtered by the autopilot: the last value logged before each time; else 1."""
    lift = flight.signals.get("lift")
    if lift is None or "voltage_ratio" not in lift.columns:
        return np.ones(len(times))
    column = lift.columns.index("voltage_ratio")
    ok = lift.valid[:, column] & (lift.values[:, column] > 0.3)
    return hold(lift.time[ok], lift.values[ok, column], times, before=1.0)


def hold(time: np.ndarray, values: np.ndarray, at: np.ndarray, before: float = 0.0) -> np.ndarray:
    """The last of `values` (n,) or (n, k) known at each of the times `at`; `before` where there is none yet."""
    index = np.searchsorted(time, at, side="right") - 1
    if not len(time):
        return np.full((len(at), *values.shape[1:]), before)
    held = values[np.maximum(index, 0)].copy()
    held[index < 0] = before
    return held


def rotor_thrusts(flight: Flight, vehicle: Vehicle) -> Signal:
    """The better of the two: `mixed_thrusts` where it can be trusted, the last `motor_thrusts` elsewhere."""
    logged, mixed = motor_thrusts(flight, vehicle), mixed_thrusts(flight, vehicle)
    if mixed is None:
        return logged
    held = hold(logged.time, logged.values, mixed.time)
    known = hold(logged.time, logged.valid, mixed.time, before=False)
    values = np.where(mixed.valid, mixed.values, held)
    return Signal(mixed.time, values, logged.columns, "1", "body", mixed.source, mixed.valid | known)


def mixed_thrusts(flight: Flight, vehicle: Vehicle) -> Signal | None:
    """Rotor thrusts rebuilt from the rate controller's output, at its times; None when that brings nothing.

    Columns and unit as in `motor_thrusts`. None: no ``control`` signal, or it is not faster than ``motors``. ``valid``
    is False where the rebuilt thrust is not to be trusted and the last logged command is better: outputs that reach
    their limits, yaw beyond the mixer's headroom, and any rotor whose last logged command differed by more than 0.05 of
    full thrust (thrust boost, spool-up, an output that is overridden).
    """
    if not flight.has("control", "motors") or flight["control"].rate_hz < 1.5 * flight["motors"].rate_hz:
        return None
    control = flight["control"]
    check = compare(flight, vehicle)
    step = np.searchsorted(check.known, control.time, side="right") - 1  # last comparison finished by then
    regressors = np.column_stack([control.values, np.ones(len(control))])
    if not len(check.time):
        return None
    demand = np.empty((len(control), len(vehicle.rotors)))
    for part in np.array_split(np.arange(len(control)), len(control) // 8192 + 1):  # weights of all rows: much memory
        demand[part] = np.einsum("tc,tcr->tr", regressors[part], check.weights[np.maximum(step[part], 0)])
    believed, battery = believed_curve(vehicle), battery_ratio(flight, control.time)[:, None]
    inside = np.all((demand > 0.005) & (demand < 0.99 * believed(np.asarray(believed.u_max), battery)), axis=1)
    share = drive(believed.expo, np.clip(demand, 0.0, 1.0))
    thrust = (1.0 - vehicle.curve.expo) * share + vehicle.curve.expo * share * share
    inside &= yaw_granted(flight, vehicle, control.values)
    fresh = (step >= 0) & (control.time - check.time[np.maximum(step, 0)] < 0.5)
    trusted = check.trusted[np.maximum(step, 0)]
    valid = (inside & fresh & np.all(control.valid, axis=1))[:, None] & trusted
    source = f"{control.source} through the mixer"
    return Signal(control.time, thrust, flight["motors"].columns, "1", "body", source, valid)


@dataclass(frozen=True)
class Comparison:
    """Logged against rebuilt demand at the m motor samples that have control samples around them.

    time (m,): of the motor sample. known (m,): when its comparison could be made (the later control sample has come).
    demand (m, n): logged m(u). asked (m, n): rebuilt, as if outputs had no limits. deviation (m, n): logged minus rebuilt within the
    limits, whose upper one is top (m, 1). yaw (m, n): the part of `asked` that is for yaw; yaw_granted (m,): the mixer grants all of
    it. weights (m, 5, n): (roll, pitch, yaw, throttle, 1) -> demand as known right after this
    sample. trusted (m, n): the rebuilt thrust of this rotor agreed in this sample and the one before.
    """

    time: np.ndarray
    known: np.ndarray
    demand: np.ndarray
    asked: np.ndarray
    top: np.ndarray
    yaw: np.ndarray
    yaw_granted: np.ndarray
    deviation: np.ndarray
    weights: np.ndarray
    trusted: np.ndarray


def compare(flight: Flight, vehicle: Vehicle) -> Comparison:
    """Hold the rebuilt demands against the logged ones, learning the mixer's gain (or, for a mixer that is not known,
    all of its factors) on the way. Needs signals ``motors`` and ``control``."""
    logged, control, believed = flight["motors"], flight["control"], believed_curve(vehicle)
    ok = np.all(control.valid, axis=1)
    when, what = control.time[ok], control.values[ok]
    # Linear interpolation between the two control samples around each command; the comparison waits for the later one.
    later = np.searchsorted(when, logged.time)
    found = (later > 0) & (later < len(when)) & np.all(logged.valid, axis=1)
    # At equal rates a command is logged within 1 ms of its control sample: no need to wait for the next one.
    before = np.clip(later - 1, 0, max(len(when) - 1, 0))
    after = np.clip(later, 0, max(len(when) - 1, 0))
    if not len(when):
        found[:] = False
    else:
        close = (logged.time - when[before] < 0.002) & (later > 0)
        after = np.where(close, before, after)
        before = np.where(when[after] - logged.time < 0.002, after, before)
        found = (found | close) & (np.maximum(when[after] - logged.time, logged.time - when[before]) < PAIR_WITHIN_S)
    before, after, time = before[found], after[found], logged.time[found]
    battery = battery_ratio(flight, time)[:, None]
    demand = believed(logged.values[found], battery)
    gap = np.maximum(when[after] - when[before], 1e-9)
    share = np.clip((time - when[before]) / gap, 0.0, 1.0)[:, None]
    inputs = np.column_stack([(1.0 - share) * what[before] + share * what[after], np.ones(len(time))])
    top = believed(np.asarray(believed.u_max), battery)
    if vehicle.mixer is None:
        weights = _learn_mixer(time, inputs, demand, top)
    else:
        weights = _learn_gain(time, inputs, demand, vehicle.mixer)
    # Each sample is judged by what was known before it.
    prior = np.concatenate([weights[:1], weights[:-1]])
    rebuilt = np.einsum("tc,tcr->tr", inputs, prior)
    deviation = demand - np.clip(rebuilt, 0.0, top)
    good = np.abs(deviation) < PART
    trusted = good & np.concatenate([np.zeros_like(good[:1]), good[:-1]])
    known = np.maximum(time, when[after]) if len(time) else time
    yaw = inputs[:, 2:3] * prior[:, 2]
    granted = yaw_granted(flight, vehicle, inputs)
    return Comparison(time, known, demand, rebuilt, top, yaw, granted, deviation, weights, trusted)


def yaw_granted(flight: Flight, vehicle: Vehicle, control: np.ndarray) -> np.ndarray:
    """(m,) bool: the mixer grants all of the yaw in `control` (m, 4 or more: roll, pitch, yaw, throttle).

    ArduPilot limits yaw last: to the room that roll and pitch leave every rotor around a throttle of at most 0.5, but
    never below MOT_YAW_HEADROOM (default 200 of 1000).
    """
    yaw = np.abs(control[:, 2])
    always = np.clip(np.nan_to_num(flight.parameters.get("MOT_YAW_HEADROOM", 200.0), nan=200.0), 100.0, 500.0) / 1000.0
    if vehicle.mixer is None:
        return yaw < always
    turning = np.abs(vehicle.mixer[:, 2]) > 1e-9
    factors = vehicle.mixer[turning]
    level = np.clip(control[:, 3:4], 0.0, 0.5) + control[:, :2] @ factors[:, :2].T
    up = control[:, 2:3] * factors[:, 2] > 0
    room = np.where(up, 1.0 - level, level) / np.abs(factors[:, 2])
    return yaw < np.maximum(always, 0.95 * room.min(axis=1, initial=np.inf))


def believed_curve(vehicle: Vehicle) -> ThrustCurve:
    """The thrust curve the autopilot's mixer reckons with; the vehicle's own unless ``extra`` has ``mixer_expo``."""
    return replace(vehicle.curve, expo=float(vehicle.extra.get("mixer_expo", vehicle.curve.expo)))


def drive(expo: float, thrust: np.ndarray) -> np.ndarray:
    """Inverse of the thrust curve: (command share times battery ratio) that gives `thrust`, 0 or more."""
    if expo < 1e-6:
        return thrust
    return (np.sqrt((1.0 - expo) ** 2 + 4.0 * expo * thrust) - (1.0 - expo)) / (2.0 * expo)


def _learn_gain(time, inputs, thrust, mixer) -> np.ndarray:
    """Weights (m, 5, n) of a known mixer: only a common gain (air density) is unknown; forgetting average."""
    demand = inputs[:, :4] @ mixer.T
    power = np.sum(demand * demand, axis=1)
    product = np.sum(thrust * demand, axis=1)
    own = product / np.maximum(power, 1e-12)
    # A sample counts when its own gain explains all rotors: none limited, none overridden.
    apart = np.max(np.abs(thrust - own[:, None] * demand), axis=1)
    usable = (thrust.min(axis=1) > FLYING) & (apart < PART) & (own > 0.6) & (own < 1.7)
    gains = np.ones(len(time))
    above, below, last = 0.0, 0.0, 0.0
    for k in np.flatnonzero(usable):
        fade = np.exp((last - time[k]) / GAIN_MEMORY_S)
        above, below, last = above * fade + product[k], below * fade + power[k], time[k]
        gains[k] = above / below
    # Between usable samples the last gain holds.
    held = np.maximum.accumulate(np.where(usable, np.arange(len(time)), -1))
    gains = np.where(held >= 0, gains[np.maximum(held, 0)], 1.0)
    base = np.concatenate([mixer.T, np.zeros((1, mixer.shape[0]))])
    return gains[:, None, None] * base


def _learn_mixer(time, inputs, thrust, top) -> np.ndarray:
    """Weights (m, 5, n) of a mixer that is not known: recursive least squares of the thrusts on the control inputs."""
    size, rotors = inputs.shape[1], thrust.shape[1]
    usable = np.all((thrust > FLYING) & (thrust < 0.95 * top), axis=1)
    weights = np.zeros((len(time), size, rotors))
    now = np.zeros((size, rotors))
    now[3] = 1.0
    spread = np.eye(size)
    for k, x in enumerate(inputs):
        if usable[k]:
            gain = spread @ x / (x @ spread @ x + NOISE_SD**2)
            now = now + np.outer(gain, thrust[k] - x @ now)
            spread = spread - np.outer(gain, x @ spread)
        weights[k] = now
    return weights


@dataclass(frozen=True)
class Override:
    """An output that no longer follows the mixer.

    rotor: 1-based. kind: stuck, off or overridden. Times in s, end None while it lasts. reason: one sentence. asked: share of full
    thrust that the mixer asked for when it was noticed; None where the log does not say what the mixer asked for.
    """

    rotor: int
    kind: str
    onset: float
    detected: float
    end: float | None
    reason: str
    asked: float | None = None


def overrides(flight: Flight, vehicle: Vehicle, airborne: Spans) -> tuple[Override, ...]:
    """Outputs that stopped following the mixer in flight: stuck at a value, off, or driven by something else.

    airborne: ((start, end), ...) in s. With a ``control`` signal that the mixer is seen to follow, an output counts
    when it differs by more than 0.05 of full thrust (and six times the usual difference) for 0.25 s while no rotor is
    near its limits; limits explain neither an output below its minimum nor one that rests though it is asked to
    move against the others. Without it, only outputs that are off, or constant for 0.5 s while all others move, are found. Loss of
    effectiveness never shows here: the commands are what is compared. Causal: `detected` is when a live observer would have known.
    """
    if not flight.has("motors"):
        return ()
    found: list[Override] = []
    if flight.has("control"):
        found += _departures(flight, vehicle, airborne)
    found += _silent(flight, vehicle, airborne)
    return tuple(o for o in _earliest(found) if not _balances(o, found, vehicle))


def _balances(one: Override, found: list[Override], vehicle: Vehicle) -> bool:
    """Does an output rest only because the one opposite it has been lost? What flies on balances its torque that way."""
    if one.kind != "off" or one.asked is not None:
        return False
    B = vehicle.effectiveness()[:2]
    return any(
        o.onset < one.onset
        and (o.end is None or one.onset < o.end)
        and np.abs(B[:, o.rotor - 1] + B[:, one.rotor - 1]).max() < 0.1
        for o in found
    )


def _earliest(found: list[Override]) -> tuple[Override, ...]:
    """Of overrides of one rotor that overlap in time, the one detected first."""
    kept: list[Override] = []
    for one in sorted(found, key=lambda o: (o.detected, o.rotor)):
        if not any(o.rotor == one.rotor and (o.end is None or one.onset < o.end) for o in kept):
            kept.append(one)
    return tuple(kept)


def within(time: np.ndarray, spans: Spans) -> np.ndarray:
    """(n,) bool: which times lie in one of the spans."""
    inside = np.zeros(len(time), bool)
    for start, end in spans:
        inside |= (time >= start) & (time < end)
    return inside


def _departures(flight: Flight, vehicle: Vehicle, airborne: Spans) -> list[Override]:
    """Overrides found by comparing each output with what the mixer asks of it."""
    check = compare(flight, vehicle)
    if len(check.time) < 3:
        return []
    command = hold(flight["motors"].time, flight["motors"].values, check.time)
    low, span = vehicle.curve.u_min, vehicle.curve.u_max - vehicle.curve.u_min
    flying = within(check.time, airborne) & (np.median(check.demand, axis=1) > FLYING)
    interior = (command > low + 0.01 * span) & (command < low + 0.99 * span)
    alone = np.where(
        command >= low + 0.99 * span, 0.0, _alone(check, interior)
    )  # full thrust is what a mixer at its limits asks for
    # How well the mixer has explained the outputs so far; a mixer that never did says nothing about single outputs.
    far = np.abs(alone)
    good = flying & np.all(far < PART, axis=1)
    past = np.concatenate([[0], np.cumsum(good)[:-1]])
    compared = np.concatenate([[0], np.cumsum(flying & np.isfinite(alone).all(axis=1))[:-1]])
    power = np.concatenate([[0.0], np.cumsum(np.where(good[:, None], far**2, 0.0).max(axis=1))[:-1]])
    proven = (past >= PROVEN) & (past > 0.7 * compared) & _turns_as_asked(check, good)
    usual = 6.0 * np.sqrt(power / np.maximum(past, 1))
    limit, still_limit = np.maximum(PART, usual), np.maximum(PART_STILL, usual)
    own = check.asked - check.asked.mean(axis=1, keepdims=True)
    found = []
    for k in range(command.shape[1]):
        still = _since_moved(check.time, command[:, k], span / 400.0)
        off = (command[:, k] < low - 0.01 * span) & (check.asked[:, k] > 2 * FLYING)
        frozen = (check.time - still > 0.5) & interior[:, k]
        # At a limit the mixer takes from all others what it has too much, and in calm air they may rest: stuck is what does not
        # stir at all while it should have moved against them.
        rest = _since_moved(check.time, command[:, k], 1e-9)
        moved = np.abs(own[:, k] - own[np.searchsorted(check.time, rest), k]) > PART
        dead = (check.time - rest > STUCK_S) & interior[:, k] & moved & (np.abs(check.deviation[:, k]) > limit)
        wrong = proven & flying & ((far[:, k] > limit) | off | dead | (frozen & (far[:, k] > still_limit)))
        back = (np.abs(check.deviation[:, k]) < PART) & ~frozen
        for onset, seen, end in _runs(check.time, wrong, back | ~flying, CONFIRM_S, CONFIRM_SAMPLES):
            kind = "overridden"
            if np.all(command[onset : seen + 1, k] <= low + span / 400.0):
                kind = "off"
            elif np.ptp(command[onset : seen + 1, k]) <= span / 400.0 and interior[seen, k]:
                kind = "stuck"
            start = min(still[seen], check.time[onset]) if kind == "stuck" else check.time[onset]
            asked = np.clip(check.asked[seen, k], 0.0, check.top[seen, 0])
            reason = (
                f"output {k + 1} was at {command[seen, k]:.4g} while the mixer asked for {asked:.0%} "
                f"of full thrust and got {check.demand[seen, k]:.0%}"
            )
            until = None if end is None else float(check.time[end])
            found.append(Override(k + 1, kind, float(start), float(check.known[seen]), until, reason, float(asked)))
    return found


def _turns_as_asked(check: Comparison, good: np.ndarray) -> np.ndarray:
    """(m,) bool: in the samples before that fitted, outputs parted from each other as they were asked to. A mixer that has the throttle
    right but another scale of roll, pitch and yaw fits as well, while nothing turns."""
    asked, got = (x - x.mean(axis=1, keepdims=True) for x in (check.asked, check.demand))

    def so_far(x):
        return np.concatenate([[0.0], np.cumsum(np.where(good, x.sum(axis=1), 0.0))[:-1]])

    unexplained, all_ = so_far((got - asked) ** 2), so_far(got**2 + NOISE_SD**2)
    return unexplained < UNEXPLAINED * all_


def _alone(check: Comparison, interior: np.ndarray) -> np.ndarray:
    """(m, n) by how much each output parts from the mixer by itself; NaN where nothing can be said.

    Where not all that is asked can be had, a mixer gives up throttle, for all outputs alike, and yaw, a share of it. Outputs that this
    explains are nobody's fault, nor are outputs that are all off by the same amount (a gain). An output is accused with what is left of
    its departure under the share of yaw that suits it best, of those under which the others agree. Where even throttle and yaw are not
    enough, each mixer has its own way to give up tilt: nothing is said. interior (m, n): away from the limits.
    """
    alone, agreed = _against_others(check.demand, check.asked, check.top, interior)
    odd = np.flatnonzero(~(np.abs(alone) < PART).all(axis=1) & ~check.yaw_granted)
    best = np.where(agreed[odd], alone[odd], np.nan)
    for share in GIVEN_UP:
        asked = check.asked[odd] - share * check.yaw[odd]
        off, agree = _against_others(check.demand[odd], asked, check.top[odd], interior[odd])
        best = np.where(agree & ~(np.abs(off) > np.abs(best)), off, best)
    alone[odd] = best
    possible = np.ptp(check.asked, axis=1) < 0.97 * check.top[:, 0]
    return np.where(possible[:, None], alone, np.nan)


def _against_others(demand, asked, top, interior) -> tuple[np.ndarray, np.ndarray]:
    """(m, n) departure of each output from what is asked and what the others have in common, within the limits; and whether they agree."""
    apart, alone, agreed = (
        np.where(interior, demand - asked, np.nan),
        np.empty(demand.shape),
        np.empty(demand.shape, bool),
    )
    for k in range(demand.shape[1]):
        rest = np.arange(demand.shape[1]) != k
        off = demand - np.clip(asked + _median(apart[:, rest])[:, None], 0.0, top)
        agreed[:, k] = np.sum(np.abs(off[:, rest]) < PART, axis=1) > AGREEING * rest.sum()
        alone[:, k] = np.where(agreed[:, k], off[:, k], np.nan)
    return alone, agreed


def _median(values: np.ndarray) -> np.ndarray:
    """(m,) median of the finite values (m, k) of each row; NaN with fewer than two."""
    count = np.isfinite(values).sum(axis=1)
    ordered = np.sort(values, axis=1)  # NaN last
    rows, middle = np.arange(len(values)), np.maximum(count - 1, 0)
    return np.where(count < 2, np.nan, 0.5 * (ordered[rows, middle // 2] + ordered[rows, (middle + 1) // 2]))


def _silent(flight: Flight, vehicle: Vehicle, airborne: Spans) -> list[Override]:
    """Overrides that the outputs alone give away: one is off, or constant, while all others fly and move."""
    motors, thrust = flight["motors"], motor_thrusts(flight, vehicle).values
    low, span = vehicle.curve.u_min, vehicle.curve.u_max - vehicle.curve.u_min
    time, inside = motors.time, within(motors.time, airborne) & np.all(motors.valid, axis=1)
    window = np.searchsorted(time, time - SILENT_S, side="left")
    stills = np.stack([_since_moved(time, motors.values[:, j], 1e-9) for j in range(thrust.shape[1])], axis=1)
    resting = (time[:, None] - stills > SILENT_S) & inside[:, None]
    moved = np.zeros_like(thrust)  # range over the last SILENT_S, where it matters: while any output rests
    for i in np.flatnonzero(resting.any(axis=1)):
        moved[i] = np.ptp(thrust[window[i] : i + 1], axis=0)
    found = []
    for k in range(thrust.shape[1]):
        others, command = np.delete(thrust, k, axis=1), motors.values[:, k]
        still = stills[:, k]
        interior = (command > low + 0.02 * span) & (command < low + 0.98 * span)
        moving = np.min(np.delete(moved, k, axis=1), axis=1) > 0.03
        stuck = resting[:, k] & interior & moving
        # Below the minimum: no mixer asks for that. At the minimum, where outputs have nothing below it: no quad flies
        # on with a rotor at rest and the others off their limits (with more rotors, one opposite a dead one rests).
        flown = inside & (np.median(others, axis=1) > 2 * FLYING)
        below = flown & (command < low - 0.01 * span)
        idle = flown & (command <= low + 0.002 * span) & np.all((others > FLYING) & (others < 0.99), axis=1)
        idle &= others.shape[1] == 3 and bool(vehicle.extra.get("rests_at_minimum", False))
        ways = ((stuck, "stuck", 0.0, 1), (below, "off", 0.3, 3), (idle & (time - still > 1.0), "off", 0.0, 1))
        for wrong, kind, hold_s, samples in ways:
            back = (time - still < 0.2) if kind == "stuck" else (command > low + 0.01 * span)
            for onset, seen, end in _runs(time, wrong, back | ~inside, hold_s, samples):
                start = still[seen] if samples == 1 else time[onset]
                what = "did not move" if kind == "stuck" else "was off"
                reason = f"output {k + 1} {what} at {command[seen]:.4g} while all others flew on"
                until = None if end is None else float(time[end])
                found.append(Override(k + 1, kind, float(start), float(time[seen]), until, reason))
    return found


def _runs(time, wrong, back, hold_s: float, samples: int):
    """(onset, confirmed, end or None) indices of the spells of `wrong`.

    Confirmed after `hold_s` and `samples` in a row, ended when `back` holds for 0.5 s.
    """
    k, n = 0, len(time)
    flags = np.flatnonzero(wrong)
    while k < n:
        later = flags[np.searchsorted(flags, k) :]
        if not len(later):
            return
        onset = k = int(later[0])
        while k < n and wrong[k] and (time[k] - time[onset] < hold_s or k - onset + 1 < samples):
            k += 1
        if k == n or not wrong[k]:
            k += 1
            continue
        seen, since = k, None
        while k < n:
            since = (k if since is None else since) if back[k] else None
            if since is not None and time[k] - time[since] >= 0.5:
                break
            k += 1
        yield onset, seen, (since if k < n else None)


def _since_moved(time: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """For each sample the time since which the value has stayed within `tolerance` of where it settled."""
    start = np.empty(len(time))
    anchor, since = np.inf, 0.0
    for k, value in enumerate(values.tolist()):
        if abs(value - anchor) > tolerance:
            anchor, since = value, time[k]
        start[k] = since
    return start


def ambiguous_sets(effectiveness: np.ndarray, size: int = 2) -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
    """Pairs of rotor sets (1-based, up to `size` rotors) whose losses can produce exactly the same effect.

    effectiveness: (3 or 4, n), a column per rotor (`Vehicle.effectiveness`; its first three rows for torque only). Two
    sets S and T are listed when B_S x = B_T y has a solution with all x and y above 0: a linear program for each pair.
    """
    from scipy.optimize import linprog

    rotors = range(effectiveness.shape[1])
    sets = [s for k in range(1, size + 1) for s in itertools.combinations(rotors, k)]
    found = []
    for one, other in itertools.combinations(sets, 2):
        if set(one) & set(other):
            continue  # what they share cancels: the rest is a pair of smaller sets
        columns = np.concatenate([effectiveness[:, one], -effectiveness[:, other]], axis=1)
        # Cheap refusal first: no solution at all unless the columns depend on each other.
        if np.linalg.svd(columns, compute_uv=False)[-1] > 1e-9 and columns.shape[1] <= columns.shape[0]:
            continue
        answer = linprog(np.ones(columns.shape[1]), A_eq=columns, b_eq=np.zeros(len(columns)), bounds=(1, None))
        if answer.status == 0:
            found.append((tuple(k + 1 for k in one), tuple(k + 1 for k in other)))
    return tuple(found)
