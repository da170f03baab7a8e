"""From logged commands to rotor thrusts, and sets of rotors that their thrusts cannot distinguish.

A rotor's command u is logged slowly (ArduPilot: 10 Hz), the rate controller's output c = (roll, pitch, yaw, throttle) often fast. The
autopilot turns c into thrust demands with its mixer M and its gain g (air density),

    t = g M c,        m(u) = t        with m the thrust curve assumed by the autopilot (battery compensation included),

so that the slow m(u) verifies and scales a fast rebuilt t, from which u and the thrust f(u) follow. ArduPilot's m is f; PX4 often assumes
a straight line (THR_MDL_FAC 0) that no motor follows: ``vehicle.extra["mixer_expo"]``. engine/intake/mixer.py defines this; here it runs
over a whole flight.

All functions here are causal: a value at time s uses nothing logged after s.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.compiling.running import Rows
from rotorwatch.engine.definition import ENGINE, KINDS, Part, craft, pieces
from rotorwatch.engine.events import calls
from rotorwatch.engine.intake import mixer
from rotorwatch.engine.intake.front import HELD_S
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import ThrustCurve, Vehicle

Spans = tuple[tuple[float, float], ...]
FASTER = 1.5  # ratio of their numbers of samples
COARSE, ENOUGH_STEPS = 0.02, 100  # share of the range below which outputs never change, seen over so many changes
YAW_HEADROOM = 200.0  # MOT_YAW_HEADROOM where it is not logged: ArduPilot's default


def motor_thrusts(flight: Flight, vehicle: Vehicle) -> Signal:
    """Share of full thrust f(u) of every rotor, columns r1..rN, unit 1, at the times of signal ``motors``.

    The battery ratio is the last one logged (signal ``lift``), 1 where none is; an airframe whose ``extra`` has ``full_voltage`` drives
    its motors straight from the battery, so its voltage (signal ``battery``) is used.
    """
    motors = flight["motors"]
    ratio, full = battery_ratio(flight, motors.time), vehicle.extra.get("full_voltage")
    if full and "battery" in flight.signals:
        battery = flight["battery"]
        ok = battery.valid[:, 0] & (battery.values[:, 0] > 0.5 * full)
        ratio = hold(battery.time[ok], battery.values[ok, 0] / full, motors.time, before=1.0)
    thrust = vehicle.curve(motors.values, ratio[:, None])
    return Signal(motors.time, thrust, motors.columns, "1", "body", motors.source, motors.valid)


def voltages(flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """(time (m,), (m, 1)): battery voltage as a share of full, filtered by the autopilot, where it was logged."""
    lift = flight.signals.get("lift")
    if lift is None or "voltage_ratio" not in lift.columns:
        return np.empty(0), np.empty((0, 1))
    column = lift.columns.index("voltage_ratio")
    ok = lift.valid[:, column] & (lift.values[:, column] > 0.3)
    return lift.time[ok], lift.values[ok, column, None]


def battery_ratio(flight: Flight, times: np.ndarray) -> np.ndarray:
    """The last of `voltages` before each time; else 1."""
    time, ratio = voltages(flight)
    return hold(time, ratio[:, 0], times, before=1.0)


def hold(time: np.ndarray, values: np.ndarray, at: np.ndarray, before: float = 0.0) -> np.ndarray:
    """The last of `values` (n,) or (n, k) known at each of the times `at`; `before` where there is none yet."""
    index = np.searchsorted(time, at, side="right") - 1
    if not len(time):
        return np.full((len(at), *values.shape[1:]), before)
    held = values[np.maximum(index, 0)].copy()
    held[index < 0] = before
    return held


def rotor_thrusts(flight: Flight, vehicle: Vehicle) -> Signal:
    """Rotor thrusts: `mixed_thrusts` where valid, the last `motor_thrusts` elsewhere."""
    return better(motor_thrusts(flight, vehicle), mixed_thrusts(flight, vehicle))


def better(logged: Signal, mixed: Signal | None) -> Signal:
    """Rebuilt thrusts where valid, with the last logged ones in place of the others."""
    if mixed is None:
        return logged
    rows, values, valid = np.flatnonzero(~mixed.whole), mixed.values, mixed.valid
    if rows.size:
        values[rows] = np.where(valid[rows], values[rows], hold(logged.time, logged.values, mixed.time[rows]))
        age = mixed.time[rows] - hold(logged.time, logged.time, mixed.time[rows], before=-np.inf)
        valid[rows] |= hold(logged.time, logged.valid, mixed.time[rows], before=False) & (age < HELD_S)[:, None]
    return Signal(mixed.time, values, logged.columns, "1", "body", mixed.source, valid, made=True)


def mixed_thrusts(flight: Flight, vehicle: Vehicle) -> Signal | None:
    """Rotor thrusts rebuilt from the rate controller's output, at its times; None when that adds nothing.

    Columns and unit as in `motor_thrusts`. None: no ``control`` signal, or it is not faster than ``motors``. ``valid`` is False where the
    last logged command is better than the rebuilt thrust: outputs that reach their limits, yaw beyond the mixer's headroom, and any rotor
    whose last logged command differed by more than 0.05 of full thrust (thrust boost, spool-up, an overridden output).
    """
    if not faster_control(flight):
        return None
    checks, thrust, ok = _mixed(flight, vehicle)
    if not len(checks["time"]):
        return None
    control = flight["control"]
    source = f"{control.source} through the mixer"
    return Signal(control.time, thrust, flight["motors"].columns, "1", "body", source, ok, made=True)


def faster_control(flight: Flight) -> bool:
    """Return whether the rate controller's output is logged so much faster than the rotors' commands, or, as these are rounded, so much
    finer, that thrusts are worth rebuilding from it."""
    if not flight.has("control", "motors"):
        return False
    control, motors = flight["control"], flight["motors"]
    if control.rate_hz >= FASTER * motors.rate_hz:
        return True
    steps = np.abs(np.diff(motors.values, axis=0))
    steps, (low, high) = steps[steps > 0.0], output_range(flight)
    coarse = steps.size > ENOUGH_STEPS and steps.min() > COARSE * (high - low)
    return bool(coarse and FASTER * control.rate_hz >= motors.rate_hz)


class Comparison(NamedTuple):
    """Logged and rebuilt demand at the m motor samples that have control samples around them.

    time (m,): of the motor sample. known (m,): when its comparison could be made (the later control sample has arrived). demand (m, n):
    logged m(u). demanded (m, n): rebuilt, as if outputs had no limits. deviation (m, n): logged minus rebuilt within the limits.
    yaw_granted (m,): the mixer grants the whole yaw demand. gain (m,): of the mixer, estimated right after this sample. rows: the same in
    the definitions' form.
    """

    time: np.ndarray
    known: np.ndarray
    demand: np.ndarray
    demanded: np.ndarray
    deviation: np.ndarray
    yaw_granted: np.ndarray
    gain: np.ndarray
    rows: Rows


def compare(flight: Flight, vehicle: Vehicle) -> Comparison:
    """Compare the rebuilt demands with the logged ones and learn the mixer's gain (all factors of an unknown mixer) meanwhile. Needs
    signals ``motors`` and ``control``."""
    rows, _, _ = _mixed(flight, vehicle)
    demand, demanded, deviation = (rows[name][:, : len(vehicle.rotors)] for name in ("thrust", "demanded", "deviation"))
    return Comparison(rows["time"], rows["known"], demand, demanded, deviation, rows["yaw_granted"], rows["gain"], rows)


def _mixed(flight: Flight, vehicle: Vehicle) -> tuple[Rows, np.ndarray, np.ndarray]:
    """Run front.mixer over a flight: its comparisons, and for each sample of the rate controller the thrusts (N, n) and their validity."""
    control, n = flight["control"], len(vehicle.rotors)
    parts = [Part.of(flight, "motors"), Part.of(flight, "control", 4), Part("voltage", *voltages(flight))]
    state, craft, done = ENGINE.new(mixer.Mixer), laid_out(vehicle, flight), ENGINE.new(calls.Done)
    checks, thrust, ok, at, waiting = [], np.empty((len(control), n)), np.empty((len(control), n), bool), 0, 0
    for samples in pieces(parts):
        outputs, controls = (int((samples.kind == KINDS[name]).sum()) for name in ("motors", "control"))
        waiting += outputs  # for a comparison: each has one at most
        found, made = ENGINE.array(mixer.Comparison, waiting + 1), ENGINE.array(calls.Mixed, max(controls, 1))
        arguments = (len(samples), samples.kind, samples.time, samples.at, samples.values)
        ENGINE.call(calls.mix, state, craft, *arguments, found, made, done)
        checks.append(found.cut(int(done["rows"][0])))
        waiting -= int(done["rows"][0])
        thrust[at : at + controls], ok[at : at + controls] = (made[name][:controls, :n] for name in ("thrust", "ok"))
        at += controls
    return Rows.joined(checks), thrust, ok


def laid_out(vehicle: Vehicle, flight: Flight) -> Rows:
    """The vehicle in the definitions' form."""
    headroom = flight.parameters.get("MOT_YAW_HEADROOM", YAW_HEADROOM)
    return craft(len(vehicle.rotors), **table(vehicle, output_range(flight), headroom))


