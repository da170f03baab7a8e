"""FPV flights for tests: a quadrotor of 5 inches that rolls, flips, spins, dives and punches out, as Betaflight would fly and log it.

    dn_i/dt = (sqrt f(u_i) - n_i) / tau,   T_i = (1 - loss_i) n_i^2,   d omega/dt = k B T + r B_yaw dn/dt - d omega + air

n: share of full speed; f(u): thrust curve; k: gain of each axis for one full thrust; r: torque by the rotors' own inertia; air: white and
coloured noise, stronger after the throttle is cut (propwash). Sizes are those of the real logs in docs/aerobatic.md. A motor that
desyncs gets nothing and runs down, then up again. Attitude and height are not simulated: nothing here depends on them. Many flights run
at once, as arrays (flights, ...).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rotorwatch.airframes import betaflight
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import ThrustCurve
from rotorwatch.logs import esc_columns

DT = 0.001
EXPO, LAG_S, RUNS_DOWN_S, IDLE_SPIN_UP = 0.65, 0.025, 0.035, 0.25
GAIN, INERTIA, DAMPING = np.array([230.0, 210.0, 35.0]), 2.5, np.array([2.0, 2.0, 1.0])
HOVER, IDLE = 0.25, 0.055  # command in hover of a thrust of eight times the weight; at rest in the air
WHITE, AIR, AIR_S, WASH = 4.0, 12.0, 0.03, 3.0  # rad/s^2 each 4 ms; rad/s^2 and correlation; times as much in propwash
GYRO = 0.015  # rad/s
PROPORTIONAL, INTEGRAL, DERIVATIVE = np.array([0.045, 0.048, 0.06]), 0.2, 0.0008
D_S, STICK_S = 0.0016, 0.03
FULL_SPEED = 3000.0  # rad/s
GROUND_S = 2.0  # motors off, at both ends
MIX = np.sign(betaflight.build("quad-x", ThrustCurve(0.0, 1.0, EXPO)).effectiveness()[:3])


@dataclass(frozen=True)
class Moment:
    """A fault in flight `flight`: rotor (from 0), start [s], lasting [s]; loss: None for a desync, else share of thrust lost, by a damaged
    propeller or by a motor that turns slower."""

    flight: int
    rotor: int
    start: float
    lasting: float
    loss: float | None = None
    slower: bool = False


@dataclass(frozen=True)
class Push:
    """A knock in flight `flight`: angular acceleration (3,) [rad/s^2] from start [s], lasting [s]."""

    flight: int
    start: float
    lasting: float
    acceleration: tuple[float, float, float]


def fly(
    count: int, duration_s: float, seed: int = 0, wrong: tuple[Moment | Push, ...] = (), rpm: bool = False,
    expo: float | Sequence[float] = EXPO,
) -> list[Flight]:  # fmt: skip
    """So many flights. rpm: speeds are logged. expo: of the motors' thrust curve, one for all or one each; the airframe's is EXPO."""
    curve = np.broadcast_to(np.asarray(expo, float), count)[:, None]
    rng = np.random.default_rng(seed)
    steps = round(duration_s / DT)
    wanted, throttle, wash = _pilot(rng, count, steps)
    alive = np.ones((steps, count, 4), np.float32)
    weak, pushed = np.ones_like(alive), np.zeros((steps, count, 3), np.float32)
    for w in wrong:
        rows = slice(round(w.start / DT), round((w.start + w.lasting) / DT))
        if isinstance(w, Push):
            pushed[rows, w.flight] = w.acceleration
        elif w.loss is None:
            alive[rows, w.flight, w.rotor] = 0.0
        elif w.slower:
            alive[rows, w.flight, w.rotor] = np.sqrt(1.0 - w.loss)
        else:
            weak[rows, w.flight, w.rotor] = 1.0 - w.loss
    omega, n, air, total, slope, before = (np.zeros((count, k)) for k in (3, 4, 3, 3, 3, 3))
    out = {name: np.zeros((steps, count, k), np.float32) for name, k in (("u", 4), ("gyro", 3), ("n", 4))}
    keep, white = np.exp(-DT / AIR_S), WHITE * np.sqrt(0.004 / DT)
    stirred, rough = np.sqrt(1.0 - keep**2) * AIR, 1.0 + (WASH - 1.0) * wash[:, :, None]
    for k in range(steps):
        drawn = rng.standard_normal((3, count, 3))
        gyro = omega + GYRO * drawn[0]
        slope += DT / (D_S + DT) * ((gyro - before) / DT - slope)
        before = gyro
        error = wanted[k] - gyro
        flies = throttle[k] > 0.0
        total = np.minimum(np.maximum(total + error * DT * flies[:, None], -0.5), 0.5)
        u = _mixed(PROPORTIONAL * error + INTEGRAL * total - DERIVATIVE * slope, throttle[k])
        u = np.where(flies[:, None], u, 0.0)
        goal = np.sqrt((1.0 - curve) * u + curve * u * u) * alive[k]
        lag = np.where(goal > n, LAG_S * (1.0 + IDLE_SPIN_UP * (n < 0.25)), RUNS_DOWN_S)
        speeding = (goal - n) / lag
        n = n + DT * speeding
        air = keep * air + stirred * drawn[1]
        noise = (air + white * drawn[2]) * rough[k]
        turning = GAIN * ((n * n * weak[k]) @ MIX.T) - DAMPING * omega + noise + pushed[k]
        turning[:, 2] += INERTIA * (speeding @ MIX[2])
        omega = (omega + DT * turning) * flies[:, None]
        out["u"][k], out["gyro"][k], out["n"][k] = u, gyro, n
    time = DT * np.arange(steps)
    u, gyro, n = (out[name].astype(float) for name in ("u", "gyro", "n"))
    return [_logged(time, u[:, j], gyro[:, j], wanted[:, j], n[:, j], throttle[:, j], rng, rpm) for j in range(count)]


def _mixed(torque: np.ndarray, throttle: np.ndarray) -> np.ndarray:
    """Commands (count, 4) as the firmware mixes them: torque before throttle, within the outputs' range (airmode)."""
    turn = torque @ MIX
    least, most = turn.min(axis=1), turn.max(axis=1)
    less = np.maximum((most - least) / (1.0 - IDLE), 1.0)
    turn /= less[:, None]
    middle = np.minimum(np.maximum(throttle, IDLE - least / less), 1.0 - most / less)
    return middle[:, None] + turn


