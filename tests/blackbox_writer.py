"""Writes Blackbox logs, as flight controllers do, by encodings and predictions of its own: the reader is held against another hand."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np

SIGNED, UNSIGNED, NEG14, DELTA_U, DELTA_S, TAG8_8, TAG2_3, TAG8_4, NONE, TAG2_3V, GAMMA_S = (0, 1, 3, 4, 5, 6, 7, 8, 9, 10, 11)
ZERO, PREVIOUS, LINE, AVERAGE, MINTHROTTLE, MOTOR0, INC, HOME, P1500, VBATREF, MAINTIME, MINMOTOR = range(12)
END = b"E\xffEnd of log\0"
BITS = (DELTA_U, DELTA_S, GAMMA_S)


def i32(value: int) -> int:
    """The number of 32 bits that a processor keeps."""
    return struct.unpack("<i", struct.pack("<I", value % 2**32))[0]


def zigzag(value: int) -> int:
    value = i32(value)
    return 2 * value if value >= 0 else -2 * value - 1


def uvb(value: int) -> bytes:
    value, out = value % 2**32, []
    while value > 127:
        out.append(value % 128 + 128)
        value //= 128
    return bytes([*out, value])


def svb(value: int) -> bytes:
    return uvb(zigzag(value))


def neg14(value: int) -> bytes:
    assert -8191 <= value <= 8191
    return uvb(-value % 2**14)


def tag8_8svb(values) -> bytes:
    if len(values) == 1:
        return svb(values[0])
    head = sum(1 << k for k, v in enumerate(values) if v)
    return bytes([head]) + b"".join(svb(v) for v in values if v)


def fits(value: int, bits: int) -> bool:
    return -(2 ** (bits - 1)) <= value < 2 ** (bits - 1)


def packed(values, sizes, lead_bits: int) -> bytes:
    """A lead of some bits, then numbers of so many bits, the highest first."""
    text = "".join(format(v % 2**s, f"0{s}b") for v, s in zip(values, sizes))
    text = format(lead_bits, "02b") + text
    return int(text, 2).to_bytes(len(text) // 8, "big")


def by_bytes(values) -> bytes:
    sizes = [next(n for n in (1, 2, 3, 4) if fits(v, 8 * n)) for v in values]
    lead = 0xC0 | sum((n - 1) << 2 * k for k, n in enumerate(sizes))
    return bytes([lead]) + b"".join((v % 2 ** (8 * n)).to_bytes(n, "little") for v, n in zip(values, sizes))


def tag2_3s32(values) -> bytes:
    if all(fits(v, 2) for v in values):
        return packed(values, (2, 2, 2), 0)
    if all(fits(v, 4) for v in values):
        return packed((0, *values), (2, 4, 4, 4), 1)
    if all(fits(v, 6) for v in values):
        return bytes([0x80 | values[0] % 64, values[1] % 256, values[2] % 256])  # the firmware leaves the sign above
    return by_bytes(values)


def tag2_3svariable(values) -> bytes:
    for lead, sizes in enumerate(((2, 2, 2), (5, 5, 4), (8, 7, 7))):
        if all(fits(v, s) for v, s in zip(values, sizes)):
            return packed(values, sizes, lead)
    return by_bytes(values)


def tag8_4s16(values) -> bytes:
    sizes = [0 if v == 0 else next(k for k, bits in ((1, 4), (2, 8), (3, 16)) if fits(v, bits)) for v in values]
    text = "".join(format(v % 2 ** (4, 8, 16)[s - 1], f"0{(4, 8, 16)[s - 1]}b") for v, s in zip(values, sizes) if s)
    text += "0" * (-len(text) % 8)
    return bytes([sum(s << 2 * k for k, s in enumerate(sizes))]) + (int(text, 2).to_bytes(len(text) // 8, "big") if text else b"")


def tag8_4s16_v1(values) -> bytes:
    """Data version 1: numbers of 4 bits come in pairs."""
    sizes, body, k = [0, 0, 0, 0], b"", 0
    while k < 4:
        if values[k] == 0:
            k += 1
        elif fits(values[k], 4) and k < 3 and fits(values[k + 1], 4):
            sizes[k] = 1
            body += bytes([values[k] % 16 | values[k + 1] % 16 << 4])
            k += 2
        elif fits(values[k], 8):
            sizes[k] = 2
            body += struct.pack("<b", values[k])
            k += 1
        else:
            sizes[k] = 3
            body += struct.pack("<h", values[k])
            k += 1
    return bytes([sum(s << 2 * k for k, s in enumerate(sizes))]) + body


def gamma(value: int) -> str:
    """Elias' gamma code of a number from 1."""
    binary = format(value, "b")
    return "0" * (len(binary) - 1) + binary


