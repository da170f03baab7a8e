"""PX4's two checks of ESC currents, ArduPilot's thrust-loss check and our answer on the same simulated hexarotors with ESC telemetry:

    python benchmarks/current_checks.py [--flights 10]

Of each kind of fault (rotor 2, at 20 s) and of healthy flights: how many flights name rotor 2, how many another one, and how many seconds
after the onset the first right one came, the median.
"""

from __future__ import annotations

import argparse

import numpy as np

from rotorwatch import airframes, diagnose
from rotorwatch.detectors import current_residual, esc_current, thrust_loss
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch_lab.simulation import scenario, simulate

ROTOR, ONSET_S = 2, 20.0
FAULTS = {
    "healthy": None,
    "propeller lost": {"kind": "complete loss"},
    "propeller lost 40 %": {"kind": "loss", "strength": 0.4},
    "motor not driven": {"kind": "float"},
    "motor gives 40 % less": {"kind": "weak motor", "strength": 0.4},
    "stuck at 90 %": {"kind": "stuck", "level": 0.9},
    "bearing, half of its torque": {"kind": "bearing", "strength": 0.5},
}
WAYS = ("hover", "square", "figure-eight", "yaw-steps")


def flown(fault: dict | None, seed: int):
    """One flight of 60 s."""
    faults = [] if fault is None else [{"rotor": ROTOR, "onset_s": ONSET_S, **fault}]
    return simulate(
        scenario.from_table(
            {
                "duration_s": 60.0, "seed": seed, "autopilot": "px4", "airframe": {"frame": "hexa-x"}, "wind": {"speed_m_s": 3.0},
                "trajectory": {"kind": WAYS[seed % len(WAYS)]}, "logging": {"esc": True, "profile": "full"}, "faults": faults,
            }
        )
    ).flight  # fmt: skip


def named(flight) -> dict[str, list[tuple[int, float]]]:
    """Who names which rotor, and when [s]."""
    craft, air = airframes.identify(flight), airborne(flight)
    found = {
        module.name: [(one["rotor"], one["time_s"]) for one in module.detect(flight, craft, air)]
        for module in (current_residual, esc_current, thrust_loss)
    }
    sure = [e for e in diagnose(flight).events if len(e.rotors) == 1 and not e.alternatives]
    return found | {"rotorwatch": [(e.rotors[0], e.detected_s) for e in sure]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=10)
    count = parser.parse_args().flights
    print("| fault | who | names it | names another | delay |\n|---|---|---|---|---|")
    for name, fault in FAULTS.items():
        reported = [named(flown(fault, seed)) for seed in range(count)]
        for who in reported[0]:
            right = [min(t for r, t in one[who] if r == ROTOR) for one in reported if any(r == ROTOR for r, _ in one[who])]
            other = sum(any(r != ROTOR or fault is None for r, _ in one[who]) for one in reported)
            hits = "" if fault is None else f"{len(right)} of {count}"
            delay = f"{np.median(right) - ONSET_S:.1f} s" if right and fault is not None else ""
            print(f"| {name} | {who} | {hits} | {other} of {count} | {delay} |", flush=True)


if __name__ == "__main__":
    main()
