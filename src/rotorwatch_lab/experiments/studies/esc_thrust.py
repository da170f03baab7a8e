"""Thrust from speed squared against thrust from the command, for the default method: both views of the same simulated flights.

    python -m rotorwatch_lab.experiments.studies.esc_thrust --repeats 3

The view "speed" puts k W^2 of each rotor, k learned in its first seconds in the air, where the commanded thrust stood. A motor that turns
slower than commanded cannot be seen in it. Curves: the autopilot's own, or one that is far off, which bends commands but not speeds.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import READY_S, airborne, allocation, baselines, cut_ticks, diagnose, events, program
from rotorwatch.toolkit import esc_telemetry as telemetry
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.simulation import scenario, simulate

ONSET_S, ROTOR = 35.0, 2
LEARN_S = (2.0, READY_S)  # after lift-off
LATE_S = 0.05  # telemetry is that old when it is logged, and the motor has followed its command by then
VIEWS = ("command", "speed")
CASES = (("loss", 0.1), ("loss", 0.2), ("loss", 0.3), ("weak motor", 0.2), (None, 0.0))


def thrust_of_speed(flight: Flight, vehicle: Vehicle, air) -> Signal:
    """Share of full thrust by each rotor's reported speed, scaled to the commands of its first seconds in the air."""
    commanded, esc = allocation.rotor_thrusts(flight, vehicle), flight["esc"]
    speed = telemetry.quantity(esc, "speed", commanded.values.shape[1])
    held = allocation.hold(commanded.time, commanded.values, esc.time)
    first = (esc.time > air[0][0] + LEARN_S[0]) & (esc.time < air[0][0] + LEARN_S[1])
    square = speed.values**2
    scale = np.median(held[first], axis=0) / np.median(square[first], axis=0)
    return Signal(esc.time - LATE_S, scale * square, commanded.columns, "1", "body", esc.source, speed.valid)


def assessed(flight: Flight, view: str) -> tuple[Event, ...]:
    """The default method's losses in one view of a flight."""
    vehicle, _, _ = baselines.settle(flight, None, (), diagnose)
    air, B = airborne(flight), vehicle.effectiveness()
    thrust = thrust_of_speed(flight, vehicle, air) if view == "speed" else allocation.rotor_thrusts(flight, vehicle)
    table = cut_ticks(flight, thrust, B, air, READY_S)
    _, out = program.estimate(table, B, None)
    return events.read(out, table, B)


def flown(kind: str | None, strength: float, wind: float, expo: float, autopilot: str, frame: str, seed: int) -> Flight:
    """A simulated flight with ESC telemetry; expo: of the curve that the autopilot assumes (true: 0.65)."""
    fault = {"kind": kind, "rotor": ROTOR, "onset_s": ONSET_S, "strength": strength}
    table = {
        "duration_s": 70.0,
        "seed": seed,
        "autopilot": autopilot,
        "airframe": {"frame": frame, "believed_expo": expo},
        "wind": {"speed_m_s": wind},
        "trajectory": {"kind": "square", "altitude_m": 6.0},
        "logging": {"esc": True, "profile": "fast"},
        "faults": [fault] if kind else [],
    }
    return simulate(scenario.from_table(table)).flight


def rows(repeats: int, cases: Sequence[tuple[str | None, float]] = CASES) -> list[dict]:
    """A row for each case, wind, curve and view, over both autopilots, quad and hexa and `repeats` seeds."""
    table = []
    for (kind, strength), wind, expo in itertools.product(cases, (0.0, 5.0), (0.65, 0.2)):
        cells = {view: [] for view in VIEWS}
        for autopilot, frame, seed in itertools.product(("ardupilot", "px4"), ("quad-x", "hexa-x"), range(1, repeats + 1)):
            flight = flown(kind, strength, wind, expo, autopilot, frame, seed)
            for view in VIEWS:
                cells[view].append(assessed(flight, view))
        for view, answers in cells.items():
            right = [next((e for e in answer if e.rotors == (ROTOR,)), None) for answer in answers]
            hits = [e for e in right if e is not None and kind]
            error = np.array([e.loss[0] - strength for e in hits])
            table.append(
                {
                    "fault": kind or "healthy",
                    "strength": strength,
                    "wind_m_s": wind,
                    "curve": "right" if expo == 0.65 else "wrong",
                    "view": view,
                    "flights": len(answers),
                    "found": len(hits),
                    "others": sum(len(answer) for answer in answers) - len(hits),
                    "delay_s": float(np.median([e.detected_s - ONSET_S for e in hits])) if hits else None,
                    "error_rms": float(np.sqrt(np.mean(error**2))) if hits else None,
                    "sd": float(np.median([(e.interval[0][1] - e.interval[0][0]) / 3.92 for e in hits])) if hits else None,
                }
            )
    return table


def markdown(table: Sequence[dict]) -> str:
    """The table as in docs/esc.md."""

    def cell(v: Any) -> str:
        return "–" if v is None else f"{v:.3g}" if isinstance(v, float) else str(v)

    return tools.table(tuple(table[0]), (map(cell, row.values()) for row in table))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="The default method on commanded thrust and on thrust from speed squared.")
    parser.add_argument("--repeats", type=int, default=3)
    print(markdown(rows(parser.parse_args().repeats)))


if __name__ == "__main__":
    main()
