"""How much the drag of unequal rotors yaws a vehicle in wind (engine/estimator/plant.py, `DRAG`), from flights without a loss.

    python benchmarks/rotor_drag.py LOG...

Commanded yaw is regressed on what `estimator.plant.drag` says for DRAG = 1, on angular acceleration and on the rate of yaw: all without
their means over five seconds, in means of half a second. Printed with two standard deviations; the last row is the weighted mean. The side
force holds noise and the drag of the body, so that the result is rather too small than too large.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from rotorwatch import airframes, logs
from rotorwatch.engine.bindings import program
from rotorwatch.engine.driver import observe
from rotorwatch.engine.estimator.plant import DRAG
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.tick_table import GROUND, READY_S
from rotorwatch.errors import RotorwatchError
from rotorwatch_lab.experiments import limits

MEAN_S, BLOCK_S, LEAST_S, TURNS = 5.0, 0.5, 30.0, 3.0


def measured(table, B) -> tuple[float, float, float] | None:
    """Drag, its standard deviation and the seconds assessed; None where less than LEAST_S can be assessed or no side force is measured."""
    u, y, valid = program.inputs(table, B)
    n, block = B.shape[1], round(BLOCK_S / table.dt)
    flown = (table.mode > GROUND) & valid[:, 2] & (np.abs(table.rate).max(axis=1) < TURNS)
    if table.side is None or not block or flown.sum() * table.dt < LEAST_S:
        return None
    drag = limits.balance(u, program.steps(table.dt, B).plant)[1].sum(axis=1) / DRAG
    window = np.ones(round(MEAN_S / table.dt)) / round(MEAN_S / table.dt)
    rows = [x - np.convolve(x, window, "same") for x in (y[:, 2], -drag, u[:, n + 2], u[:, n + 6])]
    blocks = np.stack(rows)[:, flown][:, : flown.sum() // block * block]
    yaw, *inputs = blocks.reshape(4, -1, block).mean(axis=2)
    X = np.stack(inputs, axis=1)
    weights = np.linalg.lstsq(X, yaw, rcond=None)[0]
    covariance = np.linalg.pinv(X.T @ X) * np.var(yaw - X @ weights)
    return float(weights[0]), float(np.sqrt(covariance[0, 0])), float(flown.sum() * table.dt)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path)
    found = []
    print("| log | assessed, s | drag |\n|---|---|---|")
    for path in parser.parse_args().logs:
        try:
            flight = logs.read(path)
            vehicle = airframes.identify(flight)
        except RotorwatchError as why:
            print(f"| {path.name} | | {why} |")
            continue
        table = observe(flight, vehicle, airborne(flight), READY_S)
        one = None if table is None else measured(table, vehicle.effectiveness())
        if one is not None:
            found.append(one[:2])
            print(f"| {path.name} | {one[2]:.0f} | {one[0]:.1f} ± {2 * one[1]:.1f} |", flush=True)
    if found:
        value, sd = np.transpose(found)
        weight = sd**-2.0
        print(f"| all | | {weight @ value / weight.sum():.1f} ± {2.0 / np.sqrt(weight.sum()):.1f} |")


if __name__ == "__main__":
    main()
