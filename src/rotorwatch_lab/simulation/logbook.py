"""From a simulated record to the log an autopilot would have written: a `Flight`, with sensor errors and at logging rates.

Nothing of the truth gets in: losses, true speeds and the wind stay outside. `write_truth` is where they go.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.logs import esc_columns
from rotorwatch.logs.series import SHAPES
from rotorwatch_lab.simulation import escs, sensors, trajectories, truth, vibration
from rotorwatch_lab.simulation.logged import LOGGED
from rotorwatch_lab.simulation.multirotor import Plan, Record
from rotorwatch_lab.simulation.prepare import PWM, SPIN, a_compensates, frame_numbers, reported, vehicle
from rotorwatch_lab.simulation.scenario import Scenario

RATES, GROUPS, SOURCES = (LOGGED[part] for part in ("rates", "groups", "sources"))
SUFFIXES = {".bin": "ardupilot", ".ulg": "px4"}
RAW_SOURCES = {"ardupilot": "ACC", "px4": "sensor_accel_fifo"}
JITTER_S = 0.0005  # a record's stamp is up to this much later than its values
ARMED_S = 1.0  # arming, after the log's start
DETECTED_S = 0.5  # after a hop the autopilot says that it has landed
IDLE = 0.1  # ArduPilot's MOT_SPIN_ARM
MAV_TYPE = {4: 2, 6: 13, 8: 14, 12: 29, 10: 35}


def needed(record: Any) -> Any:
    """The parts of a record that log and truth need: much less memory than all of it."""
    return record._replace(omega=(), rates_setpoint=(), wind=())


def flight(scenario: Scenario, plan: Plan, record: Record) -> Flight:
    """The flight as logged. record: of `loop.fly` of a multirotor, recorded `scenario.record_hz` times a second."""
    craft = vehicle(scenario)
    record = _estimated(scenario, record)
    log = _Log(scenario, plan, record)
    ardupilot = scenario.autopilot == "ardupilot"
    armed, disarmed = _arming(plan, record)
    lifted = (record.time > float(plan.way.take_off)) & (record.time < disarmed)
    for begin, cut in trajectories.landings(plan.way):
        lifted &= ~((record.time > cut) & (record.time < begin + float(trajectories.hop_times(plan.way)[0])))
    log.add("motors", "motors", _motors(craft, record, armed, disarmed, lifted, ardupilot), unit="us" if ardupilot else "1")
    log.add("control", "control", record.control)
    shaking = sensors.vibration(record.shake, 2.0 * np.pi * record.phase)
    for name, values, sd in sensors.readings(plan.sensors, record, shaking, log.rng):
        log.add(name, GROUPS[name], values, 0.0 if sd is None else sd)
    log.add("throttle", "power" if ardupilot else "control", record.control[:, 3:])
    log.add("battery", "power", np.stack([record.volts, record.amps], axis=1), np.array([0.01, 0.0]))
    if ardupilot:
        lift = np.stack([record.lift_max, _belief(scenario, record), np.ones_like(record.volts)], axis=1)
        log.add("lift", "power", lift)
    if scenario.logging["esc"]:
        log.add("esc", "power", escs.readings(scenario, plan, record), unit=esc_columns.UNIT)
    log.add("attitude_wanted", "attitude", record.q_setpoint)
    if scenario.logging["raw_hz"]:
        log.signals |= _raw(scenario, plan, record)
    end = float(record.time[-1])
    autopilot = "ArduPilot" if ardupilot else "PX4"
    return Flight(
        format="simulated",
        autopilot=autopilot,
        signals=log.signals,
        duration=end,
        firmware="ArduCopter V4.5.7 (simulated)" if ardupilot else "PX4 v1.15.0 (simulated)",
        vehicle_type="ArduCopter" if ardupilot else "",
        parameters=(_ardupilot_parameters if ardupilot else _px4_parameters)(scenario, craft, plan),
        messages=_messages(plan, armed, disarmed, end, ardupilot),
        name=scenario.name,
        start_us=30_000_000,
        facts={"simulated": True},
    )


def _estimated(scenario: Scenario, record: Record) -> Record:
    """The record as the autopilot's estimator has it."""
    s = scenario.sensors
    if s["reset_s"] is None:
        return record
    tilt, yaw = (float(np.radians(s[f"reset_{name}_deg"])) for name in ("tilt", "yaw"))
    rng = np.random.default_rng([scenario.seed, 5])
    return sensors.jumped(record, s["reset_s"], tilt, yaw, s["reset_m_s"], rng)


