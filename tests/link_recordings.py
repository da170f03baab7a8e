"""Recorded telemetry, frame by frame over a link in memory: what `watch --listen-only` tells of it."""

from __future__ import annotations

import lzma
import struct
from pathlib import Path

from rotorwatch.live.endpoint import Endpoint
from rotorwatch.live.framing import V2
from rotorwatch.live.link import Link

STEP_S = 0.04


class Heard(Endpoint):
    """An endpoint in memory that only gives."""

    def __init__(self):
        super().__init__("udp:14550")
        self.open, self._queue = True, []

    def put(self, data):
        self._queue.append(("a", data))

    def receive(self, wait_s=0.0):
        queue, self._queue = self._queue, []
        return queue

    def send(self, data, peer=None):
        raise AssertionError("a watch that only listens has sent something")


def frames(path: Path) -> list[tuple[float, bytes]]:
    """[(time of reception s, frame)] of a .tlog or .tlog.xz whose frames are all sound."""
    data = lzma.decompress(path.read_bytes()) if path.suffix == ".xz" else path.read_bytes()
    found, at = [], 0
    while at + 20 <= len(data):
        (us,) = struct.unpack_from(">Q", data, at)
        length = data[at + 9] + (12 + 13 * (data[at + 10] & 1) if data[at + 8] == V2 else 8)
        found.append((us * 1e-6, data[at + 8 : at + 8 + length]))
        at += 8 + length
    return found


def identity(frame: bytes) -> int:
    """The message id of a frame."""
    return int.from_bytes(frame[7:10], "little") if frame[0] == V2 else frame[5]


def overheard(path: Path, without: tuple[int, ...] = (), vehicle=None, until_s: float = float("inf")) -> tuple[list[dict], Link]:
    """(alerts, each with `at`: s after the first frame; the link). without: message ids that do not come; vehicle: known from a file."""
    now, alerts, wire = [0.0], [], Heard()
    link = Link(wire, lambda alert: alerts.append({**alert, "at": now[0]}), known=vehicle, talks=False, clock=lambda: now[0])
    heard = [(at, frame) for at, frame in frames(path) if identity(frame) not in without]
    first, due = heard[0][0], STEP_S
    for at, frame in heard:
        now[0] = at - first
        if now[0] > until_s:
            break
        wire.put(frame)
        if now[0] >= due:
            link.poll(0.0)
            due = now[0] + STEP_S
    link.poll(0.0)
    if now[0] <= until_s:
        link.leave()
    return alerts, link


def held(alerts: list[dict]) -> list[dict]:
    """The events that were reported and not withdrawn, as they were reported last."""
    last = {a["number"]: a for a in alerts if a["type"] == "event"}
    return [a["event"] for a in last.values() if a["state"] != "withdrawn"]
