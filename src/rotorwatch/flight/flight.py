"""The content of a log, in SI units and known frames, before any physics is assumed.

Signals have canonical names (columns, unit, frame); a log holds any subset of them:

========== =============================== ======== ==================================================================
name       columns                         unit     meaning
========== =============================== ======== ==================================================================
motors     r1 .. rN                        us or 1  command sent to rotor k, in the autopilot's rotor order
control    roll pitch yaw thrust           1        output of the rate controller, before the mixer (body FRD)
gyro       x y z                           rad/s    angular rate, body FRD
rates      x y z                           rad/s    angular rate the rate controller used (filtered), body FRD
rates_     x y z                           rad/s    commanded angular rate, body FRD (name: rates_wanted)
wanted
accel      x y z                           m/s^2    specific force, body FRD (about -9.8 on z in hover)
attitude   w x y z                         1        quaternion body FRD -> world NED, scalar first
attitude_  w x y z                         1        commanded attitude, likewise (name: attitude_wanted)
wanted
velocity   n e d                           m/s      world NED
position   n e d                           m        world NED
throttle   out                             1        collective command (0..1)
battery    voltage current                 V, A     (unit "V,A")
gps        n e d speed                     m, m/s   world NED, from the first fix; speed over ground. Only displayed
baro       up                              m        barometric altitude. Only displayed
lift       lift_max voltage_ratio limit    1        ArduPilot's battery compensation (MOTB)
vibration  level                           m/s^2    deviation of the accelerometer, by the autopilot. Only compared with limits
clipping   count                           1        samples at the end of the accelerometer's range since boot. Likewise innovat-   velocity
position height        1        innovations of the autopilot's estimator, relative to its limit: at 1 a
ions       compass                                  measurement is rejected (name: innovations). Likewise
raw_accel  x y z                           m/s^2    the accelerometer before the autopilot's filters, or with the least of them, as
                                                    fast as the log has it; only where `accel` is another. Only rotors' vibration is
                                                    taken from it (witnesses/balance)
raw_gyro   x y z                           rad/s    the same of the gyro
esc        speed1 .. current1 ..           rad/s,A, ESC telemetry where logged, rotor order: speed of the rotor, current and
           voltage1 .. temperature1 ..     V,degC   voltage at the ESC's input, temperature of the ESC
========== =============================== ======== ==================================================================

Missing samples are common: ``valid`` masks them, values there are 0, never NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from rotorwatch.base import optional
from rotorwatch.base.arrays import median
from rotorwatch.base.choices import meant
from rotorwatch.base.files import printable
from rotorwatch.errors import ConfigError


@dataclass(frozen=True, repr=False)
class Signal:
    """A multi-column time series.

    time: (n,) s since the first record of the log, non-decreasing. values: (n, k), finite everywhere.
    valid: (n, k) bool; False where the log had no usable number; None or (n,) is expanded to that. Read-only. columns: names of the k
    columns. unit: of all of them, or one for each, separated by commas. frame: "FRD", "NED" or "" for none. source: the log's own name for
    it. made: the values were made for this signal, which keeps them instead of a copy."""

    time: np.ndarray
    values: np.ndarray
    columns: tuple[str, ...]
    unit: str
    frame: str = ""
    source: str = ""
    valid: np.ndarray = None  # pyright: ignore[reportAssignmentType]: always an array once constructed

    made: InitVar[bool] = False

    def __post_init__(self, made: bool):
        time = np.ascontiguousarray(self.time, dtype=np.float64)
        values = np.ascontiguousarray(self.values, dtype=np.float64)
        if values.ndim == 1:
            values = values[:, None]
        if time.ndim != 1 or values.shape != (time.size, len(self.columns)):
            name = self.source or self.columns
            raise ValueError(f"signal {name}: time {time.shape} does not fit values {values.shape}")
        valid = np.isfinite(values)
        if self.valid is not None:
            given = np.asarray(self.valid, dtype=bool)
            valid &= given[:, None] if given.ndim == 1 else given
        whole = valid.all()
        if whole:  # the usual case: one byte for all of them
            valid = np.broadcast_to(np.True_, valid.shape)
        object.__setattr__(self, "time", time)
        # Already copied: no other reference can change it.
        owned = made or (values.base is not self.values and values is not self.values)
        if not owned:
            values = np.where(valid, values, 0.0)
        elif not whole:
            values[~valid] = 0.0
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "valid", valid)

    def __len__(self):
        return self.time.size

    @cached_property
    def whole(self) -> np.ndarray:
        """(n,) bool, not to be changed: samples with a usable number in every column."""
        if self.valid.strides == (0, 0):
            return self.valid[:, 0]
        valid = self.valid[:, 0].copy() if self.valid.shape[1] else np.ones(len(self), bool)
        for column in self.valid.T[1:]:  # many times faster than all(axis=1) of short rows
            valid &= column
        valid.flags.writeable = False
        return valid

    @cached_property
    def rate_hz(self) -> float:
        """Median sampling rate; 0 with fewer than two samples."""
        if self.time.size < 2:
            return 0.0
        step = float(median(np.diff(self.time)))
        return 1.0 / step if step > 0 else 0.0

    def wholes(self) -> Signal:
        """The samples with all columns valid; itself where all are."""
        rows = self.whole
        return self if rows.all() else self.with_arrays(self.time[rows], self.values[rows], self.valid[rows])

    def to_pandas(self):
        """A pandas DataFrame: a column each, the time [s] as its index, NaN where the log had no usable number. Raises ConfigError
        where pandas is not installed."""
        pd = optional.library("pandas", "to_pandas")
        values = np.where(self.valid, self.values, np.nan)
        return pd.DataFrame(values, columns=list(self.columns), index=pd.Index(self.time, name="time_s"))

    def plot(self, path=None):
        """A matplotlib figure of all columns over time [s], in its unit; gaps where the log had no usable number. path: also write it there
        (.png, .svg, .pdf). Raises ConfigError where matplotlib is not installed."""
        from rotorwatch.flight.display import Panel, plot

        values = np.where(self.valid, self.values, np.nan)
        return plot(self.time, [Panel(f"{self.source or 'value'} [{self.unit}]", values, self.columns)], path)

    def __repr__(self) -> str:
        frame = f", {self.frame}" if self.frame else ""
        return f"<Signal {' '.join(self.columns)} [{self.unit}{frame}]: {len(self)} samples, {self.rate_hz:.1f} Hz>"

    def between(self, start: float, end: float) -> Signal:
        """The samples with start <= time < end."""
        return self.part(slice(*np.searchsorted(self.time, [start, end])))

    def part(self, rows: slice) -> Signal:
        """Some of the samples, as views."""
        return self.with_arrays(self.time[rows], self.values[rows], self.valid[rows])

    def with_arrays(self, time: np.ndarray, values: np.ndarray, valid: np.ndarray) -> Signal:
        """The same signal with other samples: arrays with a Signal's properties, which are not checked."""
        new = object.__new__(Signal)
        new.__dict__.update(
            time=time, values=values, columns=self.columns, unit=self.unit, frame=self.frame, source=self.source, valid=valid
        )
        return new


