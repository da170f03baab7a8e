"""Whether a log can hear its rotors: which sensor, what its filters let through, the speeds, and which setting is missing.

    log                 acceleration                                     angular rate
    Blackbox            accUnfiltered (Indiflight)                       gyroUnfilt, gyroRaw
    ArduPilot           ACC, ISBD; IMU through INS_ACCEL_FILTER          GYR, ISBD; IMU through INS_GYRO_FILTER
    PX4                 sensor_accel_fifo; sensor_accel and              sensor_gyro_fifo; sensor_gyro and
                        sensor_combined, means over their intervals      sensor_combined

What is left of a tone of f Hz behind these, which the fit divides by:

    a low-pass of order 2 (ArduPilot's LowPassFilter2p, Butterworth)     1 / sqrt(1 + (f / f_c)^4)
    a mean over T (PX4's sensor_accel, sensor_combined)                  |sin(pi f T) / (pi f T)|

Sources: https://ardupilot.org/copter/docs/logmessages.html; libraries/Filter/LowPassFilter2p.cpp of ArduPilot;
https://docs.px4.io/main/en/msg_docs/SensorCombined.html; https://betaflight.com/docs/development/Blackbox-Internals
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.motion.allocation import output_range
from rotorwatch.flight import Flight, Signal

LEAST_HZ = 200.0  # a window of orders.WINDOW_S then has fewer samples than twice the unknowns of a quad
FOLLOWS_HZ = 400.0  # without speeds: slower, too many tones share what is below half of it
LEAST_SPEED_HZ = 8.0  # of the reports of a rotor's speed: their line follows it within a window
LEAST_LEFT = 0.05  # of a tone behind a filter: below, errors of the filter's constants are as large as the tone
LOOKS = 5000  # reports of which the usual speed is taken
UNFILTERED = {"gyro": ("gyroUnfilt", "gyroRaw")}

SPEEDS = {
    "blackbox": "Set dshot_bidir = ON and motor_poles; from 4.5 on Betaflight logs eRPM (blackbox_disable_rpm = OFF).",
    "ardupilot": "Use ESCs with telemetry or bidirectional DShot (SERVO_BLH_BDMASK, SERVO_BLH_POLES): the ESC message.",
    "px4": "Use ESCs with telemetry (DSHOT_TEL_CFG, DShot bidirectional or CAN), so that esc_status holds their speeds.",
    "": "Log the speed of each rotor (signal esc), at 10 Hz or more.",
}
SENSORS = {
    "blackbox": "Log the unfiltered gyro (gyroUnfilt; before 4.3 debug_mode = GYRO_SCALED) at 500 Hz or more.",
    "ardupilot": "Log the raw sensors: INS_RAW_LOG_OPT = 1 with LOG_BITMASK bit 19, or INS_LOG_BAT_MASK = 1 with INS_LOG_BAT_OPT = 0.",
    "px4": "Set SDLOG_PROFILE bit 9 (raw FIFO high-rate accelerometer; bit 8: gyro): sensor_accel_fifo.",
    "": "Log the unfiltered accelerometer (signal raw_accel) at 500 Hz or more.",
}


class Channel(NamedTuple):
    """A sensor that hears. accel: its kind, else a gyro. filter_hz: cut-off of a low-pass of order 2 before it was logged, 0 without;
    mean_s: time over which each sample is a mean, 0 without."""

    signal: Signal
    accel: bool
    filter_hz: float = 0.0
    mean_s: float = 0.0

    @property
    def exponent(self) -> float:
        """Power of the speed with which the tone of an unbalance grows (orders.py)."""
        return 2.0 if self.accel else 1.0

    @property
    def unit(self) -> str:
        """Unit of an imbalance: unbalance for each mass of the vehicle (1e-6 m), or angular acceleration over speed squared (1e-6 rad)."""
        return "g mm/kg" if self.accel else "urad"

    def left(self, hz: np.ndarray) -> np.ndarray:
        """Share of the amplitude of tones at `hz` that is left in the log."""
        share = np.ones_like(np.asarray(hz, float))
        if self.filter_hz > 0.0:
            share = share / np.sqrt(1.0 + (hz / self.filter_hz) ** 4)
        return share * np.abs(np.sinc(hz * self.mean_s))


class Deaf(NamedTuple):
    """Why a log cannot hear, and what would."""

    why: str
    setting: str


def family(flight: Flight) -> str:
    """The autopilot, as in SPEEDS."""
    if flight.format.startswith("Blackbox"):
        return "blackbox"
    return next((name for name in ("ardupilot", "px4") if name in flight.autopilot.lower()), "")


def speeds(flight: Flight, rotors: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """(time (m,) s, speed (m, rotors) rad/s, valid) of the ESC telemetry; None where it lacks a rotor's speed."""
    if not flight.has("esc"):
        return None
    esc = flight["esc"]
    columns = [esc.columns.index(f"speed{k}") for k in range(1, rotors + 1) if f"speed{k}" in esc.columns]
    if len(columns) < rotors or not esc.valid[:, columns].any(axis=0).all():
        return None
    return esc.time, esc.values[:, columns], esc.valid[:, columns]


