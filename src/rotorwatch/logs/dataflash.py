"""ArduPilot DataFlash logs (`.bin`, or `.log` as text), ArduCopter 3.0 to 4.7 -> Flight.

Signals and their messages (instance 0 of sensors that come in several):

    motors    RCOU (RCO2, RCO3) C1.. or Ch1.., in rotor order by SERVOn_FUNCTION; before 3.2 MOT Mot1.., in rotor order
    control   RATE ROut POut YOut AOut         rates     RATE R P Y
    gyro      IMU GyrX..                       accel     IMU AccX..
    attitude, attitude_wanted  ANG or ATT, whichever is faster
    velocity, position   XKF1, NKF1 or EKF1  gps, baro  GPS; BARO where no EKF is logged
    throttle  CTUN ThO or ThrOut               battery   BAT or CURR
    lift      MOTB                             esc       ESC, ESC1.., CESC: see dataflash_esc
    raw_accel, raw_gyro  ACC, GYR, ISBD: see dataflash_raw
    vibration, clipping  VIBE                  innovations  XKF4, NKF4 or EKF4, of the first core

Times count from the smallest time stamp of any record; 3.0 and 3.1 have none: see dataflash_clock.
Simulation parameters and messages (SIM*) are never read.
"""

from __future__ import annotations

import re

import numpy as np

from rotorwatch.base.arrays import median, quantile
from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Signal
from rotorwatch.logs import dataflash_esc, dataflash_raw, parameter_ranges, series, wall_clock
from rotorwatch.logs import dataflash_events as events
from rotorwatch.logs import dataflash_rotors as rotors
from rotorwatch.logs.dataflash_binary import SDLOG2, BinaryLog, amount
from rotorwatch.logs.dataflash_clock import Clock, SteadyClock, clock_of
from rotorwatch.logs.dataflash_text import FIRST_LINE, TextLog
from rotorwatch.logs.series import SHAPES, quaternion, steady

FORMAT = "dataflash"
ENDINGS = (".bin",)
COMMON_ENDINGS = (".log",)

FMT_HEADER = b"\xa3\x95\x80"
NEAR_START = 512  # bytes that damage or a ground station may have put before the first FMT
INSTANCE_COLUMNS = ("I", "Instance", "Inst", "IMU", "C")
PWM_RANGE_US = (500.0, 2600.0)
SMALL_STEP_S = 0.005  # records of one message out of order
ENOUGH = 20_000  # records, spread over the log, to determine the unit of a column

# Magnitudes beyond which a number is damage, not flight; (low, high) per column, in the unit of the signal.
TURN = (-80.0, 80.0)  # rad/s: gyros end at 2000 or 4000 deg/s
LIMITS = {
    "control": ((-10.0, 10.0),) * 3 + ((-0.5, 1.6),),  # newer firmware logs the demand before the mixer's limits
    "gyro": (TURN,) * 3,
    "rates": (TURN,) * 3,
    "accel": ((-640.0, 640.0),) * 3,
    "attitude": ((-1.001, 1.001),) * 4,
    "attitude_wanted": ((-1.001, 1.001),) * 4,
    "velocity": ((-150.0, 150.0),) * 3,
    "position": ((-1e5, 1e5),) * 3,
    "throttle": ((-0.1, 1.1),),
    "battery": ((0.0, 120.0), (-100.0, 2000.0)),
    "baro": ((-1e4, 2e4),),
    "lift": ((0.0, 2.0), (0.0, 2.0), (0.0, 1.5)),
    "vibration": ((0.0, np.inf),),
    "clipping": ((0.0, np.inf),),
    "innovations": ((0.0, np.inf),) * 4,
}
BLOCK = 1 << 16  # samples processed at a time
RAW_TORQUE = 4500.0  # APM:Copter 3.3: full roll, pitch or yaw output
RAW_THROTTLE = 1000.0  # ... and full throttle


