"""Vehicles watched by `serve`'s feed for an hour of their time, with all that links and clocks do: `python -m tests.soak [--minutes 60]`.

Each vehicle flies one flight after the other. Between flights and in them it reboots, its clock is set, it falls silent, its messages come
twice or in another order, with stamps that cannot be, or cannot be judged at all. Nothing may end the watching, each flight has to be in
the store, and memory may not grow.
"""

from __future__ import annotations

import argparse
import gc
import heapq
import json
import logging
import math
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tests.mavlink_vehicle import Autopilot, messages

from rotorwatch import logs
from rotorwatch.cli import SAMPLES
from rotorwatch.fleet.store import Entry
from rotorwatch.live import endpoint
from rotorwatch.live.link import Link
from rotorwatch.serve.flights import Flights
from rotorwatch.serve.live import Feed, Guarded

SAMPLE = SAMPLES / "quadx_healthy_hover.bin.xz"
TROUBLES = ("none", "reboot", "reboot in the air", "clock set", "silence", "twice", "wild stamps", "short stamps first")
PAUSE_S, STEP_S, SHOWN_S = 8.0, 0.05, 0.25
PARTS = ("FRAME", "MOT_", "SERVO")


class Wire(endpoint.Endpoint):
    """An endpoint in memory. autopilots: answer what is sent."""

    def __init__(self, autopilots: list[Autopilot]):
        super().__init__("udp:14550")
        self.open, self._queue, self._autopilots = True, [], autopilots

    def put(self, data: bytes) -> None:
        self._queue.append(("a", data))

    def receive(self, wait_s: float = 0.0) -> list[tuple[Any, bytes]]:
        queue, self._queue = self._queue, []
        return queue

    def send(self, data: bytes, peer: Any = None) -> None:
        for autopilot in self._autopilots:
            if answer := autopilot.answer(data):
                self.put(answer)


@dataclass
class Told:
    """flights: that were flown to their end or broken off in the air; troubles: how often each was met; entries: of the store's list; said:
    what was an error; memory: MB at each flight of the first vehicle."""

    flights: int = 0
    parts: int = 0
    troubles: dict[str, int] = field(default_factory=dict)
    entries: int = 0
    said: list[str] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)
    alive: bool = False


def vehicle(
    flight: Any, autopilot: Autopilot, rng: np.random.Generator, until_s: float, told: Told
) -> Iterator[tuple[float, bytes]]:
    """(time of arrival s, frame) of one vehicle's flights."""
    at, boot_s, first = float(rng.uniform(0.0, PAUSE_S)), 30.0, True
    while at < until_s:
        trouble = "none" if first else str(rng.choice(TROUBLES))
        first = False
        told.troubles[trouble] = told.troubles.get(trouble, 0) + 1
        if trouble in ("reboot", "short stamps first"):
            boot_s = 1.0
        end = flight.duration * (0.6 if trouble == "reboot in the air" else 1.0)
        middle, shift = 0.5 * flight.duration, 0.0
        said = messages(flight, seconds=end, boot_s=boot_s)
        if trouble == "clock set":
            shift = 5000.0
            said = [m for m in said if m[0] < middle] + messages_from(flight, middle, boot_s + shift)
        if trouble == "short stamps first":
            short = [m for m in said if m[1].get_type() == "SERVO_OUTPUT_RAW"][:30]
            said = [*((0.0, m) for _, m in short), *said]
        told.flights += 1
        told.parts += 1 + (trouble == "clock set")
        for k, (time, message) in enumerate(said):
            if trouble == "silence" and middle < time < middle + 8.0:
                continue
            if trouble == "wild stamps" and k % 97 == 0 and hasattr(message, "time_usec"):
                most = 2**32 if message.get_type() == "SERVO_OUTPUT_RAW" else 2**64
                message.time_usec = int(rng.choice([0, 1, 2**31, 2**40])) * int(rng.integers(1, 2**20)) % most
            frame = autopilot.packed(message)
            yield at + time, frame
            if trouble == "twice" and k % 3 == 0:
                yield at + time, frame
        at += end + PAUSE_S
        boot_s = 1.0 if trouble == "reboot in the air" else boot_s + shift + end + PAUSE_S


def messages_from(flight: Any, start_s: float, boot_s: float) -> list:
    """Of the rest of a flight."""
    return [m for m in messages(flight, boot_s=boot_s) if m[0] >= start_s]


def soak(vehicles: int = 8, minutes: float = 60.0, seed: int = 0, progress: bool = False) -> Told:
    """What became of it."""
    flight, told, now = logs.read(SAMPLE), Told(), 0.0
    parameters = {k: v for k, v in flight.parameters.items() if k.startswith(PARTS) and len(k) <= 16}
    autopilots = [Autopilot(parameters, system=k + 1) for k in range(vehicles)]
    wire, rng = Wire(autopilots), np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        flights = Flights(str(Path(folder) / "fleet.db"))

        def keep(entry: Entry) -> None:
            flights.keep(entry)

        feed = Feed(keep)
        link = Link(wire, feed.tell, None, None, True, math.inf, clock=lambda: now)
        guarded = Guarded("udp:14550", lambda: link, feed)
        feed._sources.append(guarded)
        until_s = 60.0 * minutes
        streams = [vehicle(flight, a, np.random.default_rng(rng.integers(2**32)), until_s, told) for a in autopilots]
        due = shown = measured = 0.0
        for at, frame in heapq.merge(*streams, key=lambda pair: pair[0]):
            wire.put(frame)
            if at < due:
                continue
            now, due = at, at + STEP_S
            if not guarded.poll(0.0):
                break
            if at >= shown:
                shown = at + SHOWN_S
                feed._show([])
            if at >= measured:
                measured = at + 300.0
                gc.collect()
                told.memory.append(resident_mb())
                if progress:
                    print(
                        f"{at / 60.0:.0f} min, {told.flights} flights, {told.memory[-1]:.0f} MB",
                        file=sys.stderr,
                        flush=True,
                    )
        told.alive = not guarded.ended and not guarded.trouble
        json.dumps(feed.state(), allow_nan=False)
        guarded.leave()
        told.entries = flights.rows("", 1, 0)["total"]
        told.said = sorted({str(line["text"]) for line in feed._said if line["type"] == "error"})
        flights.close()
    return told


def resident_mb() -> float:
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20


def main() -> int:
    """Fly, watch, print; the exit code is 1 when anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=8)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    logging.basicConfig()
    told = soak(given.vehicles, given.minutes, given.seed, progress=True)
    print(told)
    fine = told.alive and not told.said and told.entries >= told.flights
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
