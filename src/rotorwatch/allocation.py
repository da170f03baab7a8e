"""From logged commands to rotor thrusts, and what rotor thrusts cannot tell apart.

A rotor's command u is logged slowly (ArduPilot: 10 Hz), the rate controller's output c = (roll, pitch, yaw, throttle)
often fast. The autopilot turns c into thrust demands with its mixer M and its gain g (air density),

    t = g M c,        f(u) = t        with f the thrust curve that includes the battery compensation,

so that the slow f(u) verifies and scales a fast rebuilt t. All functions here are causal: a value at time s uses
nothing logged after s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotorwatch.flight import Flight, Signal
from rotorwatch.vehicle import Vehicle

PART = 0.05  # share of full thrust by which rebuilt and logged thrust may differ before the rebuilt one is not trusted
FLYING = 0.05  # share of full thrust above which a rotor does enough for a comparison
GAIN_MEMORY_S = 20.0  # air density changes with height, slowly
PAIR_WITHIN_S = 0.15  # a command further than this from any control sample has no partner
NOISE_SD = 0.004  # rounding to 1 us, and the controller moving between its own log lines and those of the outputs


def motor_thrusts(flight: Flight, vehicle: Vehicle) -> Signal:
    """Share of full thrust f(u) of every rotor, columns r1..rN, unit 1, at the times of signal ``motors``.

    The battery ratio is the last one logged (signal ``lift``), 1 where none is.
    """
    motors = flight["motors"]
    thrust = vehicle.curve(motors.values, battery_ratio(flight, motors.time)[:, None])
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
    thrust = np.einsum("tc,tcr->tr", regressors, check.weights[np.maximum(step, 0)])
    top = vehicle.curve(np.asarray(vehicle.curve.u_max), battery_ratio(flight, control.time))
    inside = np.all((thrust > 0.005) & (thrust < 0.99 * top[:, None]), axis=1)
    inside &= yaw_granted(flight, vehicle, control.values)
    fresh = (step >= 0) & (control.time - check.time[np.maximum(step, 0)] < 0.5)
    trusted = check.trusted[np.maximum(step, 0)]
    valid = (inside & fresh & np.all(control.valid, axis=1))[:, None] & trusted
    source = f"{control.source} through the mixer"
    return Signal(control.time, thrust, flight["motors"].columns, "1", "body", source, valid)


@dataclass(frozen=True)
class Comparison:
    """Logged against rebuilt thrust at the m motor samples that have control samples around them.

    time (m,): of the motor sample. known (m,): when its comparison could be made (the later control sample has come).
    thrust, deviation (m, n): logged f(u), and logged minus rebuilt. weights (m, 5, n): (roll, pitch, yaw, throttle, 1)
    -> thrust as known right after this sample. free (m,): no rotor near its limits, so that they explain nothing.
    trusted (m, n): the rebuilt thrust of this rotor agreed in this sample and the one before.
    """

    time: np.ndarray
    known: np.ndarray
    thrust: np.ndarray
    deviation: np.ndarray
    weights: np.ndarray
    free: np.ndarray
    trusted: np.ndarray


def compare(flight: Flight, vehicle: Vehicle) -> Comparison:
    """Hold the rebuilt thrusts against the logged ones, learning the mixer's gain (or, for a mixer that is not known,
    all of its factors) on the way. Needs signals ``motors`` and ``control``."""
    logged, control = motor_thrusts(flight, vehicle), flight["control"]
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
    before, after, thrust, time = before[found], after[found], logged.values[found], logged.time[found]
    gap = np.maximum(when[after] - when[before], 1e-9)
    share = np.clip((time - when[before]) / gap, 0.0, 1.0)[:, None]
    inputs = np.column_stack([(1.0 - share) * what[before] + share * what[after], np.ones(len(time))])
    top = vehicle.curve(np.asarray(vehicle.curve.u_max), battery_ratio(flight, time))[:, None]
    if vehicle.mixer is None:
        weights = _learn_mixer(time, inputs, thrust, top)
    else:
        weights = _learn_gain(time, inputs, thrust, vehicle.mixer)
    # Each sample is judged by what was known before it.
    prior = np.concatenate([weights[:1], weights[:-1]])
    rebuilt = np.einsum("tc,tcr->tr", inputs, prior)
    deviation = thrust - np.clip(rebuilt, 0.0, top)
    free = np.all((rebuilt > 0.02) & (rebuilt < 0.97 * top), axis=1)
    free &= yaw_granted(flight, vehicle, inputs)
    good = np.abs(deviation) < PART
    trusted = good & np.concatenate([np.zeros_like(good[:1]), good[:-1]])
    return Comparison(
        time, np.maximum(time, when[after]) if len(time) else time, thrust, deviation, weights, free, trusted
    )


def yaw_granted(flight: Flight, vehicle: Vehicle, control: np.ndarray) -> np.ndarray:
    """(m,) bool: the mixer grants all of the yaw in `control` (m, 4 or more: roll, pitch, yaw, throttle).

    ArduPilot limits yaw last: to the room that roll and pitch leave every rotor around a throttle of at most 0.5, but
    never below MOT_YAW_HEADROOM (default 200 of 1000).
    """
    yaw = np.abs(control[:, 2])
    always = max(flight.parameters.get("MOT_YAW_HEADROOM", 200.0), 100.0) / 1000.0
    if vehicle.mixer is None:
        return yaw < always
    turning = np.abs(vehicle.mixer[:, 2]) > 1e-9
    factors = vehicle.mixer[turning]
    level = np.clip(control[:, 3:4], 0.0, 0.5) + control[:, :2] @ factors[:, :2].T
    up = control[:, 2:3] * factors[:, 2] > 0
    room = np.where(up, 1.0 - level, level) / np.abs(factors[:, 2])
    return yaw < np.maximum(always, 0.95 * room.min(axis=1, initial=np.inf))


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
