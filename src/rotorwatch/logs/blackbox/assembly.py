"""From the columns of Blackbox frames to a Flight: units, axes, ranges, and the firmware's mixer.

    motors        motor[0] ..: pulses in us as logged; DShot's 48 .. 2047 as shares of full command, (value - 47) / 2000
    gyro, rates   gyroUnfilt or gyroRaw, else gyroADC; gyroADC, which the controller used
    rates_wanted  setpoint[0..2], INAV axisRate[0..2]
    accel         accSmooth over acc_1G
    raw_accel     accUnfiltered over acc_1G (Indiflight)
    control       axisP + axisI + axisD + axisF over 1000, and setpoint[3] over 1000, where that is logged (Betaflight from 4.0)
    throttle      setpoint[3], else rcCommand[3], from 1000 to 2000
    attitude      imuQuaternion[0..2] (Betaflight), attitude[0..2] in tenths of a degree (INAV)
    velocity, position   navVel, navPos (INAV, cm, up); GPS_velned (cm/s)
    baro          BaroAlt, baroAlt (cm)
    battery       vbatLatest or vbat, amperageLatest or amperage
    esc           eRPM[0] .. (hundreds of electrical revolutions a minute, by motor_poles), escRPM[0] .., or Indiflight's
                  omegaUnfiltered[0] .., else omega[0] .. (rad/s)

Betaflight and its relatives have x forward, y left, z up, both in the body and in the world (north, west, up), with right-handed rotations:
their pitch is positive nose down, their yaw to the left (imu.c: `rMat`, `imuUpdateEulerAngles`). The attitude angles are those of aircraft
except for the sign of pitch. INAV's navigation is north, east, up.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.base.physics import G0
from rotorwatch.flight import Flight, Signal
from rotorwatch.logs import esc_columns, series, wall_clock
from rotorwatch.logs.blackbox.header import Header

FLIP = np.array([1.0, -1.0, -1.0])  # forward, left, up -> forward, right, down; and back
DSHOT_BELOW = 700.0  # an idle output below this is a DShot value
DSHOT_OFF, DSHOT_SPAN = 47.0, 2000.0
MIXED = 1000.0  # of the controller's output, full range of an output
POLES = 14.0
BARO_HZ = 50.0  # barometers do not update faster
MOST_ROTORS = 16
ENOUGH = 20_000  # rows for the fit of the mixer
LEAST_ROWS, LEAST_STD, FITS = 200, 2.0, 0.8
USED = re.compile(
    r"(time|(gyroADC|gyroUnfilt|gyroRaw|accSmooth|accUnfiltered|setpoint|axisRate|axis[PIDFS]|rcCommand|motor|eRPM|escRPM|omega"
    r"|omegaUnfiltered|imuQuaternion|attitude|navVel|navPos)\[\d{1,2}\]|vbatLatest|vbat|amperageLatest|amperage|[bB]aroAlt)"
)
FIRMWARES = ("Betaflight", "INAV", "EmuFlight", "Cleanflight", "Baseflight", "ButterFlight", "Rotorflight")


class Columns:
    """Columns by name, as float64. notes: sentences on what was assumed or left out."""

    def __init__(self, table: Mapping[str, np.ndarray], time: np.ndarray, header: Header, notes: list[str]):
        self.table, self.time, self.header, self.notes = table, time, header, notes

    def get(self, *names: str) -> np.ndarray | None:
        """(n, k) values of columns that are all there; None otherwise."""
        if not all(name in self.table for name in names):
            return None
        return np.stack([np.asarray(self.table[name], np.float64) for name in names], axis=1)

    def three(self, name: str) -> np.ndarray | None:
        return self.get(*(f"{name}[{k}]" for k in range(3)))

    def numbered(self, name: str) -> tuple[str, ...]:
        """name[0], name[1] .. as far as they go without a gap."""
        names: list[str] = []
        while f"{name}[{len(names)}]" in self.table and len(names) < MOST_ROTORS:
            names.append(f"{name}[{len(names)}]")
        return tuple(names)

    def signal(self, kind: str, values: np.ndarray | None, source: str, valid=None) -> Signal | None:
        return None if values is None else series.signal(kind, self.time, values, source, self.notes, valid)


def used(name: str) -> bool:
    """True if a field of main frames is read."""
    return USED.fullmatch(name) is not None


def autopilot(header: Header) -> str:
    """The firmware's name: Betaflight calls itself Cleanflight in `Firmware type` up to 4.4."""
    for text in (header.settings.get("Firmware revision", ""), header.settings.get("Firmware type", "")):
        for name in FIRMWARES:
            if name.lower() in text.lower():
                return name
    return "Cleanflight"


