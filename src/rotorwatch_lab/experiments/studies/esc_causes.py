"""Accuracy of causes named from ESC telemetry: simulated flights of known faults, diagnosed like any log.

    python -m rotorwatch_lab.experiments.studies.esc_causes --flights 240 --seed 1

Frames, autopilots, wind, manoeuvres, onsets, rotors and strengths are drawn; a flight's cause is the fault's kind. An answer is the cause
of a loss that names the faulty rotor alone, else the notice on that rotor, or nothing.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.kinds import HIGH, LOW, SLOW
from rotorwatch.toolkit import diagnose
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.simulation import scenario, simulate

DURATION_S = 80.0
KINDS = {
    "propeller": (("loss", 0.08, 0.6), ("chipped", 0.08, 0.5), ("complete loss", None, None)),
    "motor or ESC": (("weak motor", 0.08, 0.6), ("float", None, None)),
    "bearing": (("bearing", 0.1, 0.5),),
    "healthy": (),
}
NOTICES = {HIGH: "more current", LOW: "less current", SLOW: "slow"}
ANSWERS = (
    "propeller", "motor or ESC", "bearing", "unknown", "slow", "more current", "less current", "ambiguous", "other rotor", "nothing",
)  # fmt: skip
"""Columns of the table: causes, then the three notices, losses without a cause, what names other rotors only, and silence."""
CAUSES = {"propeller": "propeller", "motor_or_esc": "motor or ESC", "bearing": "bearing", "unknown": "unknown"}


def flights(count: int, seed: int) -> Iterator[tuple[str, int | None, scenario.Scenario]]:
    """(cause, faulty rotor, scenario) of `count` flights, the causes in turn."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        cause = tuple(KINDS)[number % len(KINDS)]
        frame, rotors = (("quad-x", 4), ("hexa-x", 6))[rng.integers(2)]
        faults, rotor = [], None
        if KINDS[cause]:
            kind, low, high = KINDS[cause][rng.integers(len(KINDS[cause]))]
            rotor = int(rng.integers(rotors)) + 1
            fault = {"kind": kind, "rotor": rotor, "onset_s": float(rng.uniform(28.0, 42.0))}
            faults = [fault if low is None else {**fault, "strength": float(rng.uniform(low, high))}]
        table = {
            "name": f"{cause} {number}",
            "duration_s": DURATION_S,
            "seed": int(rng.integers(1_000_000)),
            "autopilot": ("ardupilot", "px4")[rng.integers(2)],
            "airframe": {"frame": frame},
            "wind": {"speed_m_s": float(rng.choice([0.0, 3.0, 6.0])), "from_deg": float(rng.uniform(0.0, 360.0))},
            "trajectory": {"kind": str(rng.choice(["hover", "square", "figure-eight"])), "altitude_m": 8.0},
            "logging": {"esc": True, "profile": str(rng.choice(["default", "fast"]))},
            "faults": faults,
        }
        yield cause, rotor, scenario.from_table(table)


def answer(diagnosis: Diagnosis, rotor: int | None) -> str:
    """The diagnosis of the faulty rotor (of any where None), as one of ANSWERS."""
    losses = [e for e in diagnosis.events if e.means.weakens]
    suspected = [e for e in losses if rotor is None or rotor in e.suspects]
    named = [e for e in suspected if "cause" in e.extra and (rotor is None or e.rotors == (rotor,))]
    if named:
        return CAUSES[named[0].extra["cause"]]
    if suspected:
        return "ambiguous"
    notices = {e.kind for e in diagnosis.events if rotor is None or rotor in e.rotors}
    for notice, word in NOTICES.items():
        if notice in notices:
            return word
    return "other rotor" if losses or any(e.kind in NOTICES for e in diagnosis.events) else "nothing"


def confusion(count: int, seed: int, progress: Callable = lambda share: None) -> dict[str, Counter]:
    """True cause -> how many flights got each answer."""
    table = {cause: Counter() for cause in KINDS}
    for number, (cause, rotor, flown) in enumerate(flights(count, seed)):
        table[cause][answer(diagnose(simulate(flown).flight), rotor)] += 1
        progress((number + 1) / count)
    return table


def markdown(table: dict[str, Counter]) -> str:
    """The table as in docs/esc.md."""
    return tools.table(("truth", *ANSWERS), ([cause, *(row[a] or "" for a in ANSWERS)] for cause, row in table.items()))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="How often ESC telemetry names the right cause, in simulated flights.")
    parser.add_argument("--flights", type=int, default=240)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(markdown(confusion(options.flights, options.seed)))


if __name__ == "__main__":
    main()
