"""An unbalance put into a real log that has rotor speeds, and simulated flights of unbalanced rotors.

`inject` adds the tone of a further unbalance at the angle of a rotor's logged speed: what the sensor would have measured besides, had the
propeller lost a piece. `simulated` draws whole flights: speeds that a controller moves, unbalances that balancing has left, a frame that
bends, noise, and a log with a sensor's and the telemetry's rates, delays and steps.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch_lab.simulation import vibration

NAMES = ("x", "y", "z")
EASES_S = 1.0
WINDOW_S = 0.15


def inject(
    flight: Flight, rotor: int, amount: float, onset: float, phase: float = 0.0, sensor: str = "raw_accel", times: float = 1.0
) -> Flight:
    """The flight as its sensor would have measured it had a rotor got a further unbalance of `amount` g mm/kg at `onset` s.

    rotor: 1-based. phase: of the new unbalance against the logged angle at the log's begin [rad]; as logged speeds are rounded, the true
    angle drifts away from it, and old and new unbalance add up at any angle. sensor: an accelerometer's signal. times: from then on the
    rotor's own tone is so many times as strong, in its own phase. The speeds must be logged. Raises ConfigError where the flight lacks
    them, the sensor or the rotor."""
    if not flight.has("esc", sensor):
        raise ConfigError(f"An unbalance needs the rotors' speeds (signal esc) and the signal {sensor}; this flight lacks them.")
    esc, signal = flight["esc"], flight[sensor]
    names = [name for name in esc.columns if name.startswith("speed")]
    if f"speed{rotor}" not in names:
        raise ConfigError(f"Rotor {rotor}: the flight has no speed of it.")
    known = [esc.valid[:, esc.columns.index(name)] for name in names]
    if min(k.sum() for k in known) < 2 or not signal.time[0] <= onset < signal.time[-1]:
        raise ConfigError(f"Onset {onset:g} s lies outside the flight, or a rotor's speed is never known.")
    columns = [(esc.time[k], esc.values[k, esc.columns.index(name)]) for name, k in zip(names, known)]
    speed = np.stack([np.interp(signal.time, *column) for column in columns], axis=1)
    angle, one = vibration.angles(signal.time, speed), names.index(f"speed{rotor}")
    later = (signal.time >= onset)[:, None]
    new = vibration.acceleration(angle[:, [one]] + phase, speed[:, [one]], np.array([amount]), vibration.rigid(np.ones(1)))
    if times != 1.0:
        new = new + (times - 1.0) * _own(signal, angle, one)
    changed = replace(signal, values=signal.values + np.where(later, new, 0.0))
    facts = {**flight.facts, "injected": {"rotors": [rotor], "imbalance": float(amount), "times": float(times), "onset_s": float(onset)}}
    return replace(flight, signals={**flight.signals, sensor: changed}, facts=facts)


def _own(signal: Signal, angle: np.ndarray, one: int) -> np.ndarray:
    """(n, 3) the tone of a rotor (from 0) in a sensor: all rotors' fitted together in windows of WINDOW_S that overlap by half, and the
    amplitude between their middles."""
    time, count = signal.time, max(round(WINDOW_S * signal.rate_hz), 4 * angle.shape[1])
    middles, found = [], []
    for start in range(0, len(time) - count + 1, max(1, count // 2)):
        rows = slice(start, start + count)
        x = np.linspace(-1.0, 1.0, count)
        tones = np.exp(1j * angle[rows])
        columns = np.column_stack([x[:, None] ** np.arange(5), np.real(tones), np.imag(tones)])
        fitted = np.linalg.lstsq(columns, signal.values[rows], rcond=None)[0][5:]
        middles.append(time[start + count // 2])
        found.append(fitted[one] - 1j * fitted[angle.shape[1] + one])
    amplitude = np.array(found)
    smooth = np.stack([np.interp(time, middles, np.real(a)) + 1j * np.interp(time, middles, np.imag(a)) for a in amplitude.T], axis=1)
    return np.real(smooth * np.exp(1j * angle[:, [one]]))


class Drawn(NamedTuple):
    """A simulated flight. rotor: the one that changed (from 1, 0 for none), at `onset` s. unbalance (R,): of its rotors before, g mm/kg."""

    flight: Flight
    rotor: int
    onset: float
    unbalance: np.ndarray


def simulated(
    seed: int, rotors: int = 4, duration: float = 90.0, rate_hz: float = 1000.0, telemetry_hz: float = 0.0, times: float = 1.0,
    adds: float = 0.0, speeds: bool = True,
) -> Drawn:  # fmt: skip
    """A drawn flight of a vehicle with so many rotors. telemetry_hz: of the rotor speeds; 0: as often as the sensor. times, adds: a drawn
    rotor's unbalance is multiplied in flight, and gets so many g mm/kg more, at a drawn angle. speeds: whether they are logged; else the
    commands are (`_commands`)."""
    rng = np.random.default_rng([seed, rotors])
    usual = np.exp(rng.uniform(np.log(500.0), np.log(2000.0)))  # rad/s: 80 to 320 turns a second
    time = np.arange(0.0, duration, 1.0 / rate_hz)
    speed = usual * (1.0 + rng.normal(0.0, 0.04, rotors)) * (1.0 + _moves(time, rotors, rng))
    spins = np.where(np.arange(rotors) % 2, -1.0, 1.0)
    frame = vibration.drawn(spins, usual, rng)
    # Balanced propellers shake by 1 to 4 m/s^2 at hover speed.
    scale = np.exp(rng.uniform(0.0, np.log(4.0))) / usual**2 / vibration.MICRO / np.sqrt(0.5 * np.pi)
    unbalance = rng.rayleigh(scale, rotors)
    rotor, onset = int(rng.integers(rotors)) + 1, float(rng.uniform(0.3, 0.7) * duration)
    vector = np.tile(unbalance.astype(complex), (time.size, 1))
    late = np.clip((time - onset) / EASES_S, 0.0, 1.0) if adds == 0.0 else (time >= onset).astype(float)
    vector[:, rotor - 1] *= 1.0 + (times - 1.0) * late
    vector[:, rotor - 1] += adds * np.exp(2j * np.pi * rng.random()) * late
    angle = vibration.angles(time, speed) + rng.uniform(0.0, 2.0 * np.pi, rotors)
    passing = (int(rng.integers(2, 4)), float(rng.uniform(0.0, 0.5) * scale))
    values = vibration.acceleration(angle, speed, vector, frame, passing)
    values += rng.uniform(0.3, 2.0) * rng.standard_normal(values.shape) + _moves(time, 3, rng) * 40.0
    esc = vibration.reported(
        time, speed, telemetry_hz or rate_hz, float(rng.uniform(0.001, 0.02)), float(rng.uniform(0.0, 3.0)), each=bool(telemetry_hz)
    )
    sensor = Signal(time, values, NAMES, "m/s^2", "FRD", "simulated")
    signals = {"raw_accel": sensor, "esc": esc} if speeds else {"raw_accel": sensor, "motors": _commands(time, speed, rng)}
    flight = Flight("simulated", "ArduPilot", signals, duration, name=f"simulated {seed}")
    changed = times != 1.0 or adds != 0.0
    return Drawn(flight, rotor if changed else 0, onset, unbalance)


def _commands(time: np.ndarray, speed: np.ndarray, rng: np.random.Generator) -> Signal:
    """The commands that were followed by speeds (n, R) at times (n,): speed = gain command^curve behind a lag. Motors and propellers differ
    by 1 %, gusts and friction change the speed by as much within 40 ms (as in 17 real flights of a quadrotor), and the battery sags."""
    rotors = speed.shape[1]
    lag, curve, hover, sag = (float(rng.uniform(*ends)) for ends in ((0.02, 0.06), (0.5, 0.9), (0.2, 0.5), (0.0, 0.08)))
    knots = np.arange(time[0], time[-1] + 0.08, 0.04)
    missed = np.stack([np.interp(time, knots, column) for column in rng.normal(0.0, 0.012, (knots.size, rotors)).T], axis=1)
    wanted = np.log(speed / speed.mean()) - missed - rng.normal(0.0, 0.01, rotors) + sag * ((time - time[0]) / time[-1])[:, None]
    command = hover * np.exp((wanted + lag * np.gradient(np.log(speed), time, axis=0)) / curve)
    rows = np.arange(0, time.size, max(1, round(time.size / (time[-1] - time[0]) / float(rng.choice([50.0, 100.0, 400.0])))))
    return Signal(time[rows], np.clip(command, 0.0, 1.0)[rows], tuple(f"r{k + 1}" for k in range(rotors)), "1", "", "simulated")


def _moves(time: np.ndarray, columns: int, rng: np.random.Generator) -> np.ndarray:
    """(n, columns) relative changes that a controller makes: gusts within a second, manoeuvres within several."""
    total = np.zeros((time.size, columns))
    for every, size in ((0.3, 0.012), (4.0, 0.03)):
        knots = np.arange(time[0], time[-1] + 2.0 * every, every)
        off = rng.normal(0.0, size, (knots.size, columns))
        total += np.stack([np.interp(time, knots, column) for column in off.T], axis=1)
    return total