def signals(columns: Columns) -> tuple[dict[str, Signal], dict[str, Any]]:
    """(signals, facts) of main frames."""
    header = columns.header
    motors, share, facts = _motors(columns)
    filtered, raw = columns.three("gyroADC"), columns.three("gyroUnfilt")
    raw = columns.three("gyroRaw") if raw is None else raw
    scale = header.gyro_scale
    if filtered is not None and not scale:
        columns.notes.append("The header has no scale of the gyro: taken as 1 deg/s a count, as Betaflight logs it.")
        scale = 1.0
    to_rad = np.radians(scale) / header.resolution * FLIP
    rates = columns.signal("rates", None if filtered is None else filtered * to_rad, "gyroADC")
    gyro = columns.signal("gyro", None if raw is None else raw * to_rad, "gyroUnfilt" if "gyroUnfilt[0]" in columns.table else "gyroRaw")
    if gyro is None and filtered is not None:
        gyro = columns.signal("gyro", filtered * to_rad, "gyroADC")
    wanted, source = columns.three("setpoint"), "setpoint"
    if wanted is not None:
        wanted = np.radians(wanted / header.resolution) * FLIP
    elif (wanted := columns.three("axisRate")) is not None:
        wanted, source = np.radians(wanted) * FLIP, "axisRate"
    demand = _demand(columns)
    if share is not None and demand is not None:
        facts |= _mixer(share, demand)
    signals_ = {
        "motors": motors,
        "control": _control(columns, demand),
        "gyro": gyro,
        "rates": rates,
        "rates_wanted": columns.signal("rates_wanted", wanted, source),
        "accel": _accel(columns, "accel", "accSmooth"),
        "raw_accel": _accel(columns, "raw_accel", "accUnfiltered"),
        "attitude": _attitude(columns),
        "velocity": _nav(columns, "velocity", "navVel"),
        "position": _nav(columns, "position", "navPos"),
        "throttle": _throttle(columns),
        "baro": _baro(columns),
        "battery": _battery(columns),
        "esc": _esc(columns),
    }
    return {name: signal for name, signal in signals_.items() if signal is not None}, facts


def _motors(columns: Columns) -> tuple[Signal | None, np.ndarray | None, dict[str, Any]]:
    """(signal, (n, rotors) shares of the range from idle to full, facts)."""
    names = columns.numbered("motor")
    values = columns.get(*names) if names else None
    if values is None:
        return None, None, {}
    low, high = columns.header.motor_range
    dshot = low < DSHOT_BELOW if high else bool(median(values) < DSHOT_BELOW)
    if not high:
        low, high = (np.nan, DSHOT_OFF + DSHOT_SPAN) if dshot else (1000.0, 2000.0)
        columns.notes.append("The header has no range of the motor outputs.")
    share = (values - low) / (high - low)
    facts: dict[str, Any] = {"motor_protocol": "DShot" if dshot else "pulses"}
    if dshot:
        values, low, high = (np.array(v) - DSHOT_OFF for v in (values, low, high))
        values, low, high = values / DSHOT_SPAN, low / DSHOT_SPAN, high / DSHOT_SPAN
    if np.isfinite(low):
        facts |= {"motor_low": float(low), "motor_high": float(high)}
    off = values < (0.0 if dshot else 500.0)  # not driven
    signal = series.motors(columns.time, values, "1" if dshot else "us", f"{names[0]} ..", columns.notes, ~off)
    return signal, share if np.isfinite(low) else None, facts


