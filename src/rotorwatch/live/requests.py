"""Messages to a vehicle: requests for parameters, rates, and identity. Nothing here commands it.

Parameter protocol: https://mavlink.io/en/services/parameter.html; rates: https://mavlink.io/en/mavgen_notes/message_intervals.html. The
sender is an onboard computer of system 254, so that no autopilot takes it for its ground station.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping

from rotorwatch.base.backend import cache_folder
from rotorwatch.live.framing import Outgoing, outgoing

SYSTEM, COMPONENT = 254, 191
REQUEST_MESSAGE, SET_INTERVAL, GET_INTERVAL = 512, 511, 510
VERSION_ID = 148
LIST_S, MISSING_S, AT_ONCE, ROUNDS = 3.0, 0.7, 12, 40
ACK_S, TRIES = 0.7, 3
CACHED_VEHICLES = 1000  # cached vehicles: a sender with many names must not fill the disk
FAST = {"SERVO_OUTPUT_RAW": 50.0, "ATTITUDE": 50.0, "IMU": 50.0}
SLOW = {"SERVO_OUTPUT_RAW": 20.0, "ATTITUDE": 25.0, "IMU": 25.0}
BESIDES = {"LOCAL_POSITION_NED": 5.0, "ATTITUDE_TARGET": 5.0, "EXTENDED_SYS_STATE": 2.0, "SYS_STATUS": 2.0}
IDS = {
    **{"SERVO_OUTPUT_RAW": 36, "ATTITUDE": 30, "RAW_IMU": 27, "HIGHRES_IMU": 105, "LOCAL_POSITION_NED": 32},
    **{"ATTITUDE_TARGET": 83, "EXTENDED_SYS_STATE": 245, "SYS_STATUS": 1},
}
STREAMS = {"IMU": 1, "SYS_STATUS": 2, "SERVO_OUTPUT_RAW": 3, "LOCAL_POSITION_NED": 6, "ATTITUDE": 10}

Send = Callable[[Outgoing], None]


def heartbeat() -> Outgoing:
    """Keeps links open that only answer to senders: an onboard computer (18) without an autopilot (8), active (4)."""
    return outgoing("HEARTBEAT", type=18, autopilot=8, system_status=4, mavlink_version=3)


def _to(system: int, component: int) -> dict[str, int]:
    return {"target_system": system, "target_component": component}


class Parameters:
    """All parameters of one vehicle, requested until complete. complete: all are there; given_up: they will not come; used: they have been
    used."""

    def __init__(self, system: int, component: int):
        self._to, self._next, self._round = _to(system, component), 0.0, 0
        self._there: set[int] = set()
        self.count = 0
        self.given_up = self.used = False

    @property
    def complete(self) -> bool:
        return self.count > 0 and len(self._there) >= self.count

    @property
    def share(self) -> float:
        """Share of them received."""
        return len(self._there) / self.count if self.count else 0.0

    def received(self, index: int, count: int, now: float) -> None:
        """A parameter was received. An index of 65535 is one that was set, not requested."""
        if index < count < 65535:
            self.count = count
            if index not in self._there:
                self._there.add(index)
                self._next, self._round = now + MISSING_S, 0

    def step(self, now: float, send: Send) -> None:
        """Request the missing ones when nothing has come for a while."""
        if self.complete or self.given_up or now < self._next:
            return
        self._round += 1
        if self._round > ROUNDS:
            self.given_up = True
            return
        if not self.count:
            send(outgoing("PARAM_REQUEST_LIST", **self._to))
            self._next = now + LIST_S
            return
        missing = [k for k in range(self.count) if k not in self._there]
        for k in missing[:AT_ONCE]:
            send(outgoing("PARAM_REQUEST_READ", **self._to, param_index=k))
        self._next = now + MISSING_S


class Identity:
    """Vehicle and firmware. key: for the cache of its parameters; None while unknown."""

    def __init__(self, system: int, component: int):
        self._to, self._requested, self._next = _to(system, component), 0, 0.0
        self.key: str | None = None

    def received(self, uid: int, uid2: bytes, version: int, autopilot: str) -> None:
        who = bytes(uid2).hex().strip("0") or (f"{uid:x}" if uid else "")
        if who and version:
            self.key = f"{autopilot}-{who}-{version:08x}"

    def step(self, now: float, send: Send) -> None:
        if self.key is None and self._requested < TRIES and now >= self._next:
            self._requested, self._next = self._requested + 1, now + ACK_S
            send(outgoing("COMMAND_LONG", **self._to, command=REQUEST_MESSAGE, param1=VERSION_ID))


class Rates:
    """The rates requested of one vehicle, one after the other, and the original ones."""

    def __init__(self, system: int, component: int, autopilot: str, slow: bool):
        imu = "HIGHRES_IMU" if autopilot == "PX4" else "RAW_IMU"
        wanted = {**(SLOW if slow else FAST), **BESIDES}
        self._to, self._imu = _to(system, component), imu
        self._left = [(imu if name == "IMU" else name, hz) for name, hz in wanted.items()]
        self._tries, self._next, self._requested = 0, 0.0, False
        self._before: dict[int, int] = {}
        self._set: list[int] = []
        self._streams: dict[int, int] = {}
        self._all = dict(self._left)

    @property
    def done(self) -> bool:
        return not self._left

    def interval(self, message: int, us: int) -> None:
        """The vehicle reports the interval of a message."""
        if message not in self._set:
            self._before[message] = us

    def answered(self, command: int, result: int) -> None:
        """The vehicle has answered a command."""
        if command == SET_INTERVAL and self._left and self._requested:
            if result == 0:
                self._set.append(IDS[self._left[0][0]])
                self._after()
            elif result != 5:  # 5: in progress
                self._after(skip=False)

    def _after(self, skip: bool = True) -> None:
        if not skip and not self._set:  # it does not support the command at all
            self._tries = TRIES
            return
        del self._left[0]
        self._tries, self._next, self._requested = 0, 0.0, False

    def step(self, now: float, send: Send, seen_hz: Mapping[str, float]) -> None:
        """Send requests, and repeat unanswered ones; without any answer use the old streams. seen_hz: present rates."""
        while self._left and seen_hz.get(self._left[0][0], 0.0) >= 0.8 * self._left[0][1] and not self._requested:
            self._after()
        if not self._left or now < self._next:
            return
        name, hz = self._left[0]
        if self._tries >= TRIES:
            if self._set:  # it does not support this one
                self._after()
            else:
                self._by_streams(send, seen_hz)
            return
        first = not self._tries
        self._tries, self._next, self._requested = self._tries + 1, now + ACK_S, True
        if first:
            send(self._command(GET_INTERVAL, IDS[name], 0))
        send(self._command(SET_INTERVAL, IDS[name], 1e6 / hz))

    def _command(self, command: int, message: int, interval: float) -> Outgoing:
        return outgoing("COMMAND_LONG", **self._to, command=command, param1=message, param2=interval)

    def _stream(self, stream: int, hz: int, start: bool) -> Outgoing:
        fields = {"req_stream_id": stream, "req_message_rate": hz, "start_stop": start}
        return outgoing("REQUEST_DATA_STREAM", **self._to, **fields)

    def _by_streams(self, send: Send, seen_hz: Mapping[str, float]) -> None:
        for name, hz in self._all.items():
            stream = STREAMS.get("IMU" if name == self._imu else name)
            if stream is not None:
                self._streams[stream] = round(seen_hz.get(name, 0.0))
                send(self._stream(stream, round(hz), True))
        self._left = []

    def restore(self, send: Send) -> None:
        """Restore the original rates; where unknown, the defaults."""
        for message in self._set:
            before = self._before.get(message, 0)
            send(self._command(SET_INTERVAL, message, before if before else 0))
        for stream, hz in self._streams.items():
            send(self._stream(stream, max(hz, 1), hz > 0))
        self._set, self._streams, self._left = [], {}, []


def cached(key: str) -> dict[str, float]:
    """The cached parameters of a vehicle with its firmware; empty without any."""
    try:
        parameters = json.loads((cache_folder() / "parameters" / f"{key}.json").read_text("utf-8"))
        return {str(name): float(value) for name, value in parameters.items()}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}


def store(key: str, parameters: Mapping[str, float]) -> None:
    """Cache the parameters of a vehicle; where that fails, they are requested again."""
    folder = cache_folder() / "parameters"
    part = folder / f".{key}.{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        part.write_text(json.dumps(dict(parameters)), "utf-8")
        os.replace(part, folder / f"{key}.json")
        there = list(folder.glob("*.json"))
        if len(there) > CACHED_VEHICLES:  # remove the older half at once
            for old in sorted(there, key=lambda path: path.stat().st_mtime)[: len(there) - CACHED_VEHICLES // 2]:
                old.unlink(missing_ok=True)
    except OSError:
        pass
