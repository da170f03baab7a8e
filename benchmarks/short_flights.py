"""What is said of flights of some seconds: how many are assessed, which losses are found, and how often one is that is not there.

    python benchmarks/short_flights.py simulated [--flights 900] [--seconds 8] [--loss 0.3] [--first 0] [--jobs 2]
    python benchmarks/short_flights.py logs [--seconds 8] [--loss 0.3] LOG...

Simulated: a quadrotor takes off, hovers in wind of 0 to 5 m/s and is logged at 400 Hz; of each flight so many seconds from lift-off on
are assessed, once as it is and once with a loss of one rotor that begins between 35 and 70 % of them. Logs: each session as it is up to its
first landing, and where that is longer cut to so many seconds; into each that is assessed losses are put, one for each rotor. Flight k
follows from its number alone.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable

import numpy as np

import rotorwatch as rw
from rotorwatch import airframes, gathering
from rotorwatch.base.many import spread
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight import Flight
from rotorwatch_lab.experiments.inject import inject
from rotorwatch_lab.simulation import scenario, simulate

FLOWN_S, TAKE_OFF_S = 26.0, 4.0  # of a simulated flight, and about when it lifts off
ONSETS = 0.35, 0.7  # share of the seconds
WIND = 5.0  # m/s at most


def simulated(number: int, seconds: float, loss: float) -> list[tuple[float, int, float, dict]]:
    """(loss, rotor, seconds, what is said) of flight `number` as it is, and with a loss."""
    rng = np.random.default_rng(number)
    rotor, share, wind = int(rng.integers(1, 5)), float(rng.uniform(*ONSETS)), float(rng.uniform(0.0, WIND))
    rows = []
    for size in (0.0, loss):
        fault = {"kind": "loss", "rotor": rotor, "onset_s": TAKE_OFF_S + share * seconds, "strength": size}
        table = {
            "duration_s": FLOWN_S, "seed": number, "autopilot": "px4", "airframe": {"frame": "quad-x"}, "logging": {"profile": "full"},
            "trajectory": {"kind": "hover", "altitude_m": 2.0}, "wind": {"speed_m_s": wind}, "faults": [fault] if size else [],
        }  # fmt: skip
        flight = simulate(scenario.from_table(table)).flight
        start = airborne(flight)[0][0]
        rows.append((size, rotor, seconds, said(flight.until(start + seconds))))
    return rows


def said(flight: Flight) -> dict:
    """Verdict, the rotors accused, whether it was assessed, and the largest bound of a rotor."""
    answer = rw.diagnose(flight)
    sure = {r for e in answer.events if e.means.accuses and not e.alternatives for r in e.rotors}
    named = {r for e in answer.events if e.means.accuses for r in e.suspects}
    named |= {r.rotor for r in answer.rotors if r.status == "suspect"}
    bounds = [r.since_takeoff[1] for r in answer.rotors if r.since_takeoff]
    assessed = answer.verdict != "inconclusive" or bool(bounds)
    return {
        "verdict": answer.verdict, "sure": sure, "named": named, "assessed": assessed, "bound": max(bounds, default=1.0),
        "why": answer.headline,
    }  # fmt: skip


def of_logs(paths: Iterable[str], seconds: float, loss: float) -> list[tuple[float, int, float, dict]]:
    """The same of the sessions in logs; a line for each."""
    rows = []
    for path in gathering.Gathered(list(paths)):
        try:
            flight = rw.read(path)
            vehicle, air = airframes.identify(flight), airborne(flight)
        except RotorwatchError as why:
            print(f"{path}: {why}")
            continue
        if vehicle is None or not air:
            continue
        start, end = air[0]
        for part in dict.fromkeys((end, min(end, start + seconds))):
            there = flight.until(part)
            answer, span = said(there), part - start
            print(f"{path}, {span:.1f} s: {answer['verdict']}, bound {100 * answer['bound']:.0f} %: {answer['why']}")
            rows.append((0.0, 0, span, answer))
            if answer["assessed"] and span < 2 * seconds:
                for k in range(1, len(vehicle.rotors) + 1):
                    changed = inject(there, vehicle, k, loss, start + 0.5 * span)
                    rows.append((loss, k, span, said(changed)))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("simulated", "logs"))
    parser.add_argument("logs", nargs="*")
    parser.add_argument("--flights", type=int, default=900)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--loss", type=float, default=0.3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=spread.processors())
    options = parser.parse_args()
    if options.what == "logs":
        rows = of_logs(options.logs, options.seconds, options.loss)
    else:
        numbers = range(options.first, options.first + options.flights)
        work = [(k, options.seconds, options.loss) for k in numbers]
        rows = [row for done in spread.run(_simulated, work, options.jobs) for row in done.result()]
    healthy, weak = [row for row in rows if not row[0]], [row for row in rows if row[0]]
    hours = sum(row[2] for row in healthy) / 3600.0
    bounds = [row[3]["bound"] for row in healthy if row[3]["assessed"]]
    print(f"\n{len(healthy)} flights, {hours:.2f} h: {dict(Counter(row[3]['verdict'] for row in healthy))}")
    print(f"assessed {len(bounds)}; bound: median {np.median(bounds or [1.0]):.3f}, 90 % {np.quantile(bounds or [1.0], 0.9):.3f}")
    print(f"accused {sum(bool(row[3]['sure']) for row in healthy)}, suspected {sum(bool(row[3]['named']) for row in healthy)}")
    right = sum(row[3]["sure"] == {row[1]} for row in weak)
    among = sum(row[1] in row[3]["named"] and row[3]["sure"] != {row[1]} and not row[3]["sure"] - {row[1]} for row in weak)
    wrong = sum(bool(row[3]["sure"] - {row[1]}) for row in weak)
    calm = sum(row[3]["verdict"] == "healthy" for row in weak)
    print(f"{len(weak)} with a loss of {options.loss:.0%}: {right} right, {among} among the suspects, {wrong} wrong, {calm} healthy")


def _simulated(work: tuple[int, float, float]) -> list[tuple[float, int, float, dict]]:
    return simulated(*work)


if __name__ == "__main__":
    main()