def commands(flight: Flight, rotors: int) -> tuple[np.ndarray, np.ndarray] | None:
    """(time (m,) s, shares (m, rotors) of full command), from which tones.py finds the speeds; None where the log lacks them."""
    if not flight.has("motors") or flight["motors"].values.shape[1] != rotors:
        return None
    low, high = output_range(flight)
    sent, whole = flight["motors"], flight["motors"].whole
    return (sent.time[whole], (sent.values[whole] - low) / (high - low)) if whole.any() else None


def open_channel(flight: Flight) -> Channel | None:
    """The sensor that hears tones at unknown frequencies best: without a filter, at FOLLOWS_HZ or more."""
    return next((c for c in _channels(flight) if c.signal.rate_hz >= FOLLOWS_HZ and c.filter_hz == 0.0 and c.mean_s == 0.0), None)


def channel(flight: Flight, hz: float) -> Channel | None:
    """The sensor that hears a rotor of `hz` turns a second best: an accelerometer before a gyro, the least filtered first."""
    found = [c for c in _channels(flight) if c.signal.rate_hz >= LEAST_HZ and float(c.left(np.array(hz))) >= LEAST_LEFT]
    return found[0] if found else None


def _channels(flight: Flight) -> list[Channel]:
    """All sensors whose filters are known, the best first."""
    found = []
    for kind in ("accel", "gyro"):
        if flight.has(f"raw_{kind}"):
            raw = flight[f"raw_{kind}"]
            found.append(Channel(raw, kind == "accel", mean_s=1.0 / raw.rate_hz if raw.source == f"sensor_{kind}" else 0.0))
        if not flight.has(kind):
            continue
        signal = flight[kind]
        if signal.source in UNFILTERED.get(kind, ()):
            found.append(Channel(signal, kind == "accel"))
        elif signal.source.startswith("IMU") and family(flight) == "ardupilot":
            cut = flight.parameters.get(f"INS_{kind.upper()}_FILTER", 20.0)
            found.append(Channel(signal, kind == "accel", filter_hz=max(cut, 0.0)))
        elif signal.source == "sensor_combined" and signal.rate_hz > 0.0:
            found.append(Channel(signal, kind == "accel", mean_s=1.0 / signal.rate_hz))
    return sorted(found, key=lambda c: (not c.accel, c.filter_hz > 0.0 or c.mean_s > 0.0))


def usual_hz(flight: Flight, rotors: int) -> float:
    """Median of the turns a second that are logged, of rotors that turn; 0 without."""
    reported = speeds(flight, rotors) if rotors else None
    if reported is None:
        return 0.0
    speed, valid = (table[:: 1 + len(table) // LOOKS] for table in reported[1:])
    turning = valid & (speed > 0.0)
    return float(median(speed[turning])) / (2.0 * np.pi) if turning.any() else 0.0


def sensor(flight: Flight, rotors: int) -> Channel | None:
    """The sensor that hears the rotors of a log; None where none does."""
    if deaf(flight, rotors) is not None:
        return None
    return open_channel(flight) if speeds(flight, rotors) is None else channel(flight, usual_hz(flight, rotors))


def deaf(flight: Flight, rotors: int) -> Deaf | None:
    """Why the rotors' vibration cannot be heard in a log; None where it can."""
    of = family(flight)
    reported = speeds(flight, rotors) if rotors else None
    if reported is None:
        if rotors and open_channel(flight) is not None and commands(flight, rotors) is not None:
            return None
        return Deaf("no speed of every rotor is logged", SPEEDS[of])
    time, speed, valid = reported
    turning = valid & (speed > 0.0)
    if not turning.any(axis=0).all():
        return Deaf("a rotor's speed is never reported", SPEEDS[of])
    slowest = max(float(median(np.diff(time[valid[:, k]]))) if valid[:, k].sum() > 1 else np.inf for k in range(rotors))
    if slowest > 1.0 / LEAST_SPEED_HZ:
        return Deaf(f"rotor speeds are logged at {1.0 / slowest:.2g} Hz, too slowly to follow a rotor's angle", SPEEDS[of])
    hz = usual_hz(flight, rotors)
    if channel(flight, hz) is None:
        return Deaf(f"no accelerometer or gyro is logged fast and unfiltered enough to hear {hz:.0f} turns a second", SENSORS[of])
    return None