def elias(value: int, how: int) -> str:
    """Bits of a number; the two largest share a code and a bit tells them apart."""
    number = value % 2**32 if how == DELTA_U else zigzag(value)
    tail = "" if number < 2**32 - 2 else "1" if number == 2**32 - 1 else "0"
    binary = format(min(number + 1, 2**32 - 1), "b")
    return (gamma(binary.__len__()) + binary[1:] if how != GAMMA_S else gamma(int(binary, 2))) + tail


GROUPS = {
    SIGNED: lambda group: svb(group[0]), UNSIGNED: lambda group: uvb(group[0]), NEG14: lambda group: neg14(group[0]),
    TAG8_8: tag8_8svb, TAG2_3: tag2_3s32, TAG2_3V: tag2_3svariable, TAG8_4: tag8_4s16,
}  # fmt: skip


@dataclass
class Field:
    name: str
    signed: int = 1
    predict: int = ZERO
    encode: int = SIGNED
    predict_p: int = PREVIOUS
    encode_p: int = SIGNED


def quotient(a: int) -> int:
    """Half of it, towards 0."""
    return -(-a // 2) if a < 0 else a // 2


@dataclass
class Log:
    """One session. main, slow, gps, home: fields of its frames; settings: of its header, in order."""

    main: list[Field]
    slow: list[Field] = field(default_factory=list)
    gps: list[Field] = field(default_factory=list)
    home: list[Field] = field(default_factory=list)
    settings: dict = field(default_factory=dict)
    interval: tuple[int, int, int] = (32, 1, 1)  # I interval, and P interval as a share
    version: int = 2

    def __post_init__(self):
        self.data, self.before, self.home_row = b"", [], []
        self.numbers = {"minthrottle": 1150, "vbatref": 4095, "motorOutput": "48,2047", **self.settings}

    def header(self) -> bytes:
        lines = ["Product:Blackbox flight data recorder by Nicholas Sherlock", f"Data version:{self.version}"]
        lines.append(f"I interval:{self.interval[0]}")
        for kind, fields in (("I", self.main), ("S", self.slow), ("G", self.gps), ("H", self.home)):
            if fields:
                lines += [
                    f"Field {kind} {what}:" + ",".join(str(getattr(f, at)) for f in fields)
                    for what, at in (("name", "name"), ("signed", "signed"), ("predictor", "predict"), ("encoding", "encode"))
                ]
            if kind == "I":
                lines += [
                    f"Field P {what}:" + ",".join(str(getattr(f, at)) for f in fields)
                    for what, at in (("predictor", "predict_p"), ("encoding", "encode_p"))
                ]
        lines.append("P interval:{}/{}".format(*self.interval[1:]))
        lines += [f"{name}:{value}" for name, value in self.numbers.items()]
        return "".join(f"H {line}\n" for line in lines).encode("latin-1")

    def add(self, kind: str, row) -> None:
        """A frame of kind I, P, S, G or H. row: a number for each field."""
        row = list(row)
        fields = {"I": self.main, "P": self.main, "S": self.slow, "G": self.gps, "H": self.home}[kind]
        how = [(f.predict_p, f.encode_p) if kind == "P" else (f.predict, f.encode) for f in fields]
        rest = [None if p == INC else i32(v - self.expected(kind, k, p, row)) for k, (v, (p, _)) in enumerate(zip(row, how))]
        self.data += kind.encode() + self.encoded(rest, [NONE if p == INC else e for p, e in how])
        if kind == "I":
            self.before = [row, row]
        elif kind == "P":
            self.before = [row, self.before[0]]
        elif kind == "H":
            self.home_row = row

    def expected(self, kind: str, k: int, how: int, row) -> int:
        last, second = self.before if self.before else ([0] * len(self.main), [0] * len(self.main))
        if kind not in "IP" and how in (PREVIOUS, LINE, AVERAGE):
            return 0
        if kind == "I" and how == LINE:
            return 0
        return {
            ZERO: lambda: 0,
            PREVIOUS: lambda: last[k],
            LINE: lambda: 2 * last[k] - second[k],
            AVERAGE: lambda: last[k] if kind == "I" else quotient(last[k] + second[k]),
            MINTHROTTLE: lambda: int(self.numbers["minthrottle"]),
            MOTOR0: lambda: row[[f.name for f in self.main].index("motor[0]")],
            HOME: lambda: self.home_row[[f.predict for f in self.gps[:k]].count(HOME)] if self.home_row else 0,
            P1500: lambda: 1500,
            VBATREF: lambda: int(self.numbers["vbatref"]),
            MAINTIME: lambda: last[[f.name for f in self.main].index("time")] if self.before else 0,
            MINMOTOR: lambda: int(str(self.numbers["motorOutput"]).split(",")[0]),
        }[how]()

    def encoded(self, values, how) -> bytes:
        out, k = b"", 0
        while k < len(values):
            alike = BITS if how[k] in BITS else (how[k],)
            most = {TAG2_3: 3, TAG2_3V: 3, TAG8_4: 4, TAG8_8: 8}.get(how[k], len(values) if how[k] in BITS else 1)
            end = k + 1
            while end < len(values) and end < k + most and how[end] in alike:
                end += 1
            group = values[k:end]
            if how[k] in BITS:
                text = "".join(elias(v, e) for v, e in zip(group, how[k:end]))
                text += "0" * (-len(text) % 8)
                out += int(text, 2).to_bytes(len(text) // 8, "big")
            elif how[k] != NONE:
                out += (GROUPS if self.version > 1 else {**GROUPS, TAG8_4: tag8_4s16_v1})[how[k]](group)
            k = end
        return out

    def event(self, kind: int, *numbers: int) -> None:
        """Numbers as unsigned ones of variable length; 13 is an adjustment: function and new value."""
        self.data += bytes([69, kind])
        if kind == 13:
            self.data += bytes([numbers[0]]) + svb(numbers[1])
        else:
            self.data += b"".join(map(uvb, numbers))

    def bytes(self, end: bool = True) -> bytes:
        return self.header() + self.data + (END if end else b"")


def betaflight(rotors: int = 4, more: list[Field] = (), **settings) -> Log:
    """A session with the fields of Betaflight 4.5. settings: of the header, in place of its usual ones."""
    axes = [Field(f"axis{part}[{k}]", 1, ZERO, SIGNED, PREVIOUS, TAG2_3 if part == "I" else SIGNED) for part in "PIDF" for k in range(3)]
    motors = [Field("motor[0]", 0, MINMOTOR, UNSIGNED, AVERAGE, SIGNED)]
    motors += [Field(f"motor[{k}]", 0, MOTOR0, SIGNED, AVERAGE, SIGNED) for k in range(1, rotors)]
    fields = [
        Field("loopIteration", 0, ZERO, UNSIGNED, INC, NONE), Field("time", 0, ZERO, UNSIGNED, LINE, SIGNED), *axes,
        *(Field(f"rcCommand[{k}]", 1, ZERO, SIGNED, PREVIOUS, TAG8_4) for k in range(3)),
        Field("rcCommand[3]", 0, ZERO, UNSIGNED, PREVIOUS, TAG8_4),
        *(Field(f"setpoint[{k}]", 1, ZERO, SIGNED, PREVIOUS, TAG8_4) for k in range(4)),
        Field("vbatLatest", 0, VBATREF, NEG14, PREVIOUS, TAG8_8), Field("amperageLatest", 1, ZERO, SIGNED, PREVIOUS, TAG8_8),
        *(Field(f"gyroADC[{k}]", 1, ZERO, SIGNED, AVERAGE, SIGNED) for k in range(3)),
        *(Field(f"accSmooth[{k}]", 1, ZERO, SIGNED, AVERAGE, SIGNED) for k in range(3)),
        *more, *motors,
    ]  # fmt: skip
    slow = [Field("flightModeFlags", 0, ZERO, UNSIGNED), Field("stateFlags", 0, ZERO, UNSIGNED)]
    slow += [Field(name, 0, ZERO, TAG2_3) for name in ("failsafePhase", "rxSignalReceived", "rxFlightChannelsValid")]
    usual = {
        "Firmware type": "Betaflight", "Firmware revision": "Betaflight 4.5.1 (77d01ba3b) STM32F7X2",
        "Log start datetime": "2026-03-04T05:06:07.890+00:00", "Craft name": "five inch", "minthrottle": 1070, "maxthrottle": 2000,
        "gyro_scale": "0x3f800000", "motorOutput": "158,2047", "acc_1G": 2048, "vbat_scale": 110, "vbatcellvoltage": "330,350,430",
        "vbatref": 1640, "currentSensor": "0,400", "features": 541130760, "motor_poles": 14, "pidsum_limit": 500, "pidsum_limit_yaw": 400,
    }  # fmt: skip
    return Log(fields, slow, settings={**usual, **settings})


def rows(log: Log, frames, **columns):
    """A row for each of so many frames: columns by field's name ("gyroADC_0" is gyroADC[0]), numbers or sequences; 0 for the others."""
    names = [f.name for f in log.main]
    table = {name.replace("_0", "[0]").replace("_1", "[1]").replace("_2", "[2]").replace("_3", "[3]"): v for name, v in columns.items()}
    assert set(table) <= set(names), set(table) - set(names)
    for k in range(frames):
        yield [int(table[n][k]) if n in table and hasattr(table[n], "__len__") else int(table.get(n, 0)) for n in names]


def fly(log: Log, made, interval: int = 32) -> Log:
    """Main frames of these rows, I frames among them."""
    for k, row in enumerate(made):
        log.add("P" if k % interval else "I", row)
    return log


def simulated(flight, path):
    """A flight of rotorwatch_lab/simulation/fpv.py as Betaflight logs it, each second sample."""
    more = [Field(f"eRPM[{k}]", 0) for k in range(4)]
    log = betaflight(more=more)
    step = slice(None, None, 2)
    motors = np.rint(158 + flight["motors"].values[step] * (2047 - 158)).astype(int)
    motors[flight["motors"].values[step] <= 0.0] = 158
    gyro = np.rint(np.degrees(flight["gyro"].values[step] * [1, -1, -1])).astype(int)
    erpm = np.rint(flight["esc"].values[step, :4] * 60 / (2 * np.pi) * 7 / 100).astype(int)
    columns = {f"motor_{k}": motors[:, k] for k in range(4)} | {f"gyroADC_{k}": gyro[:, k] for k in range(3)}
    columns |= {f"eRPM_{k}": erpm[:, k] for k in range(4)}
    columns |= {"setpoint_3": np.rint(1000 * flight["throttle"].values[step, 0]).astype(int), "accSmooth_2": 2048}
    count = len(motors)
    columns |= {"loopIteration": np.arange(count), "time": 2000 * np.arange(count)}
    path.write_bytes(fly(log, rows(log, count, **columns)).bytes())
    return path
