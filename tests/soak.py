"""Eight vehicles on one link for hours of their time, with all that links and clocks do: assessed to the end, every flight in the store.

    python -m tests.soak --minutes 60

Each vehicle flies simulated flights, one after the other, and between two of them it reboots, or its clock is set ahead or back. Meanwhile
frames are lost, repeated, reordered and damaged, vehicles fall silent, and stamps are wild. Everything follows from the seed. It is the
served page that watches, with its store; only the clock of arrival is not the computer's, so that an hour takes minutes.
"""

from __future__ import annotations

import argparse
import gc
import struct
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tests.link_faults import Wire, base
from tests.mavlink_vehicle import Autopilot, mavlink

from rotorwatch.live.framing import seeds, sums
from rotorwatch.live.link import Link
from rotorwatch.serve import live
from rotorwatch.serve.flights import Flights

STEP_S = 0.1  # between two polls, of the vehicles' time
REST_S = 4.0  # on the ground, or off, between two flights
STAMPS = {30: (0, 4), 27: (0, 8), 36: (0, 4), 32: (0, 4), 83: (0, 4)}  # message -> place and size of its stamp
IN_MS = {30, 32, 83}


@dataclass
class Count:
    """What was sent and what came of it. memory: resident MB, once a minute of vehicle time."""

    flights: int = 0
    frames: int = 0
    stored: int = 0
    reboots: int = 0
    jumps: int = 0
    memory: list[float] = field(default_factory=list)
    trouble: list[str] = field(default_factory=list)
    seconds: float = 0.0


def stamped(frame: bytes, change) -> bytes:
    """A frame of MAVLink 2 whose stamp [us] is another one; as it is where it has none."""
    identity = int.from_bytes(frame[7:10], "little")
    place = STAMPS.get(identity)
    if place is None:
        return frame
    offset, size = place
    body = frame[10:-2].ljust(offset + size, b"\0")
    kind, unit = "<I" if size == 4 else "<Q", 1e3 if identity in IN_MS else 1.0
    old = struct.unpack_from(kind, body, offset)[0] * unit
    new = int(change(old) / unit) % 2 ** (8 * size)
    body = body[:offset] + struct.pack(kind, new) + body[offset + size :]
    head = frame[:1] + bytes((len(body),)) + frame[2:10]
    return head + body + sums(head + body, seeds()[identity])


class Vehicle:
    """One that flies again and again. flights: that it has ended."""

    def __init__(self, system: int, rng: np.random.Generator, flight_s: float, end: float):
        self._rng, self._flight_s, self._which, self._end = rng, flight_s, system % 4, end
        _, self.parameters, self.kind = base(self._which)
        self._pack = Autopilot(self.parameters, system=system)
        self._left: list[tuple[float, bytes]] = []
        self._shift = 0.0  # of its clock, us
        self.flights = self.frames = 0
        self._silent = -np.inf
        self._due, self._number, self._system = 0.0, int(rng.integers(256)), system

    def greeting(self) -> list[bytes]:
        beat = self._pack.packed(mavlink.MAVLink_heartbeat_message(self.kind, 3, 0x80, 0, 4, 3))
        return [beat, *(self._pack.packed(self._pack._value(k)) for k in range(len(self.parameters)))]

    def _begin(self, now: float) -> None:
        """The next flight: after a reboot, or with a clock that was set, ahead or back."""
        frames, _, _ = base(self._which)
        start = frames[0][0]
        self._left = [(now + at - start, frame) for at, frame in frames if at - start < self._flight_s][::-1]
        # A clock that starts again or is set: an hour on, ten minutes back, or (most often) the same as after the last boot.
        self._shift = float(self._rng.choice([0.0, 0.0, 3600e6, 600e6]))
        self.flights += 1

    def sends(self, now: float) -> list[bytes]:
        """What comes of it until `now` s."""
        if not self._left:
            if now < self._due or now + self._flight_s > self._end:
                return []
            self._begin(now)
        rng, out = self._rng, []
        if rng.random() < 0.002:
            self._silent = now + float(rng.uniform(0.5, 6.0))
        while self._left and self._left[-1][0] <= now:
            frame = self._own(self._left.pop()[1])
            self.frames += 1
            if now < self._silent or rng.random() < 0.02:
                continue
            if rng.random() < 0.004:  # one wild stamp
                wild = float(rng.uniform(0.0, 2.0**63))
                frame = stamped(frame, lambda old, wild=wild: wild)
            out += [frame] * (2 if rng.random() < 0.02 else 1)
            if rng.random() < 0.005:
                damaged = bytearray(frame)
                damaged[int(rng.integers(len(damaged)))] ^= 1 << int(rng.integers(8))
                out.append(bytes(damaged))
        if len(out) > 1 and rng.random() < 0.1:
            k = int(rng.integers(1, len(out)))
            out[k - 1], out[k] = out[k], out[k - 1]
        if not self._left:
            self._due = now + REST_S
        return out

    def _own(self, frame: bytes) -> bytes:
        """A frame with its own id, running number and clock."""
        self._number = (self._number + 1) % 256
        identity = int.from_bytes(frame[7:10], "little")
        head = frame[:4] + bytes((self._number, self._system)) + frame[6:10]
        frame = head + frame[10:-2]
        frame += sums(frame, seeds()[identity])
        return stamped(frame, lambda old: old + self._shift) if self._shift else frame


