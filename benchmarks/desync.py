"""How often motors that lose step for a moment are found, and how often one is seen that was none (docs/aerobatic.md, "Desyncs").

    python benchmarks/desync.py simulated [--flights 24] [--healthy-hours 2]
    python benchmarks/desync.py logs FOLDER [--shifted-hours 5]

simulated: flights of `rotorwatch_lab/simulation/fpv.py`, 60 s each, eleven desyncs in each, with and without speeds. logs: Blackbox logs of
real FPV flights (`.bbl`, `.bfl`, `.txt`, also packed); in copies of them a motor gives nothing for so long: the gyro gets what the angular
acceleration then lacks, by the impulse response that a regression on windows of 2 ms finds in that log, made slower or faster and larger or
smaller at random; the controller does not answer. Shifted: surprises of one time against commands of another, which is noise without any
desync.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from rotorwatch import logs
from rotorwatch.diagnose import diagnose
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.allocation import motor_thrusts, within
from rotorwatch.flight import Flight
from rotorwatch.logs import blackbox
from rotorwatch.witnesses.aerobatic import desync
from rotorwatch.witnesses.aerobatic.innovation import Channel, channels, means
from rotorwatch.witnesses.healthy import baselines
from rotorwatch.witnesses.upset import find as upset
from rotorwatch_lab.simulation import fpv

LENGTHS_S = (0.03, 0.05, 0.1, 0.2, 0.5)
LEVELS = (0.1, 0.2, 0.3, 2.0)  # mean of what was commanded while nothing came, share of full thrust
NEAR_S = 0.08  # of its beginning, that a find counts that does not overlap with it
STEP_S, BACK, PAST, SPAN_S = 0.002, 30, 24, 0.2  # of the regression that injections follow
SLOWER, LARGER = (0.8, 1.3), (0.85, 1.15)


class Score:
    """What became of desyncs, by length and by what was commanded."""

    def __init__(self):
        self.rows: list[tuple[float, float, bool]] = []
        self.wrong = self.false = 0

    def add(self, truth: list[tuple[int, float, float, float]], found: list[desync.Desync]) -> None:
        """truth: (rotor, start, length, commanded) of each."""
        for rotor, start, length, commanded in truth:
            hit = any(
                d.rotor == rotor and not d.others and ((d.start < start + length and d.end > start) or abs(d.start - start) < NEAR_S)
                for d in found
            )  # fmt: skip
            self.rows.append((length, commanded, hit))
        for d in found:
            near = [t for t in truth if t[1] - 0.3 < d.start < t[1] + t[2] + 0.4]
            self.false += not near
            self.wrong += bool(near) and all(d.rotor != t[0] for t in near)

    def table(self) -> list[dict]:
        out = []
        for length in LENGTHS_S:
            row: dict = {"length_ms": round(1000 * length)}
            for low, high in itertools.pairwise(LEVELS):
                hits = [hit for one, commanded, hit in self.rows if one == length and low <= commanded < high]
                row[f"from {low:g}"] = f"{sum(hits)}/{len(hits)}"
            out.append(row)
        return [*out, {"false": self.false, "wrong motor": self.wrong}]


def simulated(flights: int, hours: float) -> None:
    rng, batch = np.random.default_rng(1), 6
    names, seconds = ("gyro", "gyro and speed"), 0.0
    scores: dict[str, Score] = {name: Score() for name in names}
    false: dict[str, int] = dict.fromkeys(names, 0)
    for number in range(0, flights, batch):
        wrong = [
            fpv.Moment(j, int(rng.integers(4)), 5.0 + 4.7 * k + rng.uniform(0.0, 2.0), float(rng.choice(LENGTHS_S)))
            for j in range(batch) for k in range(11)
        ]  # fmt: skip
        for j, flight in enumerate(fpv.fly(batch, 60.0, 100 + number, tuple(wrong), rpm=True)):
            own = [w for w in wrong if w.flight == j]
            for name, seen in _both(flight):
                truth = [(w.rotor, w.start, w.lasting, _commanded(seen, w.rotor, w.start, w.lasting)) for w in own]
                scores[name].add(truth, desync.search(seen))
    for name, score in scores.items():
        print(json.dumps({"simulated": name, "table": score.table()}, indent=1), flush=True)
    number = 0
    while seconds < hours * 3600.0:
        for flight in fpv.fly(batch, 60.0, 5000 + number, (), rpm=True):
            for name, seen in _both(flight):
                false[name] += len(desync.search(seen))
            seconds += 60.0 - 2.0 * fpv.GROUND_S
        number += 1
        print(json.dumps({"healthy_hours": round(seconds / 3600.0, 2), "false": false}), flush=True)


def _both(flight: Flight) -> list[tuple[str, list[Channel]]]:
    vehicle, _, _ = baselines.settle(flight, None, (), diagnose)
    seen = channels(flight, vehicle, ((fpv.GROUND_S + 0.5, flight.duration - fpv.GROUND_S),))
    return [("gyro", seen[:3]), ("gyro and speed", seen)]


def _commanded(seen: list[Channel], rotor: int, start: float, length: float) -> float:
    inside = (seen[0].time >= start) & (seen[0].time < start + length)
    return float(seen[0].thrust[inside, rotor].mean())


def flown(folder: Path) -> list[tuple[str, Flight]]:
    """Sessions of a folder's logs that fly."""
    out = []
    for path in sorted(folder.iterdir()):
        if path.name.lower().removesuffix(".xz").rpartition(".")[2] not in ("bbl", "bfl", "txt"):
            continue
        try:
            count = len(blackbox.parts(_bytes(path)))
        except Exception as why:
            print(f"{path.name}: {why}", file=sys.stderr)
            continue
        for part in range(1, count + 1):
            try:
                out.append((f"{path.name}#{part}", logs.read(f"{path}#{part}")))
            except Exception as why:
                print(f"{path.name}#{part}: {why}", file=sys.stderr)
    return out