def _demand(columns: Columns) -> np.ndarray | None:
    """(n, 3) the controller's demand on roll, pitch and yaw, body FRD, as shares of an output's range; within the limits of its sum."""
    parts = [columns.get(*names) for names in zip(*([f"axis{part}[{k}]" for part in "PI"] for k in range(3)))]
    if any(part is None for part in parts):
        return None
    total = np.stack(
        [sum(columns.table[f"axis{p}[{k}]"].astype(float) for p in "PIDFS" if f"axis{p}[{k}]" in columns.table) for k in range(3)], axis=1
    )
    most = columns.header.number("pidsum_limit", 1e4), columns.header.number("pidsum_limit_yaw", 1e4)
    limit = np.array([most[0], most[0], most[1]])
    return np.clip(total, -limit, limit) / MIXED * FLIP


def _control(columns: Columns, demand: np.ndarray | None) -> Signal | None:
    thrust = columns.get("setpoint[3]")
    if demand is None or thrust is None:
        return None
    return columns.signal("control", np.column_stack([demand, thrust / 1000.0]), "axisP + axisI + axisD + axisF, setpoint[3]")


def _mixer(share: np.ndarray, demand: np.ndarray) -> dict[str, Any]:
    """facts["mixer"]: n rows of the roll, pitch and yaw factors of each output, by least squares, where outputs are between idle and full;
    empty where that does not explain them. The logged sums determine the outputs up to rounding."""
    step = max(1, len(share) // ENOUGH)
    share, demand = share[::step], demand[::step]
    inner = np.asarray(((share > 0.005) & (share < 0.995)).all(axis=1))
    if inner.sum() < LEAST_ROWS:
        return {}
    differential = share[inner] - share[inner].mean(axis=1, keepdims=True)
    differential, commanded = differential - differential.mean(axis=0), demand[inner] - demand[inner].mean(axis=0)
    if (commanded.std(axis=0) * MIXED < LEAST_STD).any():
        return {}
    factors = np.linalg.lstsq(commanded, differential, rcond=None)[0]
    explained = 1.0 - np.square(differential - commanded @ factors).sum() / max(np.square(differential).sum(), 1e-12)
    return {"mixer": np.round(factors.T, 3).tolist()} if explained > FITS else {}


def _accel(columns: Columns, kind: str, name: str) -> Signal | None:
    raw, unit = columns.three(name), columns.header.number("acc_1G")
    if raw is None or not np.any(raw):
        return None
    if unit <= 0:
        if kind == "accel":
            columns.notes.append("The header has no accelerometer scale: the accelerometer is ignored.")
        return None
    return columns.signal(kind, raw / unit * G0 * FLIP, name)


def _attitude(columns: Columns) -> Signal | None:
    turn = columns.three("imuQuaternion")
    if turn is not None:
        vector = turn / 32767.0 * FLIP  # both frames turned half round x
        square = np.square(vector).sum(axis=1)
        q = np.column_stack([np.sqrt(np.maximum(1.0 - square, 0.0)), vector])
        return columns.signal("attitude", q, "imuQuaternion", square < 1.01)
    angles = columns.three("attitude")
    if angles is None:
        return None
    return columns.signal("attitude", series.quaternion(*np.radians(angles / 10.0 * [1.0, -1.0, 1.0]).T), "attitude")


def _nav(columns: Columns, kind: str, name: str) -> Signal | None:
    raw = columns.three(name)
    return columns.signal(kind, None if raw is None or not np.any(raw) else raw / 100.0 * [1.0, 1.0, -1.0], name)


def _baro(columns: Columns) -> Signal | None:
    name = "baroAlt" if "baroAlt" in columns.table else "BaroAlt"
    raw = columns.get(name)
    if raw is None or not np.any(raw):
        return None
    often = slice(None, None, max(1, len(raw) // int(1.0 + BARO_HZ * np.ptp(columns.time))))
    return series.signal("baro", columns.time[often], raw[often] / 100.0, name, [])


def _throttle(columns: Columns) -> Signal | None:
    mixed, stick = columns.get("setpoint[3]"), columns.get("rcCommand[3]")
    if mixed is not None:
        return columns.signal("throttle", mixed / 1000.0, "setpoint[3]")
    if stick is None:
        return None
    return columns.signal("throttle", (stick / columns.header.resolution - 1000.0) / 1000.0, "rcCommand[3]")


def _battery(columns: Columns) -> Signal | None:
    volts = columns.get("vbatLatest")
    volts = columns.get("vbat") if volts is None else volts
    if volts is None:
        return None
    header = columns.header
    cell, reference = (*header.numbers("vbatcellvoltage"), 0.0, 0.0, 0.0)[2], header.number("vbatref")
    if cell >= 100.0:  # 4.30 V
        unit, hundredths = 0.01, True
    elif reference < 700.0:
        unit, hundredths = 0.1, True
    else:  # counts of a converter of 12 bits and 3.3 V
        unit, hundredths = 3.3 / 4095.0 * header.number("vbatscale", 110.0) / 10.0, False
    current = columns.get("amperageLatest")
    current = columns.get("amperage") if current is None else current
    measured = hundredths and current is not None and ("currentSensor" in header.settings or autopilot(header) == "INAV")
    amperes = current / 100.0 if measured and current is not None else np.full(volts.shape, np.nan)
    values = np.column_stack([volts * unit, amperes])
    return columns.signal("battery", values, "vbatLatest" if "vbatLatest" in columns.table else "vbat", series.voltage_and_current(values))


def altitude_unit(header: Header) -> float:
    """Metres of one count of the altitude in GPS frames; NaN where that is not certain."""
    if autopilot(header) == "INAV":
        return 1.0
    version = re.search(r"Betaflight (\d{1,4})\.", header.settings.get("Firmware revision", ""))
    return 0.1 if version and int(version[1]) >= 4 else np.nan


def _esc(columns: Columns) -> Signal | None:
    for name in ("eRPM", "escRPM", "omegaUnfiltered", "omega"):
        names = columns.numbered(name)
        if name.startswith("omega"):
            names = names[: len(columns.numbered("motor"))]  # the firmware logs eight, whatever it drives
        values = columns.get(*names) if names else None
        if values is None or not np.any(values):
            continue
        if name == "eRPM":
            poles = columns.header.number("motor_poles")
            if not 2 <= poles <= 100:
                columns.notes.append(f"The header has no number of motor poles: {POLES:.0f} assumed.")
                poles = POLES
            values = values * 100.0 / (poles / 2.0)
        if not name.startswith("omega"):
            values = values * esc_columns.RPM
        return esc_columns.build(columns.time, {"speed": values}, range(1, len(names) + 1), f"{names[0]} ..", columns.notes)
    return None


def utc_start(header: Header) -> str | None:
    """UTC of the log's start, by the firmware's clock; None where that was not set."""
    text = header.settings.get("Log start datetime", "")
    if not re.fullmatch(r"[\d:T.+Z-]{19,35}", text):
        return None
    try:
        moment = datetime.fromisoformat(text.replace("Z", "+00:00"))
        unix = moment.timestamp()
    except (ValueError, OverflowError, OSError):
        return None
    return wall_clock.stamp(unix) if wall_clock.EARLIEST < unix < wall_clock.LATEST else None


def assembled(columns: Columns, form: str, name: str, **more: Any) -> Flight:
    """The Flight of main frames; more: further fields."""
    header = columns.header
    signals_, facts = signals(columns)
    facts |= more.pop("facts", {})
    begun = utc_start(header)
    if begun:
        facts["utc_start"] = begun
    for key, label in (("craft", "Craft name"), ("board", "Board information")):
        if header.settings.get(label, "").strip():
            facts[key] = header.settings[label].strip()
    extra = more.pop("signals", {})
    signals_ |= {key: value for key, value in extra.items() if key not in signals_}
    return Flight(
        format=form, autopilot=autopilot(header), signals=signals_, duration=series.end_of(signals_),
        firmware=header.settings.get("Firmware revision", "").strip(), parameters=header.parameters(), facts=facts, name=name, **more,
    )  # fmt: skip
