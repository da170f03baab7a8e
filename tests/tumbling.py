"""Multirotors that fall, by a small model of their own: a rigid body, first-order motors, a controller, a ground. For tests of `upset`.

It shares nothing with `rotorwatch_lab.simulation` but the frames' geometry, and is no better than it must be: torques in hover thrusts,
ω' = (B T - D ω + push) / J - k (q r, -p r, 0), thrust along the body's axis, linear drag, a moment of the wind. What a log would hold comes
back as a Flight.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from rotorwatch import airframes
from rotorwatch.engine.motion.allocation import drive
from rotorwatch.flight import Flight, Message, Signal

G, DT, LIFT_S = 9.80665, 0.0025, 3.0
LEGS = 0.4  # from the middle to the line between two feet, in arms
LEFT_DEG, BACK_DEG, GONE_S, BACK_S = (
    60.0,
    30.0,
    2.0,
    1.0,
)  # tilt away from what is wanted: lost, unless it is back so far, so soon, for so long
CRASHES = ("hover", "climb", "cruise", "take-off", "early", "swapped", "disarmed", "gyro", "knock", "power")
STAYS = ("calm", "aerobatics", "gust", "hard landing")


@dataclass(frozen=True)
class Truth:
    """case; rotors (1-based) that fail or are swapped; when it begins [s]; lost: the vehicle tumbled or fell, and did not come back within
    GONE_S; lost_s: since when."""

    case: str
    rotors: tuple[int, ...]
    begins_s: float
    lost: bool
    lost_s: float | None


# For three numbers NumPy's own cross, norm and clip take ten times as long.
def cross(a: np.ndarray, b: np.ndarray) -> list[float]:
    """(3,) the vector product."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]


def length(x: np.ndarray) -> float:
    """The Euclidean norm."""
    return math.sqrt(x @ x)


