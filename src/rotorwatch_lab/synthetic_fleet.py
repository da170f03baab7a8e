"""A simulated fleet with known truth: flights of many aircraft, some of whose rotors wear, are damaged or exchanged.

Every aircraft is one of a build, with rotors that differ by OWN_SD and repeat from flight to flight to FLIGHT_SD, as a new battery or a
remounted propeller causes. Every flight has its own wind, payload (a weight hung somewhere near the centre), heading and manoeuvre. An
aircraft's story (`STORIES`) is one of: nothing; wear that grows in proportion to hours in the air; damage from one flight on; wear, then an
exchange that is noted as a service; or another place for its battery, which is no rotor's fault.

The simulator flies each of them; the flight that its log would give is assessed as any log, and stored. The truth goes into a file beside
the store, which nothing but `score` reads.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.base import files
from rotorwatch.flight import Flight, Message
from rotorwatch.toolkit import Store, assess, flight_result

SECONDS = 45.0
BUILDS = (("quad-x", 0.6), ("hexa-x", 0.4))
OWN_SD, FLIGHT_SD = 0.02, 0.008  # of a rotor's thrust
STORIES = (("healthy", 0.4), ("wear", 0.25), ("damage", 0.15), ("exchange", 0.1), ("battery moved", 0.1))
WORN = (0.05, 0.15)  # loss at the end of a story
DAMAGE = (0.05, 0.30)
WIND = 6.0  # m/s at most
PAYLOAD = (0.05, 0.3)  # kg of 2
PLACE_SD = 0.01  # m, of payloads; arms are 0.3 m
BATTERY = 0.012  # m, that the whole mass is off by after the battery was moved
FIRST = datetime(2026, 1, 1, 8, tzinfo=timezone.utc)
STORE, TRUTH = "fleet.db", "truth.json"
BATCH = 40


@dataclass(frozen=True)
class Story:
    """The truth of an aircraft: rotor 0-based or -1, start: first flight with it, end: loss of the rotor at the last flight, exchange:
    first flight after the service, or -1."""

    name: str
    frame: str
    kind: str
    rotor: int
    start: int
    size: float
    exchange: int

    def loss(self, flight: int, flights: int) -> float:
        """Loss of `rotor` at a flight by its story, without its manufacturing scatter."""
        if self.kind == "damage":
            return self.size if flight >= self.start else 0.0
        end = self.exchange if self.exchange >= 0 else flights
        if self.kind not in ("wear", "exchange") or not self.start <= flight < end:
            return 0.0
        return self.size * (flight - self.start + 1) / (end - self.start)


def stories(aircraft: int, flights: int, seed: int) -> list[Story]:
    """The story of each aircraft of a fleet: the kinds in their shares, all else drawn."""
    rng = np.random.default_rng([seed, 1])
    kinds = [k for k, share in STORIES for _ in range(round(share * aircraft))]
    kinds = (kinds + ["healthy"] * aircraft)[:aircraft]
    rng.shuffle(kinds)
    out = []
    for number, kind in enumerate(kinds):
        frame = str(rng.choice([b for b, _ in BUILDS], p=[p for _, p in BUILDS]))
        rotor = int(rng.integers(4 if frame.startswith("quad") else 6))
        start, size, exchange = 0, 0.0, -1
        if kind == "wear":
            start, size = int(rng.integers(0, max(1, flights // 2))), rng.uniform(*WORN)
        elif kind == "damage":
            start, size = int(rng.integers(flights // 5, max(flights // 5 + 1, 4 * flights // 5))), rng.uniform(*DAMAGE)
        elif kind == "exchange":
            exchange = int(rng.integers(flights // 2, max(flights // 2 + 1, 4 * flights // 5)))
            size = rng.uniform(*WORN)
        elif kind == "battery moved":
            start = int(rng.integers(flights // 4, max(flights // 4 + 1, 3 * flights // 4)))
        out.append(Story(f"A{number + 1:03d}", frame, kind, rotor if size else -1, start, float(size), exchange))
    return out


def fly(story: Story, number: int, flights: int, seed: int) -> Iterator[Flight]:
    """The flights of aircraft `number`, as their logs would be read."""
    from rotorwatch_lab.simulation import logbook, loop, scenario
    from rotorwatch_lab.simulation.multirotor import MULTIROTOR
    from rotorwatch_lab.simulation.prepare import plan

    rng = np.random.default_rng([seed, 2, number])
    n = 4 if story.frame.startswith("quad") else 6
    own = OWN_SD * rng.standard_normal(n)
    renewed = OWN_SD * rng.standard_normal(n)
    moved = BATTERY * np.array([np.cos(angle := rng.uniform(0, 2 * np.pi)), np.sin(angle)])
    for begin in range(0, flights, BATCH):
        scenarios, plans = [], []
        for k in range(begin, min(begin + BATCH, flights)):
            asked = scenario.from_table(_scenario(story, k, rng, moved))
            factor = 1.0 + own + FLIGHT_SD * rng.standard_normal(n)
            if story.exchange >= 0 and k >= story.exchange:
                factor[story.rotor] += renewed[story.rotor] - own[story.rotor]
            if story.rotor >= 0:
                factor[story.rotor] *= 1.0 - story.loss(k, flights)
            numbers = plan(asked)
            scenarios.append(asked)
            plans.append(numbers._replace(faults=_weak(numbers.faults, 1.0 - factor)))
        first = scenarios[0]
        records = loop.fly_each(MULTIROTOR, plans, first.duration_s, first.rate_hz, first.record_hz, logbook.needed)
        for k, (asked, numbers, record) in enumerate(zip(scenarios, plans, records), begin):
            yield _named(logbook.flight(asked, numbers, record), number, k, seed)


def _weak(none: Any, loss: np.ndarray) -> Any:
    """The simulator's faults with the loss of every rotor in one row, negative for a rotor with more thrust than usual."""
    rows, amount, onset = np.zeros_like(none.rotor), np.zeros_like(none.loss), np.array(none.onset)
    rows[0], amount[0], onset[0] = loss, 1.0, 0.0
    return none._replace(rotor=rows, loss=amount, onset=onset)


