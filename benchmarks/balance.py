"""How well rotors that are out of balance are found: simulated flights with figures, and unbalances put into real flights.

    python benchmarks/balance.py [--count 1000] [--closed 40] [--jobs 2] [--real FOLDER]

Simulated: quadrotors and hexarotors with an accelerometer and speeds at 500 Hz (or telemetry at 50 Hz), healthy ones, ones with a rotor
whose imbalance doubles in flight, and ones with a chipped blade, which lost a piece that shifts 1.2e-4 radii (5 % of its length: 3 % of a
blade of 0.4 % of the vehicle's mass) or twice that; and ones with commands and an accelerometer at 1 kHz, without speeds. In closed loop:
quadrotors, hexarotors and coaxial octorotors in wind, whose rotors differ by up to 8 %, are diagnosed like any log, with the witness and
without it; a rotor loses 5 or 10 % of its thrust with a piece of a blade, or none does. Real: in each flight of a folder the tone of each
rotor in turn doubles at its middle.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

import rotorwatch
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.flight import Flight
from rotorwatch.flight.kinds import OUT_OF_BALANCE, UNBALANCED
from rotorwatch.witnesses import witness
from rotorwatch.witnesses.balance import imbalances, unbalanced
from rotorwatch_lab.experiments import imbalance
from rotorwatch_lab.simulation import scenario, simulate, vibration

DURATION_S, RATE_HZ = 60.0, 500.0
CASES = {
    "healthy": {}, "doubled": {"times": 2.0}, "doubled, telemetry at 50 Hz": {"times": 2.0, "telemetry_hz": 50.0},
    "healthy, telemetry at 50 Hz": {"telemetry_hz": 50.0}, "chipped 5 %": {"chip": 1.0}, "chipped 10 %": {"chip": 2.0},
    "doubled, no speeds at 1 kHz": {"times": 2.0, "rate_hz": 1000.0, "speeds": False},
    "healthy, no speeds at 1 kHz": {"rate_hz": 1000.0, "speeds": False},
}  # fmt: skip


def outcome(found, drawn: imbalance.Drawn) -> str:
    """right, wrong, several (the right one among two), missed or not heard; of a healthy flight false or none."""
    if found is None:
        return "not heard"
    made = unbalanced.findings(found)
    named = [f.rotors for f in made]
    if not drawn.rotor:
        return f"false, against {made[0].against}" if named else "none"
    if any(drawn.rotor not in rotors for rotors in named):
        return "wrong"
    return "missed" if not named else "right" if len(named[0]) == 1 else "several"


def one(task: tuple[int, int, str]) -> str:
    seed, rotors, case = task
    more = dict(CASES[case])
    chip = more.pop("chip", 0.0)
    if chip:
        usual = np.exp(np.random.default_rng([seed, rotors]).uniform(np.log(500.0), np.log(2000.0)))  # as `simulated` draws it
        more["adds"] = vibration.chip(0.05 * chip, float(usual))
    drawn = imbalance.simulated(seed, rotors, DURATION_S, **{"rate_hz": RATE_HZ, **more})
    return outcome(imbalances.listen(drawn.flight, rotors, ((0.0, DURATION_S),)), drawn)


def flown(seed: int, loss: float) -> tuple[Flight, int]:
    """(flight, rotor that lost so much of its thrust)."""
    rng = np.random.default_rng(seed)
    frame, rotors = (("quad-x", 4), ("hexa-x", 6), ("octaquad-x", 8))[seed % 3]
    rotor, onset = int(rng.integers(rotors)) + 1, float(rng.uniform(35.0, 45.0))
    table = {
        "duration_s": 85.0, "seed": seed, "autopilot": ("ardupilot", "px4")[rng.integers(2)],
        "airframe": {"frame": frame, "rotor_spread": 0.08}, "sensors": {"imbalance": 4.0},
        "wind": {"speed_m_s": float(rng.choice([0.0, 3.0, 6.0])), "from_deg": float(rng.uniform(0.0, 360.0))},
        "trajectory": {"kind": str(rng.choice(["hover", "square", "figure-eight"])), "altitude_m": 8.0},
        "logging": {"esc": True, "profile": "full", "raw_hz": RATE_HZ},
        "faults": [{"rotor": rotor, "onset_s": onset, "kind": "chipped", "strength": loss}] if loss else [],
    }  # fmt: skip
    return simulate(scenario.from_table(table)).flight, rotor


def reported(task: tuple[int, float]) -> tuple[str, str, str]:
    """What the answer says, with the witness and without it, and what the witness's notice says."""
    flight, rotor = flown(*task)

    def said(events, bounded: bool) -> str:
        if not events:
            return "nothing"
        if any(task[1] == 0.0 or rotor not in e.suspects for e in events):
            return "wrong"
        return "right" if bounded and all(not e.alternatives for e in events) else "right, open"

    def answer() -> tuple[str, str]:
        found = rotorwatch.diagnose(flight)
        losses = [e for e in found.events if e.means.weakens]
        thrust = said(losses, found.verdict == "fault") if losses else "open" if found.verdict == "ambiguous" else "nothing"
        return thrust, said([e for e in found.events if e.kind in (OUT_OF_BALANCE, UNBALANCED)], True)

    with_, notice = answer()
    with witness.changed(lambda w: None if w.name == "balance" else w):
        return with_, answer()[0], notice


def real(path: str) -> list[str]:
    flight = rotorwatch.read(path)
    air = airborne(flight)
    n = flight.rotor_count
    found = imbalances.listen(flight, n, air)
    if found is None or any(f is None or len(f.together) > 1 for f in found.figures):
        return ["not heard"]
    middle = 0.5 * (air[-1][0] + air[-1][1])
    results = ["false" if unbalanced.findings(found) else "none"]
    for rotor, figure in enumerate(found.figures, 1):
        assert figure is not None
        more = imbalance.inject(flight, rotor, 0.0, middle, times=2.0)
        results.append(outcome(imbalances.listen(more, n, air), imbalance.Drawn(more, rotor, middle, np.zeros(n))))
    return results


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--closed", type=int, default=0)
    parser.add_argument("--real", default="")
    given = parser.parse_args()
    with ProcessPoolExecutor(given.jobs) as pool:
        for case in CASES if given.count else ():
            count = given.count if case in ("healthy", "doubled") else given.count // 5
            tasks = [(seed, (4, 6)[seed % 2], case) for seed in range(count)]
            counted = Counter(pool.map(one, tasks, chunksize=8))
            print(f"{case}: {dict(counted)} in {count} flights, {count * DURATION_S / 3600.0:.1f} h", flush=True)
        for loss in (0.05, 0.1, 0.0) if given.closed else ():
            answers = list(pool.map(reported, [(seed, loss) for seed in range(given.closed)]))
            for name, column in zip(("loss, with balance", "loss, without", "notice"), zip(*answers, strict=True)):
                print(f"closed loop, {100 * loss:.0f} %, {name}: {dict(Counter(column))}", flush=True)
        if given.real:
            paths = sorted(str(p) for p in Path(given.real).iterdir() if p.suffix not in (".md",))
            print("real:", dict(Counter(r for results in pool.map(real, paths) for r in results)))


if __name__ == "__main__":
    main()
