"""Random faults of links over simulated flights, healthy and faulty: nothing crashes, no alarm is false, no rotor is the wrong one.

    python -m tests.link_faults --flights 1000 --seed 0 --jobs 2
    python -m tests.link_faults --datagrams 100000

Every flight follows from (seed, number) alone. This is no command of rotorwatch: it needs the vehicle that speaks MAVLink, which only tests
have, and a user's link is what it is.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context

import numpy as np
from tests.mavlink_vehicle import Autopilot, mavlink, messages

from rotorwatch.live.endpoint import Endpoint
from rotorwatch.live.link import Link
from rotorwatch.live.session import building
from rotorwatch_lab.simulation import scenario, simulate

STEP_S = 0.04
SECONDS, ONSET_S = 45.0, 22.0
KINDS = {"quad-x": 2, "hexa-x": 13, "octa-x": 14}
ALARMS = ("loss_of_effectiveness", "output_override")
# frame, trajectory, wind m/s, (rotor, loss) or None
FLIGHTS = (
    ("quad-x", "hover", 0.0, None),
    ("quad-x", "square", 3.0, None),
    ("hexa-x", "square", 2.0, None),
    ("octa-x", "hover", 4.0, None),
    ("quad-x", "hover", 1.0, (2, 0.25)),
    ("quad-x", "square", 2.0, (4, 0.15)),
    ("hexa-x", "square", 1.0, (3, 0.35)),
    ("hexa-x", "hover", 3.0, (6, 0.2)),
)


@dataclass(frozen=True)
class Faults:
    """What one link does. Shares are of frames; cuts: (start, length) s in which nothing comes; holds: the same, but all of it comes
    after. second: another vehicle with the same id, "elsewhere" (of another address) or "here"; None: without."""

    lost: float = 0.0
    twice: float = 0.0
    moved: float = 0.0
    cut_short: float = 0.0
    wrong: float = 0.0
    garbage: float = 0.0
    cuts: tuple[tuple[float, float], ...] = ()
    holds: tuple[tuple[float, float], ...] = ()
    second: str | None = None


def drawn(rng) -> Faults:
    """A link with random faults; each kind is absent from half of them."""

    def some(most):
        return float(rng.uniform(0.0, most)) if rng.random() < 0.5 else 0.0

    def spells(most, longest):
        count = int(rng.integers(0, most + 1)) if rng.random() < 0.5 else 0
        return tuple((float(rng.uniform(5.0, SECONDS)), float(rng.uniform(0.1, longest))) for _ in range(count))

    second = rng.choice(["elsewhere", "here", ""], p=[0.08, 0.07, 0.85])
    return Faults(
        some(0.3), some(0.1), some(0.2), some(0.05), some(0.03), some(0.05), spells(6, 3.0), spells(6, 1.0), str(second) or None,
    )  # fmt: skip


@cache
def base(number: int, second: bool = False) -> tuple[tuple[tuple[float, bytes], ...], dict[str, float], int]:
    """((time s, frame), ...) of a flight with its parameters and kind of vehicle. second: it was switched on at another time, and its
    running numbers are others."""
    frame, trajectory, wind, fault = FLIGHTS[number]
    faults = [] if fault is None else [{"kind": "loss", "rotor": fault[0], "onset_s": ONSET_S, "strength": fault[1]}]
    table = {
        "duration_s": SECONDS, "seed": 11 + number, "airframe": {"frame": frame}, "trajectory": {"kind": trajectory},
        "wind": {"speed_m_s": wind}, "logging": {"profile": "fast"}, "faults": faults,
    }  # fmt: skip
    flight = simulate(scenario.from_table(table)).flight
    autopilot, boot_s = Autopilot({}), 30.0
    if second:
        autopilot._pack.seq, boot_s = 90 + 11 * number, 30.0 + (-5.0, -0.7, 0.2, 0.8, 4.0, 60.0)[number % 6]
    said = messages(flight, kind=KINDS[frame], boot_s=boot_s)
    parameters = {n: v for n, v in flight.parameters.items() if n.startswith(("FRAME", "MOT_", "SERVO")) and len(n) <= 16}
    return tuple((at, bytes(autopilot.packed(m))) for at, m in said), parameters, KINDS[frame]


def arriving(frames, faults: Faults, rng) -> list[tuple[float, str, bytes]]:
    """(time of arrival s, peer, datagram) of what a link makes of frames, in order of arrival."""
    out = []
    for at, frame in frames:
        if rng.random() < faults.lost or any(start <= at < start + length for start, length in faults.cuts):
            continue
        for start, length in faults.holds:
            if start <= at < start + length:
                at = start + length
        if rng.random() < faults.moved:
            at += float(rng.uniform(0.0, 0.06))
        sent = [frame] * (2 if rng.random() < faults.twice else 1)
        if rng.random() < faults.cut_short:
            end = int(rng.integers(1, len(frame)))
            sent[-1] = frame[:end] if rng.random() < 0.5 else frame + bytes(rng.bytes(end))
        if rng.random() < faults.wrong:
            mutated = bytearray(sent[-1])
            mutated[int(rng.integers(len(mutated)))] ^= 1 << int(rng.integers(8))
            sent[-1] = bytes(mutated)
        if rng.random() < faults.garbage:
            sent.append(bytes(rng.bytes(int(rng.integers(1, 300)))))
        out += [(at, "a", one) for one in sent]
    return sorted(out, key=lambda one: one[0])


class Wire(Endpoint):
    """An endpoint in memory."""

    def __init__(self):
        super().__init__("udp:14550")
        self.open, self.queue = True, []

    def receive(self, wait_s=0.0):
        queue, self.queue = self.queue, []
        return queue

    def send(self, data, peer=None):
        pass


def watched(datagrams, parameters, kind, record=None, first="a"):
    """(alerts, link) of a link over which these datagrams come; record: folder to record in; first: the
    address that is heard first; where that is not the vehicle's, no parameters come."""
    now, alerts, wire = [0.0], [], Wire()

    def tell(alert):
        alerts.append({**alert, "at": now[0] - 1.0})

    link = Link(wire, tell, talks=False, record=record, patience_s=math.inf, clock=lambda: now[0])
    building().done(wait=True)  # native code that is built for the first time
    greeting = Autopilot(parameters)
    wire.queue.append((first, greeting.packed(mavlink.MAVLink_heartbeat_message(kind, 3, 0x80, 0, 4, 3))))
    link.poll(0.0)
    if first == "a":
        wire.queue += [("a", greeting.packed(greeting._value(k))) for k in range(len(parameters))]
    link.poll(0.0)
    due = -np.inf
    for at, peer, data in datagrams:
        wire.queue.append((peer, data))
        if at >= due:
            now[0], due = 1.0 + at, at + STEP_S
            link.poll(0.0)
    now[0] += STEP_S
    link.poll(0.0)
    link.leave()
    return alerts, link