def _pilot(rng: np.random.Generator, count: int, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(wanted rates (steps, count, 3) rad/s, throttle (steps, count), propwash (steps, count) 0 to 1)."""
    rates, throttle, wash = np.zeros((steps, count, 3)), np.zeros((steps, count)), np.zeros((steps, count))
    edge = round(GROUND_S / DT)
    for j in range(count):
        k = edge
        while k < steps - edge:
            long = round(rng.uniform(0.3, 1.0) / DT)
            rows = slice(k, min(k + long, steps - edge))
            kind = rng.choice(5, p=(0.3, 0.25, 0.1, 0.15, 0.2)) if k > edge else 0
            throttle[rows, j] = rng.uniform(0.2, 0.4)
            rates[rows, j] = rng.normal(0.0, 0.6, 3)
            if kind == 0:
                throttle[rows, j] = HOVER * rng.uniform(0.9, 1.15)
            elif kind == 1:
                rates[rows, j, rng.integers(2)] = rng.choice((-1, 1)) * rng.uniform(5.0, 13.0)
            elif kind == 2:
                rates[rows, j, 2] = rng.choice((-1, 1)) * rng.uniform(2.0, 6.0)
            elif kind == 3:
                rows = slice(k, min(k + round(rng.uniform(0.2, 0.6) / DT), rows.stop))
                throttle[rows, j] = IDLE
                wash[rows.stop : rows.stop + 400, j] = 1.0
            else:
                rows = slice(k, min(k + long // 2, rows.stop))
                throttle[rows, j] = rng.uniform(0.45, 0.9)
            k = rows.stop
        throttle[steps - edge :, j], wash[steps - edge :, j] = 0.0, 0.0
    keep = np.exp(-DT / STICK_S)
    for k in range(1, steps):
        rates[k] = keep * rates[k - 1] + (1.0 - keep) * rates[k]
        throttle[k] = np.where(throttle[k] > 0.0, keep * throttle[k - 1] + (1.0 - keep) * throttle[k], 0.0)
    return rates, throttle, wash


def _logged(time, u, gyro, wanted, n, throttle, rng, rpm: bool) -> Flight:
    """A flight as logged."""
    signals = {
        "motors": Signal(time, u, ("r1", "r2", "r3", "r4"), "1", "body", "motor[0] .."),
        "gyro": Signal(time, gyro, ("x", "y", "z"), "rad/s", "FRD", "gyroUnfilt"),
        "rates": Signal(time, gyro, ("x", "y", "z"), "rad/s", "FRD", "gyroADC"),
        "rates_wanted": Signal(time, wanted, ("x", "y", "z"), "rad/s", "FRD", "setpoint[0..2]"),
        "throttle": Signal(time, throttle, ("out",), "1", "", "setpoint[3]"),
    }
    if rpm:
        speed = np.abs(FULL_SPEED * n + rng.normal(0.0, 8.0, n.shape))
        telemetry = esc_columns.build(time, {"speed": speed}, range(1, 5), "eRPM[0] ..", [])
        assert telemetry is not None
        signals["esc"] = telemetry
    facts = {"motor_low": IDLE, "motor_high": 1.0, "mixer": MIX.T.tolist()}
    return Flight("simulated", "Betaflight", signals, float(time[-1]), firmware="simulated FPV flight", facts=facts, name="fpv")