def _bytes(path: Path) -> bytes:
    import lzma

    return lzma.open(path).read() if path.suffix == ".xz" else path.read_bytes()


def real(folder: Path, hours: float) -> None:
    rng, score, known, seconds = np.random.default_rng(2), Score(), [], 0.0
    for name, flight in flown(folder):
        vehicle, _, _ = baselines.settle(flight, None, (), diagnose)
        air = airborne(flight)
        air = upset.until_impact(flight, air, upset.assessed(flight, vehicle, air))
        seen = channels(flight, vehicle, air)
        if not seen:
            continue
        known.append(seen)
        own = float(seen[0].flies.sum()) * seen[0].width
        seconds += own
        print(json.dumps({"log": name, "flies_s": round(own, 1), "found": [d._asdict() for d in desync.search(seen)]}), flush=True)
        turn = responses(flight, vehicle, air)
        for length in LENGTHS_S:
            made, truth = inject(flight, vehicle, air, turn, length, rng)
            score.add(truth, desync.search(channels(made, vehicle, air)))
    print(json.dumps({"injected": score.table(), "healthy_minutes": round(seconds / 60.0, 1)}, indent=1), flush=True)
    shifted, false = 0.0, 0
    while known and shifted < hours * 3600.0:
        for seen in known:
            rows = np.flatnonzero(seen[0].flies)
            shift, sign = int(rng.integers(500, max(501, len(rows) - 500))), rng.choice((-1.0, 1.0), 3)
            moved = []
            for c, s in zip(seen, sign):
                left = c.left.copy()
                left[rows] = s * np.roll(c.left[rows], shift)
                moved.append(c._replace(left=left))
            false += len(desync.search(moved))
            shifted += len(rows) * seen[0].width
        print(json.dumps({"shifted_hours": round(shifted / 3600.0, 2), "false": false}), flush=True)