def flown(seed: int, number: int, faults: Faults | None = None) -> dict:
    """What came of one flight: outcome and what there is to say of it."""
    rng = np.random.default_rng((seed, number))
    which = number % len(FLIGHTS)
    faults = drawn(rng) if faults is None else faults
    frames, parameters, kind = base(which)
    datagrams = arriving(frames, faults, rng)
    if faults.second:
        other = base(int((which + 1 + rng.integers(len(FLIGHTS) - 1)) % len(FLIGHTS)), True)[0]
        peer = "a" if faults.second == "here" else "b"
        late = float(rng.uniform(8.0, 30.0))
        more = [(at, peer, data) for at, _, data in arriving(other, faults, rng) if at > late]
        datagrams = sorted([*datagrams, *more], key=lambda one: one[0])
    about = {"number": number, "flight": FLIGHTS[which], "faults": faults}
    try:
        alerts, link = watched(datagrams, parameters, kind)
    except Exception:
        return {**about, "outcome": "CRASH", "what": traceback.format_exc()}
    about["loss"] = max((v.health.loss for v in link.vehicles), default=0.0)
    return {**about, **assessed(alerts, link, FLIGHTS[which][3])}


def assessed(alerts: list[dict], link: Link, fault) -> dict:
    """The outcome: right, found late or not at all, not assessed, or one that must not be."""
    trouble = [v.trouble for v in link.vehicles if v.trouble]
    if trouble:
        return {"outcome": "CRASH", "what": trouble[0]}
    reported = [a for a in alerts if a["type"] == "event" and a["event"]["kind"] in ALARMS]
    if fault is None:
        if reported:
            return {"outcome": "FALSE ALARM", "what": [(a["state"], a["event"]) for a in reported]}
        return {"outcome": "quiet" if all(v.session is not None and v.session.assessed for v in link.vehicles) else "not assessed"}
    last = {a["number"]: a for a in reported}
    holds = [a["event"] for a in last.values() if a["state"] != "withdrawn"]
    early = [e for e in holds if e["detected_s"] < 20.0]  # the flight's second 22 is after that on the vehicle's clock, too
    wrong = [e for e in holds if [fault[0]] not in (e["rotors"], *e["alternatives"])]
    if early or wrong:
        return {"outcome": "WRONG ROTOR", "what": early + wrong}
    return {"outcome": "found" if holds else "not found"}


BAD = ("CRASH", "FALSE ALARM", "WRONG ROTOR")


def datagrams(count: int, seed: int = 0) -> Link:
    """A link on which a vehicle flies among so many datagrams that are random, or mutations of its own."""
    rng = np.random.default_rng(seed)
    frames, parameters, kind = base(0)
    frames = frames[: 50 * 150]
    share = count / len(frames)
    out: list[tuple[float, str, bytes]] = []
    for at, frame in frames:
        out.append((at, "a", frame))
        for _ in range(int(rng.poisson(share))):
            if rng.random() < 0.5:
                data = bytearray(rng.bytes(int(rng.integers(1, 300))))
                data[0] = (0xFD, 0xFE, data[0])[int(rng.integers(3))]
            else:
                data = bytearray(frame)
                for _ in range(int(rng.integers(1, 5))):
                    data[int(rng.integers(len(data)))] = int(rng.integers(256))
            out.append((at, str(rng.choice(["a", "b", "c"])), bytes(data)))
    return watched(out, parameters, kind)[1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--datagrams", type=int, default=0)
    given = parser.parse_args()
    began, counts = time.monotonic(), Counter()
    if given.datagrams:
        link = datagrams(given.datagrams, given.seed)
        print(f"{link.damaged} damaged, {link.frames} sound; vehicles {[v.name for v in link.vehicles]}")
    for k in range(len(FLIGHTS) if given.flights else 0):
        base(k), base(k, True)  # before the processes are forked
    numbers = range(given.first, given.first + given.flights)
    with ProcessPoolExecutor(given.jobs, get_context("fork")) as pool:
        for done, result in enumerate(pool.map(partial(flown, given.seed), numbers, chunksize=4), 1):
            counts[result["outcome"]] += 1
            if result["outcome"] in BAD:
                print(result, flush=True)
            if done % 50 == 0:
                print(f"{done}: {dict(counts)}, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    print(dict(counts))
    return int(any(counts[bad] for bad in BAD))


if __name__ == "__main__":
    sys.exit(main())