def resident_mb() -> float:
    """Memory of this process, where the system tells."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20
    except OSError:
        return 0.0


def soak(minutes: float, folder: Path, count: int = 8, seed: int = 0, flight_s: float = 40.0, tell=lambda text: None):
    """What came of so many minutes of vehicle time."""
    found, began = Count(), time.monotonic()
    flights, kept = Flights(str(folder / "fleet.db")), []
    keeper = flights.store_writer(kept.append, found.trouble.append)
    feed, now, wire = live.Feed(keeper.keep), [0.0], Wire()
    link = Link(wire, feed.notify, talks=False, record=folder, clock=lambda: now[0])
    source = live.Guarded(wire.name, link, feed)
    feed._sources.append(source)
    vehicles = [Vehicle(k + 1, np.random.default_rng((seed, k)), flight_s - k, 60.0 * minutes) for k in range(count)]
    for vehicle in vehicles:
        wire.queue += [("a", data) for data in vehicle.greeting()]
    source.poll(0.0)
    minute = 0.0
    while now[0] < 60.0 * minutes:
        now[0] += STEP_S
        for vehicle in vehicles:
            wire.queue += [("a", data) for data in vehicle.sends(now[0])]
        if not source.poll(0.0):
            found.trouble.append(f"the link ended at {now[0]:.0f} s: {source.trouble}")
            break
        if round(now[0] / STEP_S) % 5 == 0:
            feed.background.run("the picture", feed._show)
        if now[0] >= minute:
            minute += 60.0
            gc.collect()
            found.memory.append(resident_mb())
            tell(f"{now[0] / 60:.0f} min, {found.memory[-1]:.0f} MB, {sum(v.flights for v in vehicles)} flights")
    source.leave()
    keeper.stop()
    found.frames = sum(v.frames for v in vehicles)
    found.flights = sum(v.flights for v in vehicles)
    found.stored = flights.rows(1)["total"]
    flights.close()
    health = [watched.health for watched in link.vehicles]
    found.reboots, found.jumps = sum(h.reboots for h in health), sum(h.jumps for h in health)
    found.trouble += [f"{w.name}: {w.trouble}" for w in link.vehicles if w.trouble]
    found.trouble += [*feed.background.failed.values(), *filter(None, (source.trouble, link.trouble))]
    found.trouble += [line["text"] for line in feed._messages if line["type"] == "error"]
    found.seconds = time.monotonic() - began
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = soak(asked.minutes, Path(folder), seed=asked.seed, tell=lambda text: print(text, flush=True))
    print(
        f"{found.frames} frames, {found.reboots} reboots, {found.jumps} clocks set; {found.flights} flights, {found.stored} in the store; "
        f"{found.seconds:.0f} s"
    )
    print("\n".join(sorted(set(found.trouble))) or "nothing ended, nothing failed")
    return bool(found.trouble) or found.stored < found.flights


if __name__ == "__main__":
    sys.exit(main())
