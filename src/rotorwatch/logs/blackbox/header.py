"""The header of a session of a Blackbox log: lines `H name:value` before its frames.

The lines `Field I name`, `Field I predictor` and so on lay the frames out; without those of I and P frames nothing can be read. All others
are settings of the firmware.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from rotorwatch.base.compiling.running import Rows
from rotorwatch.errors import LogError
from rotorwatch.logs.blackbox import encodings, frames
from rotorwatch.logs.blackbox.frame_sizes import CYCLE, FIELDS

START, FIELDS_START = b"H Product:Blackbox", b"H Field I name:"
BETWEEN = 1000
"""Bytes from the first to the second, at most."""
LONGEST, MOST_LINES, MOST_SESSIONS = 8192, 2000, 1000
KINDS = {"I": frames.INTRA, "P": frames.INTER, "S": frames.SLOW, "G": frames.GPS, "H": frames.HOME}
GROUPS = {encodings.TAG2_3S32: 3, encodings.TAG8_4S16: 4, encodings.TAG2_3SVARIABLE: 3}
ELIAS = (encodings.ELIAS_DELTA_U32, encodings.ELIAS_DELTA_S32, encodings.ELIAS_GAMMA_S32)
NUMBER = re.compile(r"-?\d+(\.\d+)?")
LARGEST = 1 << 31
HIGH_RESOLUTION = 10.0
"""What gyro, setpoint and sticks are multiplied by where `blackbox_high_resolution` is on."""


class Layout(NamedTuple):
    """Fields of one kind of frame: names, and numbers as in `encodings` and `frames`; signed (n,) bool."""

    names: tuple[str, ...]
    signed: np.ndarray
    encoding: tuple[int, ...]
    predictor: tuple[int, ...]


class Header(NamedTuple):
    """The header of a session. start: byte at which its frames begin; settings: name -> value, as written; layouts: kind of frame ->
    fields; lost: kinds whose fields are damaged."""

    start: int
    settings: Mapping[str, str]
    layouts: Mapping[str, Layout] = MappingProxyType({})
    lost: tuple[str, ...] = ()

    def numbers(self, name: str) -> list[float]:
        """A setting's numbers; [] where it is missing or holds something else."""
        cells = [c.strip() for c in self.settings.get(name, "").split(",")]
        return [float(c) for c in cells] if all(NUMBER.fullmatch(c) and len(c) < 20 for c in cells) else []

    def number(self, name: str, otherwise: float = 0.0) -> float:
        """The first of them."""
        values = self.numbers(name)
        return values[0] if values else otherwise

    def whole(self, name: str, otherwise: int = 0) -> int:
        """The same as a whole number of 32 bits."""
        value = self.number(name, otherwise)
        return int(value) if abs(value) < LARGEST else otherwise

    @property
    def gyro_scale(self) -> float:
        """deg/s of one count of the gyro; 0 where unknown. Baseflight's is in rad/us."""
        text = self.settings.get("gyro_scale") or self.settings.get("gyro.scale") or ""
        if not re.fullmatch(r"0x[0-9a-fA-F]{1,8}", text):
            return 0.0
        scale = struct.unpack("<f", int(text, 16).to_bytes(4, "little"))[0]
        if not 1e-12 < scale < 1e3:
            return 0.0
        return float(np.degrees(scale * 1e6)) if scale < 1e-5 else scale

    @property
    def resolution(self) -> float:
        """Counts per degree per second in setpoints, and per unit of the sticks."""
        return HIGH_RESOLUTION if self.number("blackbox_high_resolution") > 0 else 1.0

    @property
    def motor_range(self) -> tuple[float, float]:
        """Outputs at idle and at full command; (0, 0) where unknown."""
        low, high = ([*self.numbers("motorOutput"), 0.0, 0.0])[:2]
        if not 0 < low < high:
            low, high = self.number("minthrottle"), self.number("maxthrottle")
        return (low, high) if 0 < low < high < 5000 else (0.0, 0.0)

    def parameters(self) -> dict[str, float]:
        """All settings that are numbers; of lists each as name[0], name[1] .."""
        parameters_ = {}
        for name in self.settings:
            values = self.numbers(name)
            if len(values) == 1:
                parameters_[name] = values[0]
            else:
                parameters_ |= {f"{name}[{k}]": value for k, value in enumerate(values)}
        return parameters_


def starts(data) -> list[int]:
    """Bytes at which sessions begin: a log is appended to the file each time the vehicle is armed. A session whose first line is damaged
    begins at the fields of its I frames."""
    candidates = sorted({*_places(data, START), *_places(data, FIELDS_START)})
    places: list[int] = []
    for at in candidates:
        first = bytes(data[at : at + len(START)]) == START
        if first or not places or at - places[-1] > BETWEEN:
            places.append(at)
    return places[:MOST_SESSIONS]


def _places(data, text: bytes) -> list[int]:
    places: list[int] = []
    at = data.find(text)
    while at >= 0 and len(places) < MOST_SESSIONS:
        places.append(at)
        at = data.find(text, at + len(text))
    return places


def read(data, start: int, end: int) -> Header:
    """The header that begins at a byte. Raises LogError where its layout of frames is missing or invalid."""
    settings: dict[str, str] = {}
    fields: dict[tuple[str, str], str] = {}
    at = start
    for _ in range(MOST_LINES):
        if bytes(data[at : at + 2]) != b"H ":
            break
        stop = data.find(b"\n", at, min(at + LONGEST, end))
        if stop < 0:
            break
        name, colon, value = bytes(data[at + 2 : stop]).decode("latin-1").partition(":")
        if not colon or not name.isprintable():  # frames, or damage
            at = stop + 1 if name.isprintable() else at
            break
        at = stop + 1
        place = re.fullmatch(r"Field ([A-Z]) (name|signed|predictor|encoding)", name)
        if place:
            fields[place[1], place[2]] = value.strip()
        else:
            settings[name.strip()] = value.strip()
    return Header(at, settings, *_layouts(fields))


