"""A campaign of simulated FPV flights (simulation/fpv.py), assessed by `rotorwatch.diagnose` (docs/aerobatic.md, "Simulated flights").

    python benchmarks/fpv.py [--flights 1000] [--healthy-hours 20] [--first 0] [--jobs 2] [--curves]

Flights of 60 s: a 5-inch quadrotor of eight times its weight in thrust that rolls, flips, spins, dives and punches out, logged at 1 kHz,
half of them with the motors' speeds. 35 % are healthy; 45 % lose 5 to 60 % of a rotor at 15 to 35 s, by a damaged propeller or a slow
motor; in 20 % a motor desyncs one to three times for 30 to 500 ms. Everything follows from the number of the batch.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from rotorwatch.diagnose import diagnose
from rotorwatch_lab.simulation import fpv

DURATION_S, BATCH = 60.0, 20
AIR_S = DURATION_S - 2.0 * fpv.GROUND_S
HEALTHY, LOSS = 0.35, 0.8  # shares: healthy, and with a loss
SIZES = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.3), (0.3, 0.45), (0.45, 0.6))
LENGTHS_S = (0.03, 0.05, 0.1, 0.2, 0.5)
NEAR_S = 0.08  # of its beginning, that a found desync counts that does not overlap with it
WORKING_S = 5.0  # after a loss it may be found; what ends earlier is not counted


def drawn(rng: np.random.Generator, j: int) -> list[fpv.Moment]:
    """What goes wrong in flight j of a batch."""
    kind, rotor = rng.uniform(), int(rng.integers(4))
    if kind < HEALTHY:
        return []
    if kind < LOSS:
        loss = float(np.exp(rng.uniform(np.log(0.05), np.log(0.6))))
        return [fpv.Moment(j, rotor, rng.uniform(15.0, 35.0), DURATION_S, loss, bool(rng.integers(2)))]
    starts = np.sort(rng.uniform(8.0, 52.0, int(rng.integers(1, 4))))
    starts = starts[np.diff(starts, prepend=0.0) > 2.0]
    return [fpv.Moment(j, rotor, float(s), float(rng.choice(LENGTHS_S))) for s in starts]


def batch(number: int, healthy: bool, curves: bool = False) -> list[dict]:
    """A row for each flight of a batch. curves: each has its own thrust curve, from linear to quadratic, which nobody knows."""
    rng = np.random.default_rng((7, number, healthy))
    wrong = [[] if healthy else drawn(rng, j) for j in range(BATCH)]
    rpm = bool(number % 2)
    expo = rng.uniform(0.0, 1.0, BATCH).tolist() if curves else fpv.EXPO
    flights = fpv.fly(BATCH, DURATION_S, 10_000 * (1 + healthy) + number, tuple(m for ms in wrong for m in ms), rpm, expo)
    return [assessed(flight, ms, rpm) for flight, ms in zip(flights, wrong)]


def assessed(flight, wrong: list[fpv.Moment], rpm: bool) -> dict:
    """truth against answer of one flight."""
    answer = diagnose(flight)
    losses = [e for e in answer.events if e.kind == "loss_of_effectiveness"]
    desyncs = [
        (r, t, t + long) for e in answer.events if e.kind == "desync"
        for r in (e.rotors, *e.alternatives) for t, long in zip(e.extra["times"], e.extra["durations"], strict=True)
    ]  # fmt: skip
    other = [e.kind for e in answer.events if e.kind not in ("loss_of_effectiveness", "desync")]
    row: dict = {"rpm": rpm, "verdict": answer.verdict, "other": other, "false": 0, "faults": []}
    true = [m for m in wrong if m.loss is not None]
    for m in true:
        loss = float(m.loss or 0.0)
        hit = [e for e in losses if e.detected_s >= m.start]
        fault: dict = {"loss": m.loss, "slower": m.slower, "found": bool(hit)}
        if hit:
            e, rotor = hit[0], m.rotor + 1
            fault |= {"right": rotor in e.rotors, "ambiguous": bool(e.alternatives), "delay": e.detected_s - m.start}
            fault["cause"] = (e.extra or {}).get("cause")
            if fault["right"]:
                k = e.rotors.index(rotor)
                low, high = e.interval[k]
                fault |= {"error": e.loss[k] - loss, "inside": low <= loss <= high}
        row["faults"].append(fault)
    row["false"] += sum(1 for e in losses if not true or e.detected_s < true[0].start)
    lost = [m for m in wrong if m.loss is None]
    for m in lost:
        end = m.start + m.lasting
        near = [r for r, a, b in desyncs if (a < end and b > m.start) or abs(a - m.start) < NEAR_S]
        row["faults"].append({"length": m.lasting, "found": (m.rotor + 1,) in near, "wrong": bool(near) and (m.rotor + 1,) not in near})
    times = {t for _, t, _ in desyncs}
    row["false"] += sum(all(not m.start - 0.3 < t < m.start + m.lasting + 0.4 for m in lost) for t in times)
    return row


def table(rows: list[dict]) -> None:
    """Print what became of the faults, and of healthy time."""
    faults = [(row["rpm"], fault) for row in rows for fault in row["faults"]]
    for rpm in (False, True):
        own = [f for logged, f in faults if logged is rpm]
        print(f"\nwith speeds: {rpm}")
        for low, high in SIZES:
            chosen = [f for f in own if low <= f.get("loss", -1.0) < high]
            found = [f for f in chosen if f["found"]]
            right = [f for f in found if f["right"]]
            print(json.dumps({
                "loss": f"{low:g} to {high:g}", "flights": len(chosen), "found": len(found), "right rotor": len(right),
                "ambiguous": sum(f["ambiguous"] for f in found),
                "delay_s": _median([f["delay"] for f in found]), "error": _median([f["error"] for f in right]),
                "rms": _rms([f["error"] for f in right]), "inside": sum(f["inside"] for f in right),
                "cause named": sum(f["cause"] is not None for f in found),
                "cause right": sum(f["cause"] == ("motor_or_esc" if f["slower"] else "propeller") for f in found),
                "causes": sorted({str(f["cause"]) for f in found}),
            }))  # fmt: skip
        for length in LENGTHS_S:
            chosen = [f for f in own if f.get("length") == length]
            print(json.dumps({
                "desync_ms": round(1000 * length), "count": len(chosen), "found": sum(f["found"] for f in chosen),
                "wrong motor": sum(f["wrong"] for f in chosen),
            }))  # fmt: skip
    hours = sum(AIR_S for row in rows if not row["faults"]) / 3600.0
    healthy = [row for row in rows if not row["faults"]]
    verdicts = {word: sum(row["verdict"] == word for row in healthy) for word in sorted({r["verdict"] for r in healthy})}
    false = sum(row["false"] for row in rows)
    print(json.dumps({
        "flights": len(rows), "healthy_hours": round(hours, 2), "verdicts of healthy flights": verdicts,
        "false announcements in all flights": false, "other events of healthy flights": [k for row in healthy for k in row["other"]],
    }), flush=True)  # fmt: skip


def _median(values: list[float]) -> float | None:
    return round(float(np.median(values)), 3) if values else None


def _rms(values: list[float]) -> float | None:
    return round(float(np.sqrt(np.mean(np.square(values)))), 3) if values else None


def main() -> None:
    """Fly, assess, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=1000)
    parser.add_argument("--healthy-hours", type=float, default=20.0)
    parser.add_argument("--first", type=int, default=0, help="number of the first batch: others are other flights")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--curves", action="store_true", help="thrust curves that the assess does not know")
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        for healthy, count in ((False, options.flights), (True, round(options.healthy_hours * 3600.0 / AIR_S))):
            rows: list[dict] = []
            if not count:
                continue
            numbers = range(options.first, options.first - (-count // BATCH))
            for made in pool.map(batch, numbers, [healthy] * len(numbers), [options.curves] * len(numbers)):
                rows += made
                print(f"{len(rows)} of {count}", file=sys.stderr, flush=True)
                if len(rows) % (10 * BATCH) == 0:
                    table(rows)
            table(rows)


if __name__ == "__main__":
    main()