def table(vehicle: Vehicle, output: tuple[float, float], headroom: float = YAW_HEADROOM) -> dict[str, Any]:
    """The fields of front.vehicle.Vehicle. output: ends of the outputs' range as defined by the autopilot, in their unit."""
    n, curve = len(vehicle.rotors), vehicle.curve
    return {
        "effectiveness": vehicle.effectiveness(), "mixer": np.zeros((n, 4)) if vehicle.mixer is None else np.asarray(vehicle.mixer, float),
        "u_min": curve.u_min, "u_max": curve.u_max, "output_low": output[0], "output_high": max(output[1], output[0] + 1e-6),
        "expo": curve.expo, "expo_sd": curve.believed[1], "mixer_expo": mixer_curve(vehicle).expo, "yaw_headroom": yaw_always(headroom),
        "mixer_known": vehicle.mixer is not None, "rests_at_minimum": bool(vehicle.extra.get("rests_at_minimum", False)),
    }  # fmt: skip


def output_range(flight: Flight) -> tuple[float, float]:
    """Ends of the outputs' range as defined by the autopilot, in their unit."""
    if flight["motors"].unit != "us":
        return 0.0, 1.0
    for ends in (flight.facts, ("pwm_min", "pwm_max")), (flight.parameters, ("MOT_PWM_MIN", "MOT_PWM_MAX")):
        low, high = (float(ends[0].get(name) or 0.0) for name in ends[1])
        if 0.0 < low < high:  # one of them alone is no range: as airframes/ardupilot.py has it
            return low, high
    return 1000.0, 2000.0