def _scenario(story: Story, k: int, rng: np.random.Generator, moved: np.ndarray) -> dict:
    x, y = PLACE_SD * rng.standard_normal(2)
    payload = float(rng.uniform(*PAYLOAD))
    if story.kind == "battery moved" and k >= story.start:  # as a payload that shifts the whole mass so far
        x, y = np.array([x, y]) + moved * 2.0 / payload
    return {
        "name": f"{story.name} flight {k + 1}",
        "duration_s": SECONDS,
        "seed": int(rng.integers(2**31 - 1)),
        "airframe": {"frame": story.frame, "payload_kg": payload, "payload_at_m": [float(x), float(y), 0.05]},
        "trajectory": {"kind": str(rng.choice(["hover", "hover", "square"])), "yaw_deg": float(rng.uniform(-180, 180))},
        "wind": {"speed_m_s": float(rng.uniform(0, WIND)), "from_deg": float(rng.uniform(-180, 180))},
    }  # fmt: skip


def _named(flight: Flight, number: int, k: int, seed: int) -> Flight:
    """The flight with an autopilot's log entries on itself: its serial number, the time, its count of boots."""
    mark = hashlib.sha256(f"{seed} {number}".encode()).hexdigest()[:24].upper()
    serial = Message(0.0, "text", f"SIMBOARD {mark[:8]} {mark[8:16]} {mark[16:]}")
    when = FIRST + timedelta(days=k, minutes=7 * number)
    return replace(
        flight,
        messages=(serial, *flight.messages),
        parameters={**flight.parameters, "STAT_BOOTCNT": float(k + 1)},
        facts={**flight.facts, "utc_start": _utc(when)},
    )


def _utc(when: datetime) -> str:
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def fly_fleet(
    folder: str | Path, aircraft: int, flights: int, seed: int = 0, url: str = "", logs: bool = False, progress: Callable | None = None
) -> tuple[Path, int]:
    """Fly a fleet into a store (url, or FOLDER/fleet.db) and write FOLDER/truth.json; existing flights are not flown again. logs: write
    every flight as FOLDER/NAME.bin besides. Returns the truth's path and the number of flights added."""
    folder = files.folder(folder, "--out")
    tales = stories(aircraft, flights, seed)
    added = 0
    with Store(url or folder / STORE) as store:
        for number, story in enumerate(tales):
            key = _key(store, story)
            known = {f["path"] for f in store.flights(aircraft=key, limit=None)} if key else set()
            paths = [f"simulated/{seed}/{story.name}/{k + 1:04d}" for k in range(flights)]
            if not all(path in known for path in paths):
                for k, flight in enumerate(fly(story, number, flights, seed)):
                    if logs:
                        _write(flight, folder / f"{story.name}-{k + 1:04d}.bin")
                    if paths[k] not in known:
                        one = flight_result.of_flight(flight, hashlib.sha256(paths[k].encode()).hexdigest(), paths[k], 0)
                        added += store.add(replace(one, called=story.name))
                    if progress:
                        progress((number + (k + 1) / flights) / aircraft, "flying")
            key = _key(store, story)
            if story.exchange >= 0 and key and not store.services(key):
                store.service(key, story.rotor + 1, "new propeller", _utc(FIRST + timedelta(days=story.exchange - 0.5)))
        assess.refresh(store, progress)
    reported = [vars(t) | {"loss": t.loss(flights - 1, flights)} for t in tales]
    truth = {"seed": seed, "flights": flights, "aircraft": reported}
    with files.replacing(folder / TRUTH) as hidden:
        hidden.write_text(json.dumps(truth, indent=1) + "\n")
    return folder / TRUTH, added


def _key(store: Store, story: Story) -> str:
    return next((a["key"] for a in store.aircraft() if a["name"] == story.name), "")


def _write(flight: Flight, path: Path) -> None:
    from rotorwatch_lab.simulation.write_dataflash import write_dataflash

    write_dataflash(flight, path)
