"""How soon a rotor whose speed leaves its command is known: simulated flights with rotor speeds, diagnosed like any log.

    python benchmarks/speeds.py [--count 60] [--jobs 1] [--real FOLDER]

Quadrotors and hexarotors of both autopilots, wind, ways, and speeds at 50, 100 or 500 Hz are drawn. A motor stops, a propeller leaves its
motor, or nothing happens; columns: with speeds, and the same flight without them. Real: in each flight of a folder a rotor's logged speed
is changed: it runs down, or it rises by a drawn share; everything else stays as it was, so only the delay of the speeds themselves shows.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

import rotorwatch as rw
from rotorwatch.airframes import identify
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.flight import Flight
from rotorwatch.witnesses.esc import following, telemetry
from rotorwatch_lab.simulation import scenario, simulate

KINDS = {"motor stops": "float", "propeller leaves": "complete loss", "healthy": None}
LATE_S = 2.0


def drawn(seed: int, kind: str | None) -> tuple[Flight, int, float]:
    """(flight, rotor, onset s)."""
    rng = np.random.default_rng(seed)
    frame, rotors = (("quad-x", 4), ("hexa-x", 6))[rng.integers(2)]
    rotor, onset = int(rng.integers(rotors)) + 1, float(rng.uniform(15.0, 25.0))
    table = {
        "duration_s": 45.0, "seed": seed, "autopilot": ("ardupilot", "px4")[rng.integers(2)], "airframe": {"frame": frame},
        "wind": {"speed_m_s": float(rng.choice([0.0, 3.0, 6.0])), "from_deg": float(rng.uniform(0.0, 360.0))},
        "trajectory": {"kind": str(rng.choice(["hover", "square", "figure-eight"])), "altitude_m": 8.0},
        "logging": {"esc": True, "profile": str(rng.choice(["fast", "full"])), "raw_hz": float(rng.choice([50.0, 100.0, 500.0]))},
        "faults": [{"rotor": rotor, "onset_s": onset, "kind": kind}] if kind else [],
    }  # fmt: skip
    return simulate(scenario.from_table(table)).flight, rotor, onset


def reported(flight: Flight, rotor: int, onset: float) -> tuple[float, bool]:
    """(s until a loss of the rotor is announced, infinite where it is not; whether another rotor is accused)."""
    losses = [e for e in rw.diagnose(flight).events if e.means.weakens]
    mine = [e.detected_s - onset for e in losses if e.rotors == (rotor,)]
    return min(mine, default=np.inf), any(rotor not in e.suspects for e in losses)


def one(task: tuple[int, str]) -> tuple[float, float, bool]:
    seed, kind = task
    flight, rotor, onset = drawn(seed, KINDS[kind])
    if not KINDS[kind]:
        return np.inf, np.inf, any(e.means.wrong for e in rw.diagnose(flight).events)
    bare = replace(flight, signals={name: s for name, s in flight.signals.items() if name != "esc"})
    with_, wrong = reported(flight, rotor, onset)
    return with_, reported(bare, rotor, onset)[0], wrong


def left(flight: Flight) -> list[following.Departure]:
    """The rotors of a log whose speed leaves its command."""
    vehicle, air = identify(flight), airborne(flight)
    thrust = allocation.rotor_thrusts(flight, vehicle)
    bins, _ = telemetry.read(flight, thrust, air)
    return [] if bins is None else following.departures(bins, thrust.time, air)


def changed(path: str) -> list[tuple[float, int]]:
    """[(s until the right rotor is known, number of others named before)] of changes of a real log; the first: of the log as it is."""
    flight = rw.read(path)
    air, esc, rng = airborne(flight)[-1], flight["esc"], np.random.default_rng(1)
    results = [(np.inf, len(left(flight)))]
    for _ in range(8):
        rotor, onset = int(rng.integers(flight.rotor_count)), float(rng.uniform(air[0] + 4.0, air[1] - 1.2))
        later, column = esc.time >= onset, esc.columns.index(f"speed{rotor + 1}")
        since, values = esc.time[later] - onset, esc.values.copy()
        down, up = rng.uniform(0.03, 0.2), rng.uniform(0.1, 0.35)
        values[later, column] *= 1.0 / (1.0 + since / down) if rng.random() < 0.5 else 1.0 + up * (1.0 - np.exp(-since / 0.02))
        new = replace(flight, signals={**flight.signals, "esc": replace(esc, values=values)})
        found = left(new)
        mine = [d.certain - onset for d in found if d.rotor == rotor and d.certain > onset]
        results.append((min(mine, default=np.inf), sum(d.rotor != rotor and d.certain < onset + min(mine, default=LATE_S) for d in found)))
    return results


def line(name: str, late: np.ndarray) -> str:
    """Found, within 130 ms, median and 90 % quantile."""
    there = late[late < LATE_S]
    quantiles = " ".join(f"{1e3 * float(np.quantile(there, q)):.0f}" for q in (0.5, 0.9)) if there.size else "-"
    return f"{name}: {there.size} of {late.size} found, {np.count_nonzero(late <= 0.13)} within 130 ms; median and 90 % {quantiles} ms"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--real", default="")
    given = parser.parse_args()
    with ProcessPoolExecutor(given.jobs) as pool:
        for kind in KINDS:
            results = list(pool.map(one, [(seed, kind) for seed in range(given.count)]))
            print(line(f"{kind}, with speeds", np.array([r[0] for r in results])), f"; wrong {sum(r[2] for r in results)}", flush=True)
            print(line(f"{kind}, without", np.array([r[1] for r in results])), flush=True)
        if given.real:
            paths = sorted(str(p) for p in Path(given.real).iterdir() if p.suffix not in (".md",))
            flights = list(pool.map(changed, paths))
            print("real, as they are: named", sum(f[0][1] for f in flights), "in", len(flights))
            rest = [r for f in flights for r in f[1:]]
            print(line("real, changed", np.array([r[0] for r in rest])), f"; wrong {sum(r[1] for r in rest)}")


if __name__ == "__main__":
    main()
