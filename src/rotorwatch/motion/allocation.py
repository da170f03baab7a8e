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
GAIN_MEMORY_S = 20.0  # air density changes with height, slowly
PAIR_WITHIN_S = 0.15  # a command further than this from any control sample has no partner
YAW_HEADROOM = 200.0  # MOT_YAW_HEADROOM where nothing tells: ArduPilot's default
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
    return better(motor_thrusts(flight, vehicle), mixed_thrusts(flight, vehicle))


def better(logged: Signal, mixed: Signal | None) -> Signal:
    """The rebuilt thrusts where they can be trusted, the last logged ones elsewhere."""
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
    return rebuilt(flight, vehicle, compare(flight, vehicle)) if faster_control(flight) else None


def faster_control(flight: Flight) -> bool:
    """Is the rate controller's output logged so much faster than the rotors' commands that these are worth rebuilding from it?"""
    return flight.has("control", "motors") and flight["control"].rate_hz >= 1.5 * flight["motors"].rate_hz


def rebuilt(flight: Flight, vehicle: Vehicle, check: Comparison) -> Signal | None:
    """`mixed_thrusts` with a comparison that has been made."""
    control = flight["control"]
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

    def __getitem__(self, part: slice) -> Comparison:
        return Comparison(*[x[part] for x in vars(self).values()])

    def __add__(self, later: Comparison) -> Comparison:
        return Comparison(*[np.concatenate(both) for both in zip(vars(self).values(), vars(later).values())])


@dataclass
class Learned:
    """What comparisons leave to those that follow. above, below, last: of `_learn_gain`'s average, and its gain; now, spread: of
    `_learn_mixer`; prior (5, n), good (n,): weights of the last comparison, and whether it fitted."""

    above: float = 0.0
    below: float = 0.0
    last: float = 0.0
    gain: float = 1.0
    now: np.ndarray | None = None
    spread: np.ndarray | None = None
    prior: np.ndarray | None = None
    good: np.ndarray | None = None


def compare(flight: Flight, vehicle: Vehicle, learned: Learned | None = None) -> Comparison:
    """Hold the rebuilt demands against the logged ones, learning the mixer's gain (or, for a mixer that is not known,
    all of its factors) on the way. Needs signals ``motors`` and ``control``. learned: by earlier pieces of the same flight, which this
    goes on with; their motor samples must not be in this one, and each of its own must have a later control sample."""
    learned = Learned() if learned is None else learned
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
        weights = _learn_mixer(time, inputs, demand, top, learned)
    else:
        weights = _learn_gain(time, inputs, demand, vehicle.mixer, learned)
    # Each sample is judged by what was known before it.
    prior = np.concatenate([weights[:1] if learned.prior is None else learned.prior[None], weights[:-1]])[: len(time)]
    rebuilt = np.einsum("tc,tcr->tr", inputs, prior)
    deviation = demand - np.clip(rebuilt, 0.0, top)
    good = np.abs(deviation) < PART
    earlier = np.zeros_like(good[:1]) if learned.good is None else learned.good[None]
    trusted = good & np.concatenate([earlier, good[:-1]])[: len(time)]
    if len(time):
        learned.prior, learned.good = weights[-1], good[-1]
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
    always = yaw_always(flight.parameters.get("MOT_YAW_HEADROOM", YAW_HEADROOM))
    if vehicle.mixer is None:
        return yaw < always
    turning = np.abs(vehicle.mixer[:, 2]) > 1e-9
    factors = vehicle.mixer[turning]
    level = np.clip(control[:, 3:4], 0.0, 0.5) + control[:, :2] @ factors[:, :2].T
    up = control[:, 2:3] * factors[:, 2] > 0
    room = np.where(up, 1.0 - level, level) / np.abs(factors[:, 2])
    return yaw < np.maximum(always, 0.95 * room.min(axis=1, initial=np.inf))


def yaw_always(headroom: float = YAW_HEADROOM) -> float:
    """Yaw that ArduPilot's mixer grants whatever else is asked: its parameter MOT_YAW_HEADROOM, in thousandths, within its limits."""
    return float(np.clip(np.nan_to_num(headroom, nan=YAW_HEADROOM), 100.0, 500.0)) / 1000.0


def believed_curve(vehicle: Vehicle) -> ThrustCurve:
    """The thrust curve the autopilot's mixer reckons with; the vehicle's own unless ``extra`` has ``mixer_expo``."""
    return replace(vehicle.curve, expo=float(vehicle.extra.get("mixer_expo", vehicle.curve.expo)))


def drive(expo: float, thrust: np.ndarray) -> np.ndarray:
    """Inverse of the thrust curve: (command share times battery ratio) that gives `thrust`, 0 or more."""
    if expo < 1e-6:
        return thrust
    return (np.sqrt((1.0 - expo) ** 2 + 4.0 * expo * thrust) - (1.0 - expo)) / (2.0 * expo)


def _learn_gain(time, inputs, thrust, mixer, learned: Learned | None = None) -> np.ndarray:
    """Weights (m, 5, n) of a known mixer: only a common gain (air density) is unknown; forgetting average."""
    demand = inputs[:, :4] @ mixer.T
    power = np.sum(demand * demand, axis=1)
    product = np.sum(thrust * demand, axis=1)
    own = product / np.maximum(power, 1e-12)
    # A sample counts when its own gain explains all rotors: none limited, none overridden.
    apart = np.max(np.abs(thrust - own[:, None] * demand), axis=1)
    usable = (thrust.min(axis=1) > FLYING) & (apart < PART) & (own > 0.6) & (own < 1.7)
    gains = np.ones(len(time))
    past = Learned() if learned is None else learned
    known, above, below, last = past.gain, past.above, past.below, past.last
    for k in np.flatnonzero(usable):
        fade = np.exp((last - time[k]) / GAIN_MEMORY_S)
        above, below, last = above * fade + product[k], below * fade + power[k], time[k]
        past.gain = gains[k] = above / below
    past.above, past.below, past.last = above, below, last
    # Between usable samples the last gain holds.
    held = np.maximum.accumulate(np.where(usable, np.arange(len(time)), -1))
    gains = np.where(held >= 0, gains[np.maximum(held, 0)], known)
    base = np.concatenate([mixer.T, np.zeros((1, mixer.shape[0]))])
    return gains[:, None, None] * base


def _learn_mixer(time, inputs, thrust, top, learned: Learned | None = None) -> np.ndarray:
    """Weights (m, 5, n) of a mixer that is not known: recursive least squares of the thrusts on the control inputs."""
    size, rotors = inputs.shape[1], thrust.shape[1]
    usable = np.all((thrust > FLYING) & (thrust < 0.95 * top), axis=1)
    weights = np.zeros((len(time), size, rotors))
    past = Learned() if learned is None else learned
    now, spread = past.now, past.spread
    if now is None or spread is None:
        now, spread = np.zeros((size, rotors)), np.eye(size)
        now[3] = 1.0
    for k, x in enumerate(inputs):
        if usable[k]:
            gain = spread @ x / (x @ spread @ x + NOISE_SD**2)
            now = now + np.outer(gain, thrust[k] - x @ now)
            spread = spread - np.outer(gain, x @ spread)
        weights[k] = now
    past.now, past.spread = now, spread
    return weights


def within(time: np.ndarray, spans: Spans) -> np.ndarray:
    """(n,) bool: which times lie in one of the spans."""
    inside = np.zeros(len(time), bool)
    for start, end in spans:
        inside |= (time >= start) & (time < end)
    return inside


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