def _layouts(fields: Mapping[tuple[str, str], str]) -> tuple[dict[str, Layout], tuple[str, ...]]:
    """(layouts, kinds of frames that cannot be read). Raises LogError where I frames cannot."""
    layouts: dict[str, Layout] = {}
    lost: list[str] = []
    for kind in KINDS:
        names = fields.get(("I" if kind == "P" else kind, "name"), "").split(",")
        signed = _numbers(fields.get(("I" if kind == "P" else kind, "signed"), ""))
        encoding, predictor = (_numbers(fields.get((kind, what), "")) for what in ("encoding", "predictor"))
        if not any((kind, what) in fields for what in ("name", "encoding", "predictor")):
            continue
        fits = len(names) == len(encoding) == len(predictor) <= FIELDS and len(set(names)) == len(names)
        sign = np.array([*signed, *[1] * len(names)][: len(names)]) != 0
        layout = Layout(tuple(names), sign, encoding, predictor)
        try:
            if not fits:
                raise LogError(f"the header's list of fields of {kind} frames is damaged")
            laid_out(kind, layout)
        except LogError:
            if kind == "I":
                raise
            lost.append(kind)
        else:
            layouts[kind] = layout
    if "I" not in layouts or "time" not in layouts["I"].names:
        raise LogError("the header does not list the fields of its frames")
    return layouts, tuple(lost)


def _numbers(text: str) -> tuple[int, ...]:
    cells = text.split(",")
    return tuple(map(int, cells)) if all(re.fullmatch(r"\d{1,3}", c) for c in cells) else ()


def fill(stream: Rows, header: Header) -> None:
    """Set up a `frames.Stream` from the header."""
    rows = [(KINDS[kind], layout, *laid_out(kind, layout)) for kind, layout in header.layouts.items()]
    for number, layout, encoding, runs, steps in rows:
        target = stream.part("layouts").row(number)
        target.set(
            fields=len(layout.names), encoding=np.array(encoding), runs=len(runs), steps=len(steps),
            run_from=np.array([r[0] for r in runs]), run_to=np.array([r[1] for r in runs]),
            predictor=np.array([s[0] for s in steps]), step_from=np.array([s[1] for s in steps]),
            step_to=np.array([s[2] for s in steps]),
        )  # fmt: skip
    main = header.layouts["I"].names
    skip = _skipped(header)
    stream.set(
        version=header.whole("Data version", 2), time=main.index("time"), cycle=len(skip), skip=skip,
        motor=main.index("motor[0]") if "motor[0]" in main else 0, minthrottle=header.whole("minthrottle", 1150),
        motor_low=header.whole("motorOutput", header.whole("minthrottle", 1150)), vbatref=header.whole("vbatref", 4095),
    )  # fmt: skip


def laid_out(kind: str, layout: Layout) -> tuple[list[int], list[tuple[int, int]], list[tuple[int, int, int]]]:
    """(encodings, runs: from, to; steps: predictor, from, to) of `frames.Layout`. Raises LogError for an invalid layout."""
    known = range(12)
    if any(e not in known or e == encodings.UNUSED for e in layout.encoding) or any(p not in known for p in layout.predictor):
        raise LogError(f"the fields of {kind} frames have an unknown encoding")
    # A field that always goes up by one is not written.
    how = [encodings.NOTHING if p == frames.INCREMENT else e for e, p in zip(layout.encoding, layout.predictor)]
    count, runs, at = len(how), [], 0
    while at < count:
        most = GROUPS.get(how[at], 8 if how[at] == encodings.TAG8_8SVB else count)
        alike = ELIAS if how[at] in ELIAS else (how[at],)
        end = at + 1
        while end < count and end < at + most and how[end] in alike:
            end += 1
        if how[at] in GROUPS and end - at < most:
            raise LogError(f"the fields of {kind} frames do not fit their encoding")
        runs.append((at, end))
        at = end
    steps: list[tuple[int, int, int]] = []
    for k, what in enumerate(layout.predictor):
        motor = what == frames.MOTOR_0 and ("motor[0]" not in layout.names[:k] or kind not in "IP")
        if motor or (what == frames.HOME_COORDINATE and kind == "H"):
            raise LogError(f"the fields of {kind} frames have an invalid predictor")
        if steps and steps[-1][0] == what:
            steps[-1] = (what, steps[-1][1], k + 1)
        elif what != frames.ZERO:
            steps.append((what, k, k + 1))
        else:
            steps.append((what, k, k))
    return how, runs, [s for s in steps if s[0] != frames.ZERO]


def _skipped(header: Header) -> np.ndarray:
    """(I interval,) loops of the controller from each one that has a frame to the next one that has."""
    cycle = header.whole("I interval", 32)
    cycle = cycle if 1 <= cycle <= CYCLE else 1
    parts = re.fullmatch(r"(\d{1,5})(?:/(\d{1,5}))?", header.settings.get("P interval", "1/1"))
    share, whole = (int(parts[1]), int(parts[2])) if parts and parts[2] else (1, int(parts[1]) if parts else 1)
    whole, share = max(whole, 1), min(max(share, 1), max(whole, 1))
    loop = np.arange(cycle)
    logged = (loop == 0) | ((loop + share - 1) % whole < share)
    after = np.flatnonzero(np.r_[logged, True])  # the next I frame always has one
    return (after[np.searchsorted(after, loop, side="right")] - loop).astype(np.int32)