def clip(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Within bounds."""
    return np.minimum(np.maximum(x, low), high)


def within(x: float, low: float, high: float) -> float:
    """A number within bounds."""
    return min(max(float(x), low), high)


def rotation(q: np.ndarray) -> np.ndarray:
    """(3, 3) body to world of a quaternion, scalar first."""
    w, x, y, z = q.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turned(q: np.ndarray, rate: np.ndarray, dt: float) -> np.ndarray:
    """The quaternion after a turn at body rates."""
    w, v = q[0], q[1:]
    new = np.concatenate([[w - 0.5 * dt * (v @ rate)], v + 0.5 * dt * (w * rate + np.array(cross(v, rate)))])
    return new / length(new)


def towards(axis: np.ndarray) -> np.ndarray:
    """A quaternion whose body z axis points along `axis` in the world, without yaw."""
    z = np.array([0.0, 0.0, 1.0])
    axis = axis / length(axis)
    q = np.array([1.0 + z @ axis, *cross(z, axis)])
    norm = length(q)
    return q / norm if norm > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])


def _lost(time: np.ndarray, away: np.ndarray, gone: np.ndarray) -> float | None:
    """When control was lost: the thrust pointed LEFT_DEG away (n,) from what was wanted, and was not back for BACK_S within
    GONE_S; or the vehicle fell, `gone` (n,) bool. `away` is 0 on the ground, and a vehicle that lies there has not come back."""
    if gone.any():
        return float(time[np.argmax(gone)])
    for k in np.flatnonzero((away > LEFT_DEG) & (np.concatenate([[0.0], away[:-1]]) <= LEFT_DEG)):
        back = (away[k : k + round((GONE_S + BACK_S) / DT)] < BACK_DEG) & (away[k : k + round((GONE_S + BACK_S) / DT)] > 0.0)
        stays = np.convolve(back, np.ones(round(BACK_S / DT)), "valid") > round(BACK_S / DT) - 0.5
        if not stays.any():
            return float(time[k])
    return None


@functools.cache
def fly(frame: str, case: str, seed: int, log_hz: float = 10.0, duration: float = 26.0, later: float = 17.0) -> tuple[Flight, Truth]:
    """One flight of an ArduPilot frame ("quad-x") and what truly happened. log_hz: of the outputs; later: when what happens in
    cruise or hover begins [s]."""
    rng, more = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    vehicle = airframes.named(f"ardupilot-{frame}")
    B = vehicle.effectiveness()
    n = B.shape[1]
    J = n * np.array([rng.uniform(0.004, 0.01), rng.uniform(0.004, 0.01), rng.uniform(0.08, 0.2)])
    D = J * rng.uniform(0.5, 4.0)
    full, lag, drag = rng.uniform(1.9, 2.8), rng.uniform(0.025, 0.06), rng.uniform(0.05, 0.3)
    mix = np.linalg.pinv(B)
    begins = {
        "hover": later,
        "cruise": later + 1.0,
        "climb": LIFT_S + 2.5,
        "early": LIFT_S + rng.uniform(3.0, 7.0),
        "take-off": 0.0,
        "swapped": 0.0,
    }
    begins_s = begins.get(case, later)
    who = tuple(int(r) for r in rng.choice(n, 2, replace=False))
    wind = rng.uniform(0.0, 8.0) * np.array([np.cos(t := rng.uniform(0, 6.3)), np.sin(t), 0.0])
    push = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.7, 1.2, 3) * np.array([25.0, 25.0, 6.0])
    push, caught_s, caught = push * more.uniform(1.0, 2.0), more.uniform(0.6, 1.6), more.uniform(0.5, 2.0)
    bias = np.array([1.5, 0.0, 0.0]) if rng.random() < 0.5 else np.array([0.0, -1.5, 0.0])
    gyro_lies, sinks, moment = more.random() < 0.5, more.uniform(1.5, 3.5), more.uniform(0.0, 0.006) * n
    flat = more.uniform(0.6, 1.0)  # (Jz - Jy) / Jx; J counts yaw in its own, weaker torque
    strongest = more.uniform(10.0, 15.0)  # m/s of wind, in gusts
    along = wind / max(float(np.linalg.norm(wind)), 1e-9)
    shown = case != "aerobatics" or more.random() < 0.5  # wanted attitude logged; else wanted rates alone
    p, v, q, omega, T = np.zeros(3), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(n)
    believed, power, lying, spun, grounded = q.copy(), 1.0, False, 0.0, True
    rows: dict[str, list] = {k: [] for k in ("t", "u", "gyro", "accel", "q", "wanted", "rates", "v", "p", "volts")}
    messages, spike, touched = [Message(0.0, "armed", "armed", 1.0)], np.zeros(3), np.inf
    away, gone = [], []
    trim = rng.normal(0.0, 0.01, 3)
    for k in range(int(duration / DT)):
        t = k * DT
        on = t >= begins_s
        disarmed = (case == "disarmed" and on) or t > touched + 1.0
        if disarmed and len(messages) == 1:
            messages.append(Message(t, "armed", "disarmed", 0.0))
        # What is wanted.
        climb = 0.0 if t < LIFT_S else 60.0 if case == "aerobatics" else 10.0
        goal = np.array([12.0 * np.sin(0.5 * max(t - 10.0, 0.0)) if case == "cruise" else 0.0, 0.0, -climb])
        landing = case == "hard landing" and t > later
        R = rotation(q)
        Rb = R if believed is q else rotation(believed)
        ask = 1.2 * (goal - p) - 1.8 * v
        if landing:
            ask[2] = 2.0 * (sinks - v[2])
        if case == "gyro" and on:
            ask[:2] = 0.0
        ask[:2] = clip(ask[:2], -4.0, 4.0)
        force = np.array([ask[0], ask[1], within(ask[2], -14.0, 5.0) - G])
        wanted = towards(-force)
        if case == "aerobatics" and 12.0 <= t < 20.0:
            spun = spun + DT * 6.0 * (1.0 if (t - 12.0) % 4.0 < 2.0 * np.pi / 6.0 else 0.0)
            wanted = turned(np.array([np.cos(spun / 2), np.sin(spun / 2), 0, 0]), np.zeros(3), DT)
        heading = rotation(wanted)[:, 2]
        axis = Rb.T @ heading
        angle = np.arctan2(np.hypot(axis[0], axis[1]), axis[2])
        lean = np.array([-axis[1], axis[0], 0.0]) / max(np.hypot(axis[0], axis[1]), 1e-9) * angle
        wrong = bias * (1.0 if gyro_lies else 0.35) if case == "gyro" and on else np.zeros(3)
        gyro = omega + (wrong if gyro_lies else 0.0)
        rates = clip(7.0 * lean, -8.0, 8.0)
        if case == "aerobatics" and 12.0 <= t < 20.0 and (t - 12.0) % 4.0 < 2.0 * np.pi / 6.0:
            rates = rates + np.array([6.0, 0.0, 0.0])
        torque = J * np.array([16.0, 16.0, 4.0]) * (rates - gyro)
        level = within(length(force) / G / max(0.5, Rb[2, 2] if case != "aerobatics" else 1.0), 0.0, 0.9 * full)
        ready = within((t - LIFT_S) / 1.0 + 0.05, 0.0, 1.0)
        roll_pitch, yaw = mix @ np.array([torque[0], torque[1], 0, 0]), mix @ np.array([0, 0, torque[2], 0])
        most = np.abs(roll_pitch).max()
        roll_pitch *= min(1.0, 0.5 * full / max(most, 1e-9)) if most > 0.5 * full else 1.0
        yaw *= min(1.0, 0.3 / max(np.abs(yaw).max(), 1e-9))
        T_cmd = clip(level * ready + ready * (roll_pitch + yaw), 0.0, full)
        if disarmed or t < LIFT_S:
            T_cmd = np.zeros(n)
        # What is given.
        given = T_cmd * power
        if case == "swapped":
            given[list(who)] = given[list(who[::-1])]
        if case in ("hover", "climb", "cruise", "take-off", "early") and on:
            given[who[0]] = 0.0
        if case == "power" and on:
            power = max(0.25, power - DT / 0.4)
        T = T + (given - T) * DT / lag
        air = (
            wind
            + ((strongest - np.linalg.norm(wind)) * along if case == "gust" and 12.0 < t < 18.0 and t % 3.0 < 1.5 else 0.0)
            + 0.3 * np.sin(np.array([1.1, 1.7, 0.9]) * t)
        )
        flow = R.T @ (air - v) * (0.0 if grounded else moment)
        M = B[:3] @ T + trim - D * omega + np.array([-flow[1], flow[0], 0.0])
        if grounded:  # a vehicle that stands on its legs turns only against its weight
            weight = LEGS * max(n - B[3] @ T, 0.0)
            M[:2] -= M[:2] * min(1.0, weight / max(float(np.hypot(*M[:2])), 1e-9))
        f_body = np.array([0.0, 0.0, -G * (B[3] @ T) / n])
        f_world = R @ f_body - drag * (v - air) * (0.0 if grounded else 1.0)
        omega_dot = M / J - flat * np.array([omega[1] * omega[2], -omega[0] * omega[2], 0.0])
        if case == "knock" and begins_s <= t < begins_s + 0.02:
            omega_dot = omega_dot + push / 0.02
            f_world = f_world + 4.0 * G * np.array([1.0, 0.3, 0.0])
        elif case == "knock" and begins_s <= t < begins_s + caught_s:  # in a branch
            omega_dot = omega_dot + caught * n * np.sign(push) * np.array([1.0, 1.0, 0.1]) / J
        spike = 0.8 * spike
        if lying:
            omega, v, f_world = 0.9 * omega, np.zeros(3), np.array([0.0, 0.0, -G])
        else:
            free = (B[3] @ T) / n
            if grounded and free * R[2, 2] < 1.02 and p[2] > -0.02:
                v = np.zeros(3)
                omega = omega + DT * omega_dot if free > 0.6 else np.zeros(3)
                f_world[2] = min(f_world[2], -G)  # the ground carries what the rotors do not
            else:
                grounded = grounded and p[2] > -0.1
                omega, v = omega + DT * omega_dot, v + DT * (f_world + np.array([0, 0, G]))
            p = p + DT * v
            lying = lying or (grounded and np.degrees(np.arccos(within(R[2, 2], -1.0, 1.0))) > 80.0)
            if p[2] > 0.0 and not grounded:
                spike = spike + R.T @ np.array([0.0, 0.0, -v[2] / 0.02])
                p[2], lying, touched = 0.0, True, t if landing else np.inf
        omega = clip(omega, -50.0, 50.0)
        q = turned(q, omega, DT)
        believed = turned(believed, omega + wrong, DT) if case == "gyro" else q
        tilt = np.degrees(np.arccos(within(R[:, 2] @ heading, -1.0, 1.0)))
        falls = disarmed or (case == "power" and power < 0.6)
        away.append(tilt if t > LIFT_S and on and not lying else 0.0)
        gone.append(falls and not lying)
        rows["t"].append(t)
        rows["u"].append(T_cmd)
        rows["gyro"].append(gyro)
        rows["accel"].append(R.T @ f_world + spike)
        rows["q"].append(believed)
        rows["wanted"].append(wanted)
        rows["rates"].append(rates)
        rows["v"].append(v)
        rows["p"].append(p)
        rows["volts"].append(16.0 if case != "power" or power == 1.0 else 16.0 * (0.4 + 0.5 * power))
    a = {key: np.array(value) for key, value in rows.items()}
    lost_s = None if case in STAYS else _lost(a["t"], np.array(away), np.array(gone))
    curve = vehicle.curve
    share = np.clip(a["u"] / full, 0.0, 1.0)
    pulse = curve.u_min + (curve.u_max - curve.u_min) * drive(curve.expo, share)
    off = (a["u"].max(axis=1) <= 0.0)[:, None]
    pulse = np.where(off, 1000.0, np.round(pulse))

    def signal(values, hz, columns, unit, noise=0.0, frame="", phase=0.0):
        at = np.unique(np.round(np.arange(phase, duration - DT, 1.0 / hz) / DT).astype(int))
        at = at[at < len(a["t"])]
        rows = values[at] + (rng.normal(0.0, noise, values[at].shape) if noise else 0.0)
        return Signal(a["t"][at], rows, columns, unit, frame, "model")

    fast = max(25.0, min(log_hz, 400.0))
    quaternion = ("w", "x", "y", "z")
    signals = {
        "motors": signal(pulse, log_hz, tuple(f"r{k + 1}" for k in range(n)), "us", phase=0.01),
        "gyro": signal(a["gyro"], fast, ("x", "y", "z"), "rad/s", 0.01, "FRD"),
        "accel": signal(a["accel"], fast, ("x", "y", "z"), "m/s^2", 0.2, "FRD"),
        "attitude": signal(a["q"], 10.0, quaternion, "1", frame="FRD->NED"),
        "rates_wanted": signal(a["rates"], 10.0, ("x", "y", "z"), "rad/s", frame="FRD"),
        **({"attitude_wanted": signal(a["wanted"], 10.0, quaternion, "1", frame="FRD->NED")} if shown else {}),
        "velocity": signal(a["v"], 10.0, ("n", "e", "d"), "m/s", frame="NED"),
        "position": signal(a["p"], 10.0, ("n", "e", "d"), "m", frame="NED"),
        "battery": signal(np.stack([a["volts"], np.full(len(a["t"]), 10.0)], axis=1), 5.0, ("voltage", "current"), "V,A"),
    }
    kind = {4: (1.0, 1.0), 6: (2.0, 1.0), 8: (3.0, 1.0)}
    classes = {
        "quad-x": (1, 1),
        "quad-plus": (1, 0),
        "hexa-x": (2, 1),
        "hexa-plus": (2, 0),
        "octa-x": (3, 1),
        "octaquad-x": (4, 1),
        "y6-b": (5, 10),
    }
    frame_class, frame_type = classes.get(frame, kind.get(n, (1.0, 1.0)))
    flight = Flight(
        "model", "ArduPilot", signals, duration, name=f"{frame}-{case}-{seed}", messages=tuple(messages),
        parameters={"FRAME_CLASS": float(frame_class), "FRAME_TYPE": float(frame_type), "MOT_THST_HOVER": 1.0 / full},
        facts={"frame_class": frame_class, "frame_type": frame_type, "pwm_min": 1000.0, "pwm_max": 2000.0},
    )  # fmt: skip
    blamed = tuple(r + 1 for r in (who if case == "swapped" else who[:1])) if case in CRASHES[:6] else ()
    return flight, Truth(case, blamed, begins_s, lost_s is not None, lost_s)