def responses(flight: Flight, vehicle, air) -> np.ndarray:
    """(3, m) impulse response of the angular acceleration to B f, STEP_S apart."""
    commanded, gyro = motor_thrusts(flight, vehicle), flight["gyro"]
    edges = np.searchsorted(commanded.time, np.arange(commanded.time[0], commanded.time[-1], STEP_S))
    thrust, rate = means(commanded.values, edges), means(gyro.values, edges)
    turning = np.diff(rate, axis=0, append=rate[-1:]) / STEP_S
    flies = within(commanded.time[0] + STEP_S * np.arange(len(thrust)), tuple((a + 1.0, b - 1.0) for a, b in air))
    m, out = round(SPAN_S / STEP_S), []
    for axis, B in enumerate(vehicle.effectiveness()[:3]):
        x, y = thrust @ B, turning[:, axis]
        late = [np.roll(x, k) for k in range(BACK)] + [np.roll(y, k) for k in range(1, PAST + 1)]
        X = np.column_stack([*late, np.ones(len(x)), rate[:, axis], rate[:, axis - 1] * rate[:, axis - 2]])
        fitted, h = np.linalg.lstsq(X[flies], y[flies], rcond=None)[0], np.zeros(m)
        for k in range(m):
            h[k] = (fitted[k] if k < BACK else 0.0) + sum(fitted[BACK + j] * h[k - 1 - j] for j in range(min(PAST, k)))
        out.append(h * np.clip((0.8 * SPAN_S - STEP_S * np.arange(m)) / (0.4 * SPAN_S), 0.0, 1.0))
    return np.array(out)


def inject(flight: Flight, vehicle, air, turn: np.ndarray, length: float, rng, least: float = LEVELS[0], spacing_s: float = 3.0):
    """(flight with desyncs of so many s, [(rotor, start, length, commanded)])."""
    commanded, gyro = motor_thrusts(flight, vehicle), flight["gyro"]
    time, rate, B, truth = commanded.time, gyro.values.copy(), vehicle.effectiveness()[:3], []
    dt, now = float(np.median(np.diff(time))), air[0][0] + 2.0
    while (now := now + 0.3) + length + 2.0 < air[-1][1]:
        rotor, start = int(rng.integers(B.shape[1])), now + rng.uniform(0.0, 0.3)
        box = (time >= start) & (time < start + length)
        if not box.any() or commanded.values[box, rotor].mean() < least or not any(a + 1.5 < start < b - 1.5 for a, b in air):
            continue
        first, last = np.searchsorted(time, [start, start + length + 0.3])
        missing = (commanded.values[:, rotor] * box)[first:last]
        slower, larger = rng.uniform(*SLOWER), rng.uniform(*LARGER)
        at = np.arange(round(SPAN_S * slower / dt)) * dt / slower
        for axis in range(3):
            step = np.interp(at, STEP_S * np.arange(turn.shape[1]), np.cumsum(turn[axis]))
            lacks = larger * B[axis, rotor] * np.convolve(missing, np.diff(step, prepend=0.0))[: last - first]
            rate[first:last, axis] -= np.cumsum(lacks) * dt
            rate[last:, axis] -= lacks.sum() * dt
        truth.append((rotor, start, length, float(commanded.values[box, rotor].mean())))
        now += spacing_s + length
    return replace(flight, signals={**flight.signals, "gyro": replace(gyro, values=rate)}), truth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="way", required=True)
    one = ways.add_parser("simulated")
    one.add_argument("--flights", type=int, default=24)
    one.add_argument("--healthy-hours", type=float, default=2.0)
    two = ways.add_parser("logs")
    two.add_argument("folder", type=Path)
    two.add_argument("--shifted-hours", type=float, default=5.0)
    options = parser.parse_args()
    if options.way == "simulated":
        simulated(options.flights, options.healthy_hours)
    else:
        real(options.folder, options.shifted_hours)


if __name__ == "__main__":
    main()