def sniff(head: bytes, name: str) -> bool:
    """True when the file starts as a DataFlash log, binary or text; `name` decides only where the start is damaged."""
    if SDLOG2.search(head):
        return False  # PX4's, in the same framing
    if 0 <= head.find(FMT_HEADER) < NEAR_START or FIRST_LINE.search(head):
        return True
    return name.lower().endswith(ENDINGS) and FMT_HEADER in head


@np.errstate(all="ignore")  # damaged numbers may be NaN or huge; they are masked, not computed with
def read(data, name: str, progress=None) -> Flight:
    """Read a DataFlash log from bytes or a memory map.

    name: for messages. progress: called with the share done (0..1). Damage is skipped and named in `warnings`. Raises LogError when the
    file is no DataFlash log or holds no flight data."""
    head = bytes(data[: 64 * 1024])
    if not len(head):
        raise LogError(f"{name}: the file is empty; copy it from the autopilot again.")
    log = (TextLog if FMT_HEADER not in head and FIRST_LINE.search(head) else BinaryLog)(data, progress)
    if not log.counts:
        raise LogError(f"{name}: this is not a DataFlash log; no message definition (FMT) was found in it.")
    clock, source = clock_of(log)
    parameters, changes = events.parameters(log, clock)
    parameters, notes = parameter_ranges.checked(parameters)
    reader = _Signals(log, clock)
    reader.warnings += [*notes, *rotors.announced(parameters, events.frame_text(log, clock))]
    frame_class, frame_type = rotors.frame(parameters, events.frame_text(log, clock))
    steps = (
        lambda: reader.motors(parameters, frame_class),
        reader.imu,
        reader.rate,
        reader.attitude,
        lambda: reader.navigation(parameters),
        reader.place,
        reader.power,
        reader.esc,
        reader.raw,
        reader.limited,
    )
    for step in steps:
        step()
    if not any(len(s) >= 2 for name, s in reader.signals.items() if name not in series.SHOWN):
        raise LogError(
            f"{name}: no data: the log names its messages and parameters but holds no flight; "
            "check that logging was on and the vehicle was armed."
        )
    (version, vehicle), messages = events.firmware(log, clock), events.messages(log, clock)
    if progress:
        progress(1.0)
    return Flight(
        format=FORMAT,
        autopilot="ArduPilot",
        signals=reader.signals,
        duration=clock.end,
        firmware=version,
        vehicle_type=vehicle,
        parameters=parameters,
        parameter_changes=tuple(c for c in changes if parameter_ranges.possible(c[1], c[2])),
        messages=messages,
        warnings=(*log.warnings, *([source] if source else []), *clock.warnings, *reader.warnings),
        name=name,
        start_us=int(clock.start_us),
        facts={
            "log_messages": dict(sorted(log.counts.items())),
            "rates_hz": {k: round(s.rate_hz, 1) for k, s in reader.signals.items()},
            "rotor_outputs": [reader.outputs[k] for k in sorted(reader.outputs)],
            "rotor_numbers": sorted(reader.outputs),
            "outputs_left_out": reader.left_out,
            "frame_class": frame_class,
            "frame_type": frame_type,
            "clock_jumps": list(clock.jumps),
            "utc_start": reader.utc_start,
        },
    )


