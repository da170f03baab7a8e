"""One vehicle's MAVLink messages as they arrive -> samples of its signals, by the definitions of `logs.tlog`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from rotorwatch.flight import Message, Signal
from rotorwatch.live.clock import Clock
from rotorwatch.logs import mavlink_frames, tlog

AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}
UNKNOWN_S = 2.0  # a message that tells of a signal and falls silent for so long gives way to another one
RATE_S = 3.0  # over which rates are counted
MOST_ROWS = 5000  # of a message, before its vehicle is known well enough to judge it
SIGNALS = ("motors", "gyro", "rates", "accel", "attitude", "velocity", "battery")


@dataclass(frozen=True)
class Layout:
    """A message as it is on the wire: name, type of its payload, seed of its check sum, and where its stamp is."""

    name: str
    kind: np.dtype
    stamp: str
    short: bool


@cache
def layouts() -> dict[int, Layout]:
    """Message id -> layout, of all messages that are read."""
    found = {}
    for name, message in tlog.layouts().items():
        kind = mavlink_frames.payload_type(message)
        fields = kind.names or ()
        stamp = "time_boot_ms" if "time_boot_ms" in fields else "time_usec" if "time_usec" in fields else ""
        found[message.id] = Layout(name, kind, stamp, stamp == "time_usec" and kind[stamp].itemsize == 4)
    return found


@cache
def _kinds() -> dict[str, np.dtype]:
    return {layout.name: layout.kind for layout in layouts().values()}


def payload(frame: bytes, size: int) -> bytes:
    """The payload of a frame, filled with zeros that MAVLink 2 cuts off, or cut, to `size` bytes."""
    head = 10 if frame[0] == 0xFD else 6
    body = bytes(frame[head : head + min(frame[1], size)])
    return body + bytes(size - len(body))


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
    from pymavlink.dialects.v20 import ardupilotmega

    return {i: mavlink_frames.payload_type(ardupilotmega.mavlink_map[i]) for i in (77, 148, 244)}


def decoded(identity: int, frame: bytes) -> dict[str, Any] | None:
    """The fields of an answer to what was asked; None for other messages."""
    kind = _answers().get(identity)
    if kind is None:
        return None
    values = np.frombuffer(payload(frame, kind.itemsize), kind)[0]
    return {name: values[name].tobytes() if values[name].ndim else values[name].item() for name in kind.names or ()}


class Frames:
    """Frames out of bytes, by pymavlink. damaged: how often bytes were no frame."""

    def __init__(self):
        from pymavlink.dialects.v20 import ardupilotmega

        self._parser = ardupilotmega.MAVLink(None)
        self._parser.robust_parsing = True
        self.damaged = 0

    def on(self, data: bytes) -> list[bytes]:
        """The sound frames that these bytes complete."""
        found = []
        try:
            messages = self._parser.parse_buffer(data) or []
        except Exception:  # whatever comes from a network must not end the watch
            self.damaged += 1
            return found
        for message in messages:
            if message.get_type() == "BAD_DATA":
                self.damaged += 1
                continue
            frame = bytes(message.get_msgbuf())
            if len(frame) >= 8 and frame[0] in (0xFD, 0xFE):
                found.append(frame)
        return found


class Messages:
    """What one vehicle has sent since the last `take`; parameters are kept. See `tlog.Messages`."""

    def __init__(self, autopilot: str, vehicle: int):
        self.autopilot, self.vehicle, self.notes = autopilot, vehicle, []
        self.clock = Clock()
        self.late = 0
        self._rows: dict[str, list[tuple[float, bytes]]] = {}
        self._parameters: dict[bytes, tuple[float, bytes]] = {}
        self._last: dict[tuple[str, str], float] = {}
        self._source: dict[str, str] = {}
        self._counts: dict[tuple[str, str], list[float]] = {}
        self._states: dict[str, float] = {}
        self._seen: dict[str, list[float]] = {}  # when the last messages arrived

    def inherit(self, earlier: Messages) -> None:
        """Parameters outlast a reboot."""
        self._parameters = {name: (0.0, body) for name, (_, body) in earlier._parameters.items()}

    @property
    def pending(self) -> bool:
        """Whether anything has come since the last `take`."""
        return bool(self._rows)

    def heard_hz(self) -> dict[str, float]:
        """Message -> how often it arrives."""
        last = max((seen[-1] for seen in self._seen.values() if seen), default=0.0)
        return {name: sum(t > last - RATE_S for t in seen) / RATE_S for name, seen in self._seen.items()}

    def add(self, layout: Layout, frame: bytes, arrival: float) -> None:
        """One frame. Raises clock.Restarted."""
        body = payload(frame, layout.kind.itemsize)
        if layout.stamp:
            scale = 1e3 if layout.stamp == "time_boot_ms" else 1.0
            time = self.clock.take(
                float(np.frombuffer(body, layout.kind)[0][layout.stamp]) * scale, arrival, layout.short
            )
            if time is None:
                return
        else:
            time = self.clock.now
        if layout.name == "PARAM_VALUE":
            self._parameters[bytes(np.frombuffer(body, layout.kind)[0]["param_id"])] = (time, body)
            return
        seen = self._seen.setdefault(layout.name, [])
        seen.append(arrival)
        del seen[:-200]
        rows = self._rows.setdefault(layout.name, [])
        rows.append((time, body))
        del rows[:-MOST_ROWS]

    def get(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """(time s (n,), table) of what has come of a message, in time order, each stamp once; or None."""
        rows = list(self._parameters.values()) if name == "PARAM_VALUE" else self._rows.get(name)
        if not rows:
            return None
        time, table = np.array([t for t, _ in rows]), np.frombuffer(b"".join(body for _, body in rows), _kinds()[name])
        order = np.argsort(time, kind="stable")
        return time[order], table[order]

    def parameters(self) -> dict[str, float]:
        """All that have come so far, by name."""
        return tlog.parameters_of(self)[0]

    def take(self, outputs: tuple[int, ...], aloft: bool) -> tuple[dict[str, Signal], list[Message]]:
        """New samples of each signal and what the autopilot said, and forget them. outputs: servo output of each rotor; aloft: in flight
        the message that tells of a signal is changed only when it falls silent."""
        signals: dict[str, Signal] = {}
        for name, options in tlog.readings(self, outputs).items():
            fresh = {s.source: self._fresh(name, s) for s in options if s is not None}
            chosen = self._chosen(name, [s for s in fresh if len(fresh[s])], aloft) if name in SIGNALS else ""
            if chosen in fresh and len(fresh[chosen]):
                signals[name] = fresh[chosen]
        messages = [m for m in tlog.messages_of(self) if self._new(m)]
        self._rows.clear()
        self.notes.clear()
        return signals, messages

    def _fresh(self, name: str, signal: Signal) -> Signal:
        """The samples that are newer than those that came before."""
        key, time = (name, signal.source), signal.time
        last = self._last.get(key, -np.inf)
        keep = (time > last) & (np.diff(time, prepend=-np.inf) > 0)
        self.late += int(np.count_nonzero(~keep))
        if keep.any():
            self._last[key] = float(time[keep][-1])
            count = self._counts.setdefault(key, [])
            count += time[keep].tolist()
            del count[: int(np.searchsorted(count, self.clock.now - RATE_S))]
        return signal.with_arrays(time[keep], signal.values[keep], signal.valid[keep])

    def _chosen(self, name: str, heard: list[str], aloft: bool) -> str:
        """The message that tells of a signal: the fastest, in order of preference."""
        now, source = self.clock.now, self._source.get(name)
        silent = source is None or now - self._last.get((name, source), -np.inf) > UNKNOWN_S
        if not silent and (aloft or name not in tlog.FASTEST):
            return source or ""
        best, rate = source if not silent else None, 0.0
        rate = len(self._counts.get((name, best), ())) if best else 0
        for other in heard:
            count = len(self._counts.get((name, other), ()))
            if best is None or count > 1.5 * rate + 10:
                best, rate = other, count
        if best is not None:
            self._source[name] = best
        return best or ""

    def _new(self, message: Message) -> bool:
        """States are told again and again; only what is new counts."""
        if message.kind in ("text", "error"):
            return True
        told = self._states.get(message.kind) != message.value
        self._states[message.kind] = message.value
        return told

    def rate_hz(self, name: str) -> float:
        """How often a signal came lately."""
        source = self._source.get(name)
        count = self._counts.get((name, source), []) if source else []
        return len([t for t in count if t > self.clock.now - RATE_S]) / RATE_S


def facts(messages: Messages, parameters: Mapping[str, float]) -> dict[str, Any]:
    """Facts of a flight, as `logs.tlog` gives them."""
    outputs = tlog.rotor_outputs(messages, parameters)
    return {"mav_type": messages.vehicle, "clock_jumps": [], "outputs": outputs, "motors_topic": "SERVO_OUTPUT_RAW"}


def known(parameters: Mapping[str, float], autopilot: str) -> bool:
    """Whether these parameters say what the airframe is."""
    if autopilot == "ArduPilot":
        return bool({"FRAME_CLASS", "FRAME"} & parameters.keys()) and "MOT_SPIN_MIN" in parameters
    return bool({"CA_ROTOR_COUNT", "SYS_AUTOSTART", "MAV_TYPE"} & parameters.keys())