class _Log:
    """Collects signals: every one at the rate of its group, from the group's own phase, stamped with a little jitter."""

    def __init__(self, scenario: Scenario, plan: Plan, record: Record):
        self.record, self.signals = record, {}
        self.rng = np.random.default_rng([scenario.seed, 2])
        rates = RATES[scenario.autopilot][scenario.logging["profile"]]
        self.sources = SOURCES[scenario.autopilot]
        full, self.rows, self.time = scenario.record_hz, {}, {}
        for k, (group, rate) in enumerate(rates.items()):
            stride = round(full / rate)
            self.rows[group] = np.arange(k % stride, len(record.time), stride)
            late = self.rng.uniform(0.0, JITTER_S, self.rows[group].size)
            self.time[group] = np.round(record.time[self.rows[group]] + late, 6)

    def add(self, name: str, group: str, values: np.ndarray, sd: Any = 0.0, unit: str = "") -> None:
        """Log values (T, k), one row per record, at the group's times; sd: of white noise on each, a number or (k,)."""
        rows = self.rows[group]
        values = np.asarray(values, float)[rows]
        values = values + np.asarray(sd) * self.rng.standard_normal(values.shape)
        if name == "motors":
            columns, frame = tuple(f"r{k + 1}" for k in range(values.shape[1])), ""
        elif name == "esc":
            n = values.shape[1] // len(esc_columns.QUANTITIES)
            columns, frame = esc_columns.names(range(1, n + 1)), ""
        else:
            columns, unit, frame, _ = SHAPES[name]
        self.signals[name] = Signal(self.time[group], values, columns, unit, frame, self.sources.get(name, ""))


def _arming(plan: Plan, record: Record) -> tuple[float, float]:
    """(armed s, disarmed s): at the end of the flight, or a second after the crash."""
    down = float(trajectories.touch_down(plan.way)) + 1.0
    crash = np.flatnonzero(np.asarray(record.flies) < 0.5)
    return ARMED_S, min(down, float(record.time[crash[0]]) + 1.0 if crash.size else np.inf)