class _Signals:
    """Collects the Flight's signals from the tables of one log."""

    def __init__(self, log: BinaryLog | TextLog, clock: Clock | SteadyClock):
        self.log, self.clock = log, clock
        self.signals: dict[str, Signal] = {}
        self.warnings: list[str] = []
        self.outputs: dict[int, int] = {}
        self.left_out: list[int] = []
        self.utc_start: str | None = None

    # -- helpers ---------------------------------------------------------------------------------------------------

    def table(self, message: str, columns, where=None):
        """(time (n,), values (n, k), codes) of a message, in time order; None when absent. Lacking columns are NaN."""
        numbers = self.log.numbers(message, columns, where)
        if numbers is None:
            return None
        values, (time, good) = numbers.values, self.clock.of(numbers.record)
        if not good.all():
            time, values = time[good], values[good]
        steps = np.diff(time)
        if (steps < -SMALL_STEP_S).any():  # within one message time only runs backwards where a stamp is damaged
            keep = steady(time)
            self.warnings.append(f"{message}: {amount(time.size - keep.size, 'sample')} out of time order dropped.")
            time, values = time[keep], values[keep]
        elif (steps < 0).any():
            order = np.argsort(time, kind="stable")
            time, values = time[order], values[order]
        return time, values, numbers.codes

    def instance(self, message: str, columns):
        """`table` for sensor instance 0, or for the one with most records where 0 is missing."""
        column = next((c for c in INSTANCE_COLUMNS if c in self.log.columns(message)), None)
        if column is None:
            return self.table(message, columns)
        first = self.table(message, columns, (column, 0))
        if first is not None:
            return first
        rows = self.table(message, (column,))
        numbers = rows[1][np.isfinite(rows[1])] if rows else np.zeros(0)
        if not numbers.size:
            return None
        number = int(np.argmax(np.bincount(np.clip(numbers, 0, 255).astype(int))))
        self.warnings.append(f"{message} has no instance 0; instance {number} was used.")
        return self.table(message, columns, (column, number))

    def first_of(self, *messages: str) -> str | None:
        return next((m for m in messages if self.log.counts.get(m)), None)

    def add(self, name: str, time, values, source: str, valid=None) -> None:
        """Store a signal; values out of LIMITS become invalid and are counted in a warning."""
        columns, unit, frame, _ = SHAPES[name]
        low, high = np.array(LIMITS[name]).T
        wild = np.isfinite(values) & ((values < low) | (values > high))
        mask = ~wild if valid is None else ~wild & valid[:, None]
        self._store(name, Signal(time, values, columns, unit, frame, source, mask, made=True), int(wild.sum()))

    def _store(self, name: str, signal: Signal, wild: int) -> None:
        if wild:
            text = f"{name} ({signal.source}): {amount(wild, 'impossible value')} dropped."
            self.warnings.append(series.Impossible(wild, text))
        if signal.valid is not None and signal.valid.any():
            self.signals[name] = signal

    # -- one method per group of messages --------------------------------------------------------------------------

    def motors(self, parameters, frame_class) -> None:
        """RCOU, and RCO2/RCO3 for outputs beyond 14, in rotor order."""
        pwm: dict[int, np.ndarray] = {}
        time = np.zeros(0)
        for message in ("RCOU", "RCO2", "RCO3"):
            names = [c for c in self.log.columns(message) if re.fullmatch(r"(C|Ch|Chan)\d{1,2}", c)]
            rows = self.table(message, names) if names else None
            if rows is None or (message != "RCOU" and not pwm):
                continue
            t, values, _ = rows
            if message == "RCOU":
                time, at = t, slice(None)
            else:  # logged right after RCOU: the record nearest in time belongs to it
                at = np.clip(np.searchsorted((t[1:] + t[:-1]) / 2, time), 0, t.size - 1)
            for k, column in enumerate(names):
                pwm[int(column.lstrip("Chan"))] = values[at, k]
        source = "RCOU"
        if not time.size and (rows := self.old_motors()) is not None:
            source, (time, values) = "MOT", rows
            pwm = {k + 1: values[:, k] for k in range(values.shape[1])}
            self.warnings.append("Motor outputs are from MOT records, as ArduCopter wrote them before 3.2.")
            self.outputs, notes = {k: k for k in pwm}, []
        else:
            self.outputs, notes = rotors.outputs(parameters, frame_class, pwm)
        self.warnings += notes if time.size else []
        if not time.size or not self.outputs:
            return
        if rotors.BY_NUMBER in notes and (throttle := self.collective()) is not None:
            known = [pwm[o] for o in self.outputs.values() if o in pwm]
            if known and not rotors.follow(time, np.stack(known, axis=1), *throttle):
                self.warnings.append("Those outputs do not follow the throttle: they are not motors and were ignored.")
                self.outputs = {}
                return
        self.left_out = rotors.left_out(parameters, self.outputs, pwm)
        if absent := [o for o in self.outputs.values() if o not in pwm]:
            self.warnings.append(f"Servo outputs {', '.join(map(str, absent))} are not in the log.")
        missing = np.full(time.size, np.nan)
        values = np.stack([pwm.get(self.outputs[k], missing) for k in sorted(self.outputs)], axis=1)
        low, high = PWM_RANGE_US
        valid = (values >= low) & (values <= high)  # 0: the output is off
        wild = int((np.isfinite(values) & ~valid & (values != 0)).sum())
        columns = tuple(f"r{k}" for k in sorted(self.outputs))
        self._store("motors", Signal(time, values, columns, "us", "", source, valid, made=True), wild)

    def old_motors(self):
        """(time (n,), pulses (n, rotors) in rotor order) of MOT; None without. Motors that never got a pulse are left out."""
        names = [c for c in self.log.columns("MOT") if re.fullmatch(r"Mot\d{1,2}", c)]
        rows = self.table("MOT", names) if names else None
        if rows is None:
            return None
        time, values, _ = rows
        driven = (values >= PWM_RANGE_US[0]).mean(axis=0) > 0.1
        count = int(np.flatnonzero(driven)[-1]) + 1 if driven.any() else 0
        return (time, values[:, :count]) if count else None

    def imu(self) -> None:
        """IMU holds all instances, or instance 0 with IMU2 and IMU3 for the others."""
        columns = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
        message = self.first_of("IMU", "IMU2", "IMU3")
        rows = self.instance(message, columns) if message else None
        if message and rows is not None:
            if message != "IMU":
                self.warnings.append(f"IMU is not in the log; {message} was used.")
            time, values, _ = rows
            self.add("gyro", time, values[:, :3], message)
            self.add("accel", time, values[:, 3:], message)

    def rate(self) -> None:
        """RATE: rates in deg/s (centidegrees/s up to 3.3) and outputs in -1..1 (-4500..4500 up to 3.3)."""
        rows = self.table("RATE", ("R", "P", "Y", "ROut", "POut", "YOut", "AOut"))
        if rows is None:
            return
        time, values, _ = rows
        rates, control = np.radians(values[:, :3]), values[:, 3:].copy()
        del rows, values  # free the unneeded part
        some = slice(None, None, max(1, time.size // ENOUGH))
        raw_control = self._control_is_raw(time[some], control[some, :3])
        if self._rates_are_centi(time[some], rates[some], raw_control):
            rates = rates / 100.0
            self.warnings.append("RATE is in centidegrees per second in this firmware; it was scaled.")
        if raw_control:
            control = control / [RAW_TORQUE, RAW_TORQUE, RAW_TORQUE, 1.0]
            self.warnings.append(f"Controller outputs in this firmware are raw; {RAW_TORQUE:.0f} was taken as full output.")
        if _typical_peak(control[:, 3:]) > 2.0:
            control = control / [1.0, 1.0, 1.0, RAW_THROTTLE]
        self.add("rates", time, rates, "RATE")
        self.add("control", time, control, "RATE")

    def _rates_are_centi(self, time: np.ndarray, rates: np.ndarray, guess: bool) -> bool:
        """Compare |rates| with |gyro| where the vehicle turns fastest; `guess` where the log has no gyro."""
        gyro = self.signals.get("gyro")
        if gyro is None or gyro.valid is None or len(gyro) < 10 or time.size < 10:
            return guess
        at = np.clip(np.searchsorted(gyro.time, time), 0, len(gyro) - 1)
        near = (np.abs(gyro.time[at] - time) < 0.1) & gyro.valid[at].all(axis=1) & np.isfinite(rates).all(axis=1)
        if near.sum() < 10:
            return guess
        ours, theirs = np.abs(rates[near]).ravel(), np.abs(gyro.values[at[near]]).ravel()
        fast = theirs >= quantile(theirs, 0.9)
        return float(median(ours[fast])) > 10.0 * float(median(theirs[fast]))

    def _control_is_raw(self, time: np.ndarray, control: np.ndarray) -> bool:
        """True if controller outputs are in units of RAW_TORQUE for full output, or of 1, by the differences of the motors that they
        cause.

        A mixer turns an output of 1 into about half of the motors' range, depending on the frame and the thrust curve: the two answers are
        4500 times apart, and the boundary lies half-way between them. Without motors that move, by size."""
        motors = self.signals.get("motors")
        if motors is not None and len(motors) >= 10 and time.size >= 10:
            at = np.clip(np.searchsorted(motors.time, time), 0, len(motors) - 1)
            near = (np.abs(motors.time[at] - time) < 0.3) & motors.valid[at].all(axis=1) & np.isfinite(control).all(axis=1)
            differential = motors.values[at[near]]
            differential = (differential - differential.mean(axis=1, keepdims=True)) / (PWM_RANGE_US[1] - PWM_RANGE_US[0])
            # A percentile over the flight: robust against a crash, damaged records, and calm air.
            moved, output = (quantile(np.abs(v), 0.8) if v.size else 0.0 for v in (differential, control[near]))
            if moved > 5e-4 and output > 0.0:
                return output > 2.0 * np.sqrt(RAW_TORQUE) * moved
        return _typical_peak(control) > np.sqrt(RAW_TORQUE)

    def attitude(self) -> None:
        """The faster of ANG and ATT; angles to quaternions."""
        counts = self.log.counts
        message = "ANG" if counts.get("ANG", 0) > counts.get("ATT", 0) else "ATT"
        self._angles("attitude", message, ("Roll", "Pitch", "Yaw"))
        if "DesRoll" in self.log.columns(message):
            self._angles("attitude_wanted", message, ("DesRoll", "DesPitch", "DesYaw"))
        elif "RollIn" in self.log.columns(message):  # up to 3.1; YawIn is a stick, and the direction of thrust does not depend on it
            self._angles("attitude_wanted", message, ("RollIn", "PitchIn", "Yaw"))

    def _angles(self, name: str, message: str, columns) -> None:
        rows = self.table(message, columns)
        if rows is None:
            return
        time, degrees, _ = rows
        fine = np.all(np.abs(degrees) <= np.array([200.0, 100.0, 400.0]), axis=1)
        wild = int((~fine & np.isfinite(degrees).all(axis=1)).sum())
        if wild:
            text = f"{name} ({message}): {amount(wild, 'impossible value')} dropped."
            self.warnings.append(series.Impossible(wild, text))
        q = np.empty((time.size, 4))
        for start in range(0, time.size, BLOCK):
            part = slice(start, start + BLOCK)
            q[part] = quaternion(*np.radians(np.where(fine[part, None], degrees[part], 0.0)).T)
        del rows, degrees
        # q and -q are the same attitude; keep the sign that makes the series continuous.
        turned = np.einsum("ij,ij->i", q[1:], q[:-1]) < 0
        q[1:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
        same = self.signals.get("attitude")  # of the same records: share their times
        self.add(name, same.time if same is not None and np.array_equal(same.time, time) else time, q, message, fine)

    def navigation(self, parameters) -> None:
        """Velocity and position of the first core of the EKF that flew (AHRS_EKF_TYPE); collective throttle."""
        estimators = ("NKF1", "XKF1", "EKF1") if parameters.get("AHRS_EKF_TYPE") == 2 else ("XKF1", "NKF1", "EKF1")
        if message := self.first_of(*estimators):
            rows = self.instance(message, ("VN", "VE", "VD", "PN", "PE", "PD"))
            if rows is not None:
                time, values, _ = rows
                self.add("velocity", time, values[:, :3], message)
                self.add("position", time, values[:, 3:], message)
        if (throttle := self.collective()) is not None:
            self.add("throttle", throttle[0], throttle[1][:, None], "CTUN")

    def place(self) -> None:
        """Position by GPS and, without an EKF, height by barometer; and the time by GPS. Only displayed, so that damage in it causes no
        warning."""
        warnings = list(self.warnings)
        columns = self.log.columns("GPS")
        stamp = [next((c for c in aliases if c in columns), "") for aliases in (("GWk", "Week"), ("GMS", "TimeMS"))]
        rows = self.instance("GPS", ("Status", "Lat", "Lng", "Alt", "Spd", *filter(None, stamp)))
        if rows is not None:
            time, (status, latitude, longitude, altitude, speed, *clock), _ = rows[0], rows[1].T, rows[2]
            fixed = status >= 3
            gps = series.gps(time, np.column_stack([latitude, longitude]), altitude, speed, fixed, "GPS")
            if gps is not None:
                self.signals["gps"] = gps
            if all(stamp):  # week and milliseconds
                week, milliseconds = clock
                fixed &= week > 0
                self.utc_start = wall_clock.start(time[fixed], wall_clock.of_gps(week[fixed], milliseconds[fixed]))
        if "position" not in self.signals and (rows := self.instance("BARO", ("Alt",))) is not None:
            self.add("baro", *rows[:2], "BARO")
        self.warnings = warnings

    def limited(self) -> None:
        """Quantities that are only compared with the autopilot's limits, so that damage in them causes no warning."""
        warnings = list(self.warnings)
        rows = self.instance("VIBE", ("VibeX", "VibeY", "VibeZ"))
        if rows is not None:
            self.add("vibration", rows[0], rows[1].max(axis=1, keepdims=True), "VIBE")
        rows = self.instance("VIBE", ("Clip",) if "Clip" in self.log.columns("VIBE") else ("Clip0",))
        if rows is not None:
            self.add("clipping", *rows[:2], "VIBE")
        if message := self.first_of("XKF4", "NKF4", "EKF4"):
            rows = self.instance(message, ("SV", "SP", "SH", "SM"))
            if rows is not None:
                self.add("innovations", *rows[:2], message)
        self.warnings = warnings

    def collective(self):
        """(time (n,), throttle (n,), 1 is full) of CTUN; None without it."""
        column = next((c for c in ("ThO", "ThrOut") if c in self.log.columns("CTUN")), None)
        rows = self.table("CTUN", (column,)) if column else None
        if rows is None:
            return None
        time, values, _ = rows
        return time, (values / RAW_THROTTLE if _typical_peak(values) > 2.0 else values)[:, 0]

    def power(self) -> None:
        """Battery 0 (CURR up to 3.5: 3.3 logs it in hundredths) and ArduPilot's lift compensation."""
        if message := self.first_of("BAT", "CURR"):
            rows = self.instance(message, ("Volt", "Curr"))
            if rows is not None:
                time, values, codes = rows
                for k, column in enumerate(("Volt", "Curr")):
                    if codes.get(column, "f") in "hHiI":
                        values[:, k] /= 100.0
                self.add("battery", time, values, message)
        rows = self.table("MOTB", ("LiftMax", "BatVolt", "ThLimit"))
        if rows is not None:
            self.add("lift", *rows[:2], "MOTB")

    def esc(self) -> None:
        """ESC telemetry in rotor order."""
        signal = dataflash_esc.read(self.log, self.table, self.outputs, self.warnings)
        if signal is not None:
            self.signals["esc"] = signal

    def raw(self) -> None:
        """Unfiltered sensors, where there are rotor speeds: nothing else needs them. Damage in them causes no warning."""
        if "esc" in self.signals:
            warnings = list(self.warnings)
            self.signals |= dataflash_raw.read(self.log, self.instance, self.table)
            self.warnings = warnings


def _typical_peak(values: np.ndarray) -> float:
    """99th percentile of the magnitudes: the scale of a column, robust against a few damaged values."""
    finite = np.abs(values[np.isfinite(values)])
    return quantile(finite, 0.99) if finite.size else 0.0