def yaw_always(headroom: float = YAW_HEADROOM) -> float:
    """Yaw that ArduPilot's mixer grants in any case: its parameter MOT_YAW_HEADROOM, in thousandths, within its limits."""
    return float(np.clip(np.nan_to_num(headroom, nan=YAW_HEADROOM), 100.0, 500.0)) / 1000.0


def mixer_curve(vehicle: Vehicle) -> ThrustCurve:
    """Thrust curve assumed by the autopilot's mixer; the vehicle's own unless ``extra`` has ``mixer_expo``."""
    return replace(vehicle.curve, expo=float(vehicle.extra.get("mixer_expo", vehicle.curve.expo)))


def drive(expo: float, thrust: np.ndarray) -> np.ndarray:
    """Inverse of the thrust curve: (command share times battery ratio) that gives `thrust`, 0 or more."""
    if expo < 1e-6:
        return thrust
    return (np.sqrt((1.0 - expo) ** 2 + 4.0 * expo * thrust) - (1.0 - expo)) / (2.0 * expo)


def within(time: np.ndarray, spans: Spans) -> np.ndarray:
    """(n,) bool: times within one of the spans."""
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
            continue  # common rotors cancel: the rest is a pair of smaller sets
        columns = np.concatenate([effectiveness[:, one], -effectiveness[:, other]], axis=1)
        # Cheap test first: there is no solution unless the columns are linearly dependent.
        if np.linalg.svd(columns, compute_uv=False)[-1] > 1e-9 and columns.shape[1] <= columns.shape[0]:
            continue
        answer = linprog(np.ones(columns.shape[1]), A_eq=columns, b_eq=np.zeros(len(columns)), bounds=(1, None))
        if answer.status == 0:
            found.append((tuple(k + 1 for k in one), tuple(k + 1 for k in other)))
    return tuple(found)