def _raw(scenario: Scenario, plan: Plan, record: Record) -> dict[str, Signal]:
    """The unfiltered accelerometer of a frame that passes the rotors' vibration, and with `esc` the rotors' speeds as often."""
    rng, s, hz = np.random.default_rng([scenario.seed, 6]), scenario.sensors, scenario.logging["raw_hz"]
    time = np.arange(float(record.time[0]), float(record.time[-1]), 1.0 / hz)
    turning = 2.0 * np.pi * float(plan.sensors.full_turns) * escs.turning(scenario, record)
    speed = np.stack([np.interp(time, record.time, w) for w in turning.T], axis=1)
    rotors, usual = speed.shape[1], float(np.median(speed[speed > 0.0])) if (speed > 0.0).any() else 1.0
    unbalance = np.tile(rng.rayleigh(s["imbalance"] / np.sqrt(0.5 * np.pi), rotors).astype(complex), (time.size, 1))
    changed = min(s["imbalance_rotor"], rotors) - 1
    unbalance[:, changed] *= np.where(time >= s["imbalance_onset_s"], s["imbalance_times"], 1.0)
    for fault in scenario.faults:  # the piece that a blade lost is missing at any angle to the old unbalance
        if fault["kind"] == "chipped":
            grown = np.clip((time - fault["onset_s"]) / max(fault["ramp_s"], 1e-9), 0.0, 1.0)
            unbalance[:, fault["rotor"] - 1] += vibration.chip(fault["strength"], usual) * grown * np.exp(2j * np.pi * rng.random())
    frame = vibration.drawn(np.sign([r.spin for r in vehicle(scenario).rotors]), usual, rng)
    angle = vibration.angles(time, speed) + rng.uniform(0.0, 2.0 * np.pi, rotors)
    values = np.stack([np.interp(time, record.time, a) for a in record.accel.T], axis=1)
    values = values + vibration.acceleration(angle, speed, unbalance, frame) + np.asarray(plan.sensors.accel_bias)
    values += s["accel_noise"] * np.sqrt(0.5 * hz) * rng.standard_normal(values.shape)
    if s["track_error"]:
        track, phase = rng.rayleigh(s["track_error"] / np.sqrt(0.5 * np.pi), rotors), rng.uniform(0.0, 2.0 * np.pi, rotors)
        values += vibration.acceleration(angle + phase, speed, track, vibration.axial(frame), (2, s["track_error"]))
    columns, unit, axes, _ = SHAPES["raw_accel"]
    signals = {"raw_accel": Signal(time, values, columns, unit, axes, RAW_SOURCES[scenario.autopilot])}
    if scenario.logging["esc"]:
        late, step = escs.LATE_S[0], 2.0 * np.pi * 100.0 / 60.0 / escs.POLE_PAIRS
        signals["esc"] = vibration.reported(time, speed, hz, late, step)
    return signals


def _motors(craft: Vehicle, record: Record, armed, disarmed, lifted, ardupilot: bool) -> np.ndarray:
    """Outputs (T, n): pulses in us for ArduPilot, thrust demands for PX4."""
    on = (record.time >= armed) & (record.time < disarmed)
    if not ardupilot:
        return np.where(on[:, None], record.demand, 0.0)
    low, high = craft.curve.u_min, craft.curve.u_max
    flown = np.round(low + record.command * (high - low))
    idle = PWM[0] + IDLE * (PWM[1] - PWM[0])
    return np.where(lifted[:, None], flown, np.where(on[:, None], idle, PWM[0]))


def _belief(scenario: Scenario, record: Record) -> np.ndarray:
    return record.believed if a_compensates(scenario) else np.ones_like(record.believed)


def _messages(plan: Plan, armed: float, disarmed: float, end: float, ardupilot: bool) -> tuple[Message, ...]:
    mode = Message(0.0, "mode", "GUIDED" if ardupilot else "Offboard", 4.0 if ardupilot else 14.0)
    messages = [mode, Message(0.0, "landed", "landed", 1.0), Message(armed, "armed", "armed", 1.0)]
    messages.append(Message(float(plan.way.take_off) + 1.0, "landed", "in the air", 0.0))
    for begin, cut in trajectories.landings(plan.way):
        again = begin + float(trajectories.hop_times(plan.way)[0]) + 1.0
        messages += [Message(cut + DETECTED_S, "landed", "landed", 1.0), Message(again, "landed", "in the air", 0.0)]
    if disarmed < end:
        messages += [Message(disarmed - 0.1, "landed", "landed", 1.0), Message(disarmed, "armed", "disarmed", 0.0)]
    return tuple(messages)


