"""How long lists of a store take: filters, orders and counts, on a store of fabricated flights of 200 aircraft.

python benchmarks/list_of_flights.py STORE [--flights 100000]

STORE: a file that is not there yet, or postgresql://... of an empty database. Prints ms of a page of 50 flights and of the count, the
shortest of three.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from rotorwatch.fleet import Entry, Store
from rotorwatch.fleet import store as kept

AIRCRAFT = 200
HEADLINES = {
    "healthy": "No rotor lost thrust after take-off. Nothing beyond 20 % was wrong from take-off on.",
    "fault": "Rotor 3 (front left) lost 36 % (31 to 42 %) of thrust at 47.55 s.",
    "ambiguous": "Rotor 3 (front left) or rotor 5 (front right) lost thrust at 47.55 s.",
    "inconclusive": "The flight was too short to assess.",
}
ASKED: dict[str, dict[str, Any]] = {
    "newest first": {},
    "gravest first": {"sort": "-verdict"},
    "largest loss first": {"sort": "-loss"},
    "longest first": {"sort": "-duration"},
    "by aircraft": {"sort": "aircraft"},
    "by aircraft, Z to A": {"sort": "-aircraft"},
    "by name": {"sort": "name"},
    "faults, largest loss first": {"verdict": "fault", "sort": "-loss"},
    "an aircraft, largest loss first": {"aircraft": "quad 7", "sort": "-loss"},
    "a month": {"since": "2022-01-01", "until": "2022-01-31"},
    "loss of 30 % or more": {"min_loss": 0.3},
    "three words": {"search": "rotor lost quad"},
    "all filters": {
        "search": "rotor", "verdict": "fault,ambiguous", "since": "2021-01-01", "until": "2024-01-31", "min_loss": 0.1,
        "min_duration": 60, "sort": "-loss",
    },
    "the last page": {"offset": -50},
}  # fmt: skip


def fill(store: Store, flights: int) -> None:
    """Put fabricated flights into an empty store, in one transaction."""
    rng = np.random.default_rng(0)
    verdicts = rng.choice(list(HEADLINES), flights, p=(0.7, 0.1, 0.1, 0.1))
    begun = rng.integers(0, 3_000_000, flights)
    durations, losses = rng.uniform(5.0, 2000.0, flights), rng.uniform(0.05, 0.6, flights)
    tables: dict[str, list[dict[str, Any]]] = {"flights": [], "diagnoses": [], "trims": []}
    for k, verdict in enumerate(verdicts.tolist()):
        events = [{"loss": [losses[k]], "onset_s": 47.55}] if verdict in ("fault", "ambiguous") else []
        entry = Entry(
            hash=rng.bytes(32).hex(), path=f"/srv/logs/2026/{k % AIRCRAFT}/{k:08d}.bin", name=f"{k:08d}.bin", size=10_000_000,
            identity=f"serial {k % AIRCRAFT}", utc=f"{(datetime(2020, 1, 1) + timedelta(minutes=int(begun[k]))).isoformat()}.000Z",
            duration_s=durations[k], airborne_s=durations[k], autopilot="ArduPilot", firmware="ArduCopter V4.5.7 (2a3dc4b7)",
            frame="ardupilot-quad-x", rotors=4, verdict=verdict, headline=HEADLINES[verdict], version="0.1.0",
            diagnosis={"events": events, "main_event": 0 if events else None},
        )  # fmt: skip
        whose = f"key {k % AIRCRAFT}" if k % 50 else None
        tables["flights"].append({"ordinal": k + 1, "aircraft": whose} | kept._row(entry))
        tables["diagnoses"].append({"hash": entry.hash, "diagnosis": "x" * 3000})
        tables["trims"].append({"hash": entry.hash, "trim": "{}"})
    with store._database.writing() as db:
        for k in range(AIRCRAFT):
            db.insert("aircraft", key=f"key {k}", name=f"quad {k}", ordinal=k + 1)
        for name, rows in tables.items():
            db.connection.execute(store._t.metadata.tables[name].insert(), rows)


def shortest_ms(work: Callable[[], Any]) -> float:
    """The shortest of three runs."""
    taken = []
    for _ in range(3):
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return 1e3 * min(taken)


def main() -> None:
    """Fill, ask, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store")
    parser.add_argument("--flights", type=int, default=100_000)
    given = parser.parse_args()
    with Store(given.store) as store:
        if not store.count():
            fill(store, given.flights)
        print(f"{store.count()} flights in {store.label}\n{'asked':34}{'page':>8}{'count':>8}{'found':>9}")
        for what, asked in ASKED.items():
            page = dict(asked)
            sort, offset = page.pop("sort", "-date"), page.pop("offset", 0) % store.count()
            listed = shortest_ms(lambda s=sort, o=offset, f=page: store.flights(s, 50, o, **f))
            counted = shortest_ms(lambda f=page: store.count(**f))
            print(f"{what:34}{listed:8.1f}{counted:8.1f}{store.count(**page):9d}")
        print(f"{'names of all aircraft':34}{shortest_ms(store.aircraft_names):8.1f}")


if __name__ == "__main__":
    main()