@dataclass(frozen=True)
class Message:
    """A text or state change that the autopilot logged.

    time: s from the first record. kind: 'text', 'error', 'event', 'mode', 'armed', 'landed', 'health' or 'dropout'. text: as logged, or in
    words; of 'health' its first word is the part, and value 1 means unhealthy. value: the underlying number, if any."""

    time: float
    kind: str
    text: str
    value: float = 0.0

    def __post_init__(self):
        if not self.text.isprintable():
            object.__setattr__(self, "text", printable(self.text))


@dataclass(frozen=True, repr=False)
class Flight:
    """The content of one log.

    format: name of the log's format. autopilot: "ArduPilot", "PX4" or another name; "" when the log does not say. duration: s. firmware:
    its version as logged. vehicle_type: the log's own word. name: of the file. start_us: time stamp of the first record, by the clock of
    the autopilot [us]. facts: further findings of a reader for later steps.
    signals: canonical name -> Signal (module docstring). parameters: the autopilot's, never the simulator's
    (``SIM_*``). parameter_changes: (time s, name, value) after the start. messages: in time order. warnings: sentences on damaged, missing
    or assumed data. checked: values corrupted by damage of the log have been searched for (`logs.plausible`); otherwise that happens before
    a flight is assessed."""

    format: str
    autopilot: str
    signals: Mapping[str, Signal]
    duration: float
    firmware: str = ""
    vehicle_type: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)
    parameter_changes: tuple[tuple[float, str, float], ...] = ()
    messages: tuple[Message, ...] = ()
    warnings: tuple[str, ...] = ()
    name: str = ""
    start_us: int = 0
    facts: Mapping[str, Any] = field(default_factory=dict)
    checked: bool = False

    def __post_init__(self):
        for name in ("autopilot", "firmware", "vehicle_type", "name"):
            if not (text := getattr(self, name)).isprintable():
                object.__setattr__(self, name, printable(text))
        if not all(map(str.isprintable, self.parameters)):
            object.__setattr__(self, "parameters", {printable(k): v for k, v in self.parameters.items()})
        if not all(name.isprintable() for _, name, _ in self.parameter_changes):
            changes = tuple((time, printable(name), value) for time, name, value in self.parameter_changes)
            object.__setattr__(self, "parameter_changes", changes)
        if not all(map(str.isprintable, self.warnings)):
            object.__setattr__(self, "warnings", tuple(map(printable, self.warnings)))

    def has(self, *names: str) -> bool:
        """True when every named signal is there with at least two samples."""
        return all(n in self.signals and len(self.signals[n]) >= 2 for n in names)

    def __getitem__(self, name: str) -> Signal:
        return self.signals[name]

    def angular_rate(self) -> Signal | None:
        """The gyro, or else the rates that the controller used; None where the log has neither with all its axes."""
        signals = (self.signals[name] for name in ("gyro", "rates") if self.has(name))
        return next((signal for signal in signals if signal.whole.any()), None)

    @property
    def rotor_count(self) -> int:
        """Number of rotors the log shows commands for; 0 when it shows none."""
        return self.signals["motors"].values.shape[1] if "motors" in self.signals else 0

    def to_pandas(self, name: str):
        """A signal as a pandas DataFrame (`Signal.to_pandas`). Raises ConfigError for a signal that the log does not hold."""
        if name not in self.signals:
            whose, held = self.name or "the flight", ", ".join(sorted(self.signals)) or "none"
            raise ConfigError(f"{whose} has no signal {name}{meant(name, self.signals)}; it has {held}.")
        return self.signals[name].to_pandas()

    def to_dict(self) -> dict[str, Any]:
        """The log as plain data, without the samples: of signals, columns, unit, frame, source, count and rate."""
        signals = {
            name: {
                "columns": list(s.columns), "unit": s.unit, "frame": s.frame, "source": s.source, "samples": len(s),
                "rate_hz": round(s.rate_hz, 3),
            }
            for name, s in self.signals.items()
        }  # fmt: skip
        return {
            "name": self.name, "format": self.format, "autopilot": self.autopilot, "firmware": self.firmware,
            "vehicle_type": self.vehicle_type, "duration_s": self.duration, "start_us": self.start_us, "facts": dict(self.facts),
            "parameters": {k: float(v) for k, v in self.parameters.items()}, "signals": signals,
            "messages": [{"time_s": m.time, "kind": m.kind, "text": m.text, "value": m.value} for m in self.messages],
            "warnings": list(self.warnings),
        }  # fmt: skip

    def __repr__(self) -> str:
        about = " ".join(text for text in (self.autopilot, self.firmware) if text) or self.format
        held = ", ".join(sorted(self.signals)) or "no signals"
        return f"<Flight {self.name or 'without a name'}: {about}, {self.duration:.1f} s, {held}>"

    def _repr_html_(self) -> str:
        from rotorwatch.flight import display

        return display.page(self)

    def until(self, end: float) -> Flight:
        """The same flight as if the log had stopped at ``end`` seconds: the data of a live observer."""
        return replace(
            self,
            signals={k: s.between(-np.inf, end) for k, s in self.signals.items()},
            duration=min(self.duration, end),
            parameter_changes=tuple(c for c in self.parameter_changes if c[0] < end),
            messages=tuple(m for m in self.messages if m.time < end),
        )
