"""MAVLink messages of a vehicle as they arrive -> samples of its signals, by the definitions of `logs.tlog`."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from rotorwatch.flight import Message, Signal
from rotorwatch.live.clock import Clock
from rotorwatch.logs import mavlink_esc, mavlink_frames, mavlink_messages, tlog

AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}
UNKNOWN_S = 2.0  # silence after which the source of a signal is replaced
RATE_S = 3.0  # window for rates
MOST_ROWS = 5000  # of a message, before its vehicle can be evaluated
MOST_PARAMETERS = 4096  # by name; autopilots have less than half
SIGNALS = (
    "motors", "gyro", "accel", "attitude", "attitude_wanted", "velocity", "position", "battery", "vibration", "clipping", "innovations",
)  # fmt: skip
TICK = ("motors", "gyro", "accel")
ESC = {mavlink_esc.STATUS, *mavlink_esc.TELEMETRY}
WAIT_S = 0.1  # for inputs of a tick, before it is made without them


@dataclass(frozen=True)
class Layout:
    """A message on the wire: name, type of its payload; format and offset of its stamp (None without one), its unit in us, and whether it
    has 32 bits only."""

    name: str
    kind: np.dtype
    stamp: struct.Struct | None
    offset: int
    scale: float
    short: bool


@cache
def layouts() -> dict[int, Layout]:
    """Message id -> layout, of all messages that are read."""
    by_id = {}
    for name, message in tlog.layouts().items():
        kind = mavlink_frames.payload_type(message)
        fields: Any = kind.fields or {}
        stamp = next((n for n in ("time_boot_ms", "time_usec") if n in fields), None)
        if stamp is None:
            by_id[message.id] = Layout(name, kind, None, 0, 1.0, False)
            continue
        size, offset = fields[stamp][0].itemsize, fields[stamp][1]
        reads = struct.Struct("<I" if size == 4 else "<Q")
        scale = 1e3 if stamp == "time_boot_ms" else 1.0
        by_id[message.id] = Layout(name, kind, reads, offset, scale, stamp == "time_usec" and size == 4)
    return by_id


@cache
def _kinds() -> dict[str, np.dtype]:
    return {layout.name: layout.kind for layout in layouts().values()}


@cache
def _parts() -> dict[str, str]:
    """Message -> the field that names its part of the vehicle: several messages may have the same stamp."""
    return {name: part for name, kind in _kinds().items() for part in ("port", "index") if part in (kind.names or ())}


def payload(frame: bytes, size: int) -> bytes:
    """The payload of a frame, filled with zeros that MAVLink 2 cuts off, or cut, to `size` bytes."""
    head = 10 if frame[0] == 0xFD else 6
    return frame[head : head + min(frame[1], size)].ljust(size, b"\0")


def row(frame: bytes, layout: Layout) -> np.void:
    """The fields of a frame."""
    return np.frombuffer(payload(frame, layout.kind.itemsize), layout.kind)[0]


def header(frame: bytes) -> tuple[int, int, int, int]:
    """(running number, system, component, message id) of a frame."""
    if frame[0] == 0xFD:
        return frame[4], frame[5], frame[6], int.from_bytes(frame[7:10], "little")
    return frame[2], frame[3], frame[4], frame[5]


@cache
def _answers() -> dict[int, np.dtype]:
    return {i: mavlink_frames.payload_type(mavlink_messages.by_id()[i]) for i in (76, 77, 110, 148, 244, 412)}


def fields(values: np.void) -> dict[str, Any]:
    """The fields of a message as plain values, arrays as bytes."""
    return {name: values[name].tobytes() if values[name].ndim else values[name].item() for name in values.dtype.names or ()}


def decoded(identity: int, frame: bytes) -> dict[str, Any] | None:
    """The fields of a request, or of an answer to one; None for other messages."""
    kind = _answers().get(identity)
    if kind is None:
        return None
    return fields(np.frombuffer(payload(frame, kind.itemsize), kind)[0])


class Messages:
    """Messages of a vehicle since the last `take`; parameters are kept. See `tlog.Messages`."""

    def __init__(self, autopilot: str, vehicle: int):
        self.autopilot, self.vehicle, self.notes = autopilot, vehicle, []
        self.clock = Clock()
        self.late = 0
        self._rows: dict[str, tuple[list[float], list[bytes]]] = {}
        self._tables: dict[str, tuple[np.ndarray, np.ndarray] | None] = {}  # rows since the last `take`
        self._parameters: dict[bytes, tuple[float, bytes]] = {}
        self._newest: dict[tuple[str, int], float] = {}  # stamp of the last message taken, by part
        self._counts: dict[str, deque[float]] = {}
        self._source: dict[str, str] = {}
        self._usable_at: dict[str, float] = {}  # last usable sample, by source of a signal
        self._states: dict[tuple[str, str], float] = {}
        self._seen: dict[str, deque[float]] = {}  # arrivals of the last messages

    def inherit(self, earlier: Messages) -> None:
        """Parameters outlast a reboot."""
        self._parameters = {name: (0.0, body) for name, (_, body) in earlier._parameters.items()}

    @property
    def pending(self) -> bool:
        """True if there are messages since the last `take`."""
        return bool(self._rows)

    def heard(self, *names: str) -> bool:
        """True if any of these messages has been received."""
        return any(name in self._seen for name in names)

    def reached(self, time: float) -> bool:
        """True if all inputs of a tick are there up to `time` s; missing ones are waited for up to WAIT_S."""
        now = self.clock.now
        if now < time:
            return False
        if now >= time + WAIT_S:
            return True
        for name in TICK:
            source = self._source.get(name)
            rows = self._rows.get(source or "")
            if source is not None and (rows is None or rows[0][-1] < time):
                return False
        return True

    def rates_hz(self) -> dict[str, float]:
        """Message -> its rate of arrival."""
        last = max((seen[-1] for seen in self._seen.values() if seen), default=0.0)
        return {name: sum(t > last - RATE_S for t in seen) / RATE_S for name, seen in self._seen.items()}

    def add(self, layout: Layout, frame: bytes, arrival: float) -> None:
        """Add a frame. Raises clock.Restarted."""
        body = payload(frame, layout.kind.itemsize)
        if layout.stamp is not None:
            time = self.clock.take(layout.stamp.unpack_from(body, layout.offset)[0] * layout.scale, arrival, layout.short)
            if time is None:
                return
        else:
            time = self.clock.now
        if layout.name == "PARAM_VALUE":
            name = bytes(np.frombuffer(body, layout.kind)[0]["param_id"])
            if name in self._parameters or len(self._parameters) < MOST_PARAMETERS:
                self._parameters[name] = (time, body)
            return
        seen = self._seen.get(layout.name)
        if seen is None:
            seen = self._seen[layout.name] = deque(maxlen=200)
        seen.append(arrival)
        rows = self._rows.get(layout.name)
        if rows is None:
            rows = self._rows[layout.name] = ([], [])
        rows[0].append(time)
        rows[1].append(body)
        if len(rows[0]) > MOST_ROWS:
            del rows[0][0], rows[1][0]

    def get(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """(time s (n,), table) of a message's new rows, in time order, each stamp once; or None. Rows older than the last one taken are
        late and left out."""
        if name == "PARAM_VALUE":
            rows = list(self._parameters.values())
            if not rows:
                return None
            table = np.frombuffer(b"".join(body for _, body in rows), _kinds()[name])
            return np.array([time for time, _ in rows]), table
        if name not in self._rows:
            return None
        if name not in self._tables:
            self._tables[name] = self._table(name)
        return self._tables[name]

    def _table(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        times, bodies = self._rows[name]
        time, table = np.array(times), np.frombuffer(b"".join(bodies), _kinds()[name])
        if name in tlog.UNTIMED:  # these have the time of the message before, several the same
            return time, table
        part = _parts().get(name)
        numbers = [0] if part is None else sorted(set(table[part].tolist()))
        if len(numbers) == 1:
            return self._once(name, numbers[0], time, table)
        by_part = [self._once(name, n, time[table[part] == n], table[table[part] == n]) for n in numbers]
        kept = [one for one in by_part if one is not None]
        if not kept:
            return None
        time, table = (np.concatenate(columns) for columns in zip(*kept))
        order = np.argsort(time, kind="stable")
        return time[order], table[order]

    def _once(self, name: str, part: int, time: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Rows in time order, each stamp once, and only those after the last one taken."""
        last = self._newest.get((name, part), -np.inf)
        if not (time[0] > last and (time.size == 1 or (time[1:] > time[:-1]).all())):  # rare
            order = np.argsort(time, kind="stable")
            time, table = time[order], table[order]
            keep = (time > last) & (np.diff(time, prepend=-np.inf) > 0)
            self.late += int(np.count_nonzero(~keep))
            if not keep.any():
                return None
            time, table = time[keep], table[keep]
        self._newest[name, part] = float(time[-1])
        return time, table

    def parameters(self) -> dict[str, float]:
        """All parameters received so far, by name."""
        return tlog.parameters_of(self)[0]

    def take(self, outputs: tlog.Outputs, aloft: bool) -> tuple[dict[str, Signal], list[Message]]:
        """New samples of each signal and new texts of the autopilot, which are removed. outputs: of `tlog.rotor_outputs`; aloft: in flight
        the source of a signal changes only when it falls silent."""
        now = self.clock.now
        there = {name for name in self._rows if self.get(name) is not None}
        for name in there:
            count = self._counts.setdefault(name, deque())
            count.extend(self._rows[name][0])
            while count and count[0] < now - RATE_S:
                count.popleft()
        signals: dict[str, Signal] = {}
        options = tlog.readings(outputs)
        for name in SIGNALS:
            readings = [reading for reading in options[name] if reading.source in there]
            for reading in self._order(name, readings, aloft) if readings else ():
                signal = reading.make(self)
                if signal is not None:
                    signals[name] = signal
                    self._source[name], self._usable_at[name] = reading.source, now
                    break
        if not ESC.isdisjoint(there):
            esc = mavlink_esc.read(self.get, outputs.numbers, self.notes)
            if esc is not None:
                signals["esc"] = esc
        messages = [m for m in tlog.messages_of(self) if self._new(m)]
        self._rows.clear()
        self._tables.clear()
        self.notes.clear()
        return signals, messages

    def _order(self, name: str, readings: list[tlog.Reading], aloft: bool) -> list[tlog.Reading]:
        """Sources of a signal among the received messages, with fallbacks: the fastest, in order of preference."""
        source = self._source.get(name)
        silent = source is None or self.clock.now - self._usable_at[name] > UNKNOWN_S
        current = [reading for reading in readings if reading.source == source]
        if not silent and (aloft or name not in tlog.FASTEST or len(readings) == len(current)):
            return current
        best = None if silent else source
        for reading in readings:
            if best is None or self._count(reading.source) > 1.5 * self._count(best) + 10:
                best = reading.source
        return sorted(readings, key=lambda reading: reading.source != best)

    def _count(self, source: str) -> int:
        return len(self._counts.get(source, ()))

    def _new(self, message: Message) -> bool:
        """True if a message is new: states are sent repeatedly."""
        if message.kind in ("text", "error"):
            return True
        part = message.text.partition(" ")[0] if message.kind == "health" else ""
        changed = self._states.get((message.kind, part)) != message.value
        self._states[message.kind, part] = message.value
        return changed


def facts(messages: Messages, parameters: Mapping[str, float], outputs: tlog.Outputs) -> dict[str, Any]:
    """Facts of a flight, as `logs.tlog` gives them. outputs: of `tlog.rotor_outputs`."""
    limits = tlog.output_limits(messages, parameters, outputs)
    return {"mav_type": messages.vehicle, "clock_jumps": [], "outputs": outputs.numbers, **limits}


def known(parameters: Mapping[str, float], autopilot: str) -> bool:
    """True if these parameters determine the airframe."""
    if autopilot == "ArduPilot":
        return bool({"FRAME_CLASS", "FRAME"} & parameters.keys()) and "MOT_SPIN_MIN" in parameters
    return bool({"CA_ROTOR_COUNT", "SYS_AUTOSTART", "MAV_TYPE"} & parameters.keys())
