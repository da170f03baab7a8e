"""Crashes by the hundred, assessed and counted: `python -m tests.crashes --flights 300 --stays 300 [--jobs 2]`.

Frames, kinds of crashes, and rates at which outputs are logged are drawn by the seed. What truly happened is the model's (`tumbling.fly`).
A crash is drawn again, frame and all, until control is lost: an octarotor flies on without a rotor, and many a knock is mastered.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from tests import tumbling

from rotorwatch import airframes, diagnose
from rotorwatch.flight import Flight

FRAMES = ("quad-x", "quad-plus", "hexa-x", "hexa-plus", "octa-x", "octaquad-x", "y6-b")
RATES = (5.0, 10.0, 50.0, 400.0)
RIGHT_CAUSE = {"swapped": "motor_order", "disarmed": "disarmed", "gyro": "controller", "knock": "knock", "power": "power"}


DRAWS = 30


def flown(task: tuple[str, str, int, float]) -> tuple[str, int, Flight, tumbling.Truth]:
    """(frame, seed, flight, truth) of a task: the first draw from its seed on that is lost, or that is no crash."""
    frame, case, seed, rate = task
    for _ in range(DRAWS):
        flight, truth = tumbling.fly(frame, case, seed, rate)
        if truth.lost or case in tumbling.STAYS:
            return frame, seed, flight, truth
        seed += 1
        frame = str(np.random.default_rng(seed).choice(FRAMES))
    raise RuntimeError(f"{task}: no crash in {DRAWS} draws")


def assessed(task: tuple[str, str, int, float]) -> tuple[str, str, int, float, str]:
    """(frame, case, seed, rate, answer) of one flight; the answer as in `verdict_of`."""
    _, case, _, rate = task
    frame, seed, flight, truth = flown(task)
    answer = diagnose(flight, airframes.named(f"ardupilot-{frame}"))
    return frame, case, seed, rate, verdict_of(answer, truth)


def verdict_of(answer, truth: tumbling.Truth) -> str:
    """How an answer stands to what happened: right, candidates, wrong, healthy, unknown, missed, or, of no crash, claimed or stays."""
    lost = [e for e in answer.events if e.kind == "loss_of_control"]
    losses = [e for e in answer.events if e.kind == "loss_of_effectiveness"]
    if truth.case in tumbling.STAYS:
        return "claimed" if lost else "stays"
    sure = {r for e in losses if not e.alternatives for r in e.rotors}
    named = {r for e in losses for who in (e.rotors, *e.alternatives) for r in who}
    cause = lost[0].extra["cause"] if lost else ""
    order = [e for e in answer.events if e.kind == "motor_order" and not e.alternatives]
    if truth.case not in RIGHT_CAUSE:
        right = set(truth.rotors)
        if sure - right or order or cause in RIGHT_CAUSE.values():
            return "wrong"
        if sure == right:
            return "right"
        if named & right:
            return "candidates"
    else:
        if sure or (order and set(order[0].rotors) != set(truth.rotors)):
            return "wrong"
        if cause == RIGHT_CAUSE[truth.case]:
            return "right" if truth.case != "swapped" or order else "candidates"
        if cause not in ("", "unknown"):
            return "wrong"
        if named & set(truth.rotors):
            return "candidates"
    if answer.verdict == "healthy":
        return "healthy"
    return "unknown" if lost else "missed"


def tasks(flights: int, cases, seed: int) -> list[tuple[str, str, int, float]]:
    """`flights` draws, each case in turn."""
    rng = np.random.default_rng(seed)
    return [
        (str(rng.choice(FRAMES)), cases[k % len(cases)], int(rng.integers(2**31)), float(RATES[(k // len(cases)) % len(RATES)]))
        for k in range(flights)
    ]


def main() -> None:
    """Fly, assess, count, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=300)
    parser.add_argument("--stays", type=int, default=300)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    work = tasks(given.flights, tumbling.CRASHES, given.seed) + tasks(given.stays, tumbling.STAYS, given.seed + 1)
    found = defaultdict(Counter)

    with ProcessPoolExecutor(given.jobs) as pool:
        for number, (frame, case, seed, rate, answer) in enumerate(pool.map(assessed, work, chunksize=4), start=1):
            kind = "crashes" if case in tumbling.CRASHES else "stays up"
            for row in (f"all {kind}", case, f"{kind}, {rate:g} Hz", f"{kind}, {frame}"):
                found[row][answer] += 1
            if answer not in ("right", "stays"):
                print(f"{number} of {len(work)}: {frame} {case} {seed} {rate:g} {answer}", flush=True)
    for row, counts in found.items():
        print(f"| {row} | {sum(counts.values())} | " + ", ".join(f"{k} {v}" for k, v in counts.most_common()) + " |")


if __name__ == "__main__":
    main()