def _ardupilot_parameters(scenario: Scenario, craft: Vehicle, plan: Plan) -> dict[str, float]:
    number, kind = frame_numbers(scenario.airframe["frame"])
    compensated = a_compensates(scenario)
    parameters = {
        "FRAME_CLASS": number,
        "FRAME_TYPE": kind,
        "AHRS_EKF_TYPE": 3,
        "MOT_PWM_MIN": PWM[0],
        "MOT_PWM_MAX": PWM[1],
        "MOT_SPIN_ARM": IDLE,
        "MOT_SPIN_MIN": SPIN[0],
        "MOT_SPIN_MAX": SPIN[1],
        "MOT_THST_EXPO": craft.curve.expo,
        "MOT_THST_HOVER": round(float(plan.pilot.hover), 4),
        "MOT_YAW_HEADROOM": 200,
        "MOT_BAT_VOLT_MAX": round(float(plan.battery.full), 2) if compensated else 0,
        "MOT_BAT_VOLT_MIN": round(float(plan.battery.empty), 2) if compensated else 0,
        "BATT_CAPACITY": round(float(plan.battery.charge) / 3.6),
        "INS_GYRO_FILTER": scenario.sensors["gyro_filter_hz"],
        "INS_ACCEL_FILTER": scenario.sensors["accel_filter_hz"],
        "SCHED_LOOP_RATE": round(scenario.rate_hz),
    }
    motors = (*range(33, 41), *range(82, 86)) if len(craft.rotors) > 3 else (33, 34, 36)  # a tricopter has no motor 3
    parameters |= {f"SERVO{k + 1}_FUNCTION": motors[k] for k in range(len(craft.rotors))}
    return {k: float(v) for k, v in parameters.items()}


def _px4_parameters(scenario: Scenario, craft: Vehicle, plan: Plan) -> dict[str, float]:
    n = len(craft.rotors)
    parameters = {
        "CA_AIRFRAME": 0,
        "CA_ROTOR_COUNT": n,
        "MAV_TYPE": MAV_TYPE.get(n, 2),
        "THR_MDL_FAC": float(plan.pilot.expo),
        "MPC_THR_HOVER": round(float(plan.pilot.hover), 4),
        "MC_BAT_SCALE_EN": 0,
        "IMU_GYRO_CUTOFF": scenario.sensors["gyro_filter_hz"],
        "IMU_ACCEL_CUTOFF": scenario.sensors["accel_filter_hz"],
    }
    for k, r in enumerate(reported(scenario, craft.rotors)):
        parameters |= {f"CA_ROTOR{k}_PX": r.x, f"CA_ROTOR{k}_PY": r.y, f"CA_ROTOR{k}_KM": 0.05 * r.spin, f"CA_ROTOR{k}_CT": 6.5}
    return {k: float(v) for k, v in parameters.items()}


def log(scenario: Scenario, plan: Plan, record: Record) -> bytes:
    """Contents of the autopilot's log file."""
    from rotorwatch_lab.simulation.write_dataflash import dataflash
    from rotorwatch_lab.simulation.write_ulog import ulog

    return (ulog if scenario.autopilot == "px4" else dataflash)(flight(scenario, plan, record))


def write(scenario: Scenario, plan: Plan, record: Record, path: Path) -> None:
    """Write the autopilot's log. Raises ConfigError when it writes another kind of log."""
    if SUFFIXES.get(path.suffix.lower()) != scenario.autopilot:
        kind = next(k for k, v in SUFFIXES.items() if v == scenario.autopilot)
        raise ConfigError(f"{path.name}: a log of the autopilot {scenario.autopilot} is a {kind} file.")
    path.write_bytes(log(scenario, plan, record))


def write_truth(scenario: Scenario, plan: Plan, record: Record, stem: Path) -> tuple[Path, Path]:
    """Write what only the simulator knows beside the log, as STEM.truth.json and STEM.truth.csv; returns both paths."""
    n = record.w.shape[1]
    about = {
        "autopilot": scenario.autopilot,
        "rotors": n,
        "largest_loss": [round(float(v), 6) for v in record.theta.max(axis=0)],
        "mass_kg": float(plan.craft.mass),
        "hover_share": float(plan.craft.mass * G0 / plan.craft.thrust_max.sum()),
    }
    series = {" ".join(f"{w}_{k + 1}" for k in range(n)): v for w, v in (("loss", record.theta), ("speed", record.w))}
    return truth.write(scenario, record, stem, about, series)
