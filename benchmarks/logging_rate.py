"""What the rate of the log allows on real noise: real logs of 50 to 2,000 Hz, thinned, and how soon a loss could be seen in each.

    python benchmarks/logging_rate.py ../flights/*.BFL.xz log171.bin.xz

All signals of a log are thinned to the same rate: samples are left out, not averaged, as an autopilot that logs at this rate leaves them
out. Beside each stands what no diagnoser can do better that sees the same ticks, knows rotor and onset and raises one false alarm in ten
hours (experiments/limits.py): the median over rotors and onsets of the least delay for losses of 20 and 30 %, and the least standard
deviation of a loss ten seconds after its onset. Roll, pitch and yaw only, so that logs with and without accelerations compare; ticks in
which the vehicle turns faster than TURNS are left out. The table is in docs/limits.md.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from rotorwatch import airframes, logs
from rotorwatch.engine.bindings import program
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.tick_table import ASSESS, GROUND, READY_S
from rotorwatch_lab.experiments import limits

RATES_HZ = (10.0, 25.0, 50.0, 100.0, 400.0, 1000.0)
LOSSES, AFTER_S, PERIOD_S = (0.2, 0.3), 10.0, 36_000.0
TURNS, LEAST_S, ONSETS = 3.0, 20.0, 4  # rad/s; seconds assessed; onsets spread over the flight


def thinned(flight, rates: dict[str, float]):
    """The flight with these signals only, each at its rate [Hz] at most: samples are left out."""

    def thin(signal, hz):
        if signal.rate_hz <= 1.05 * hz:
            return signal
        keep = np.unique(np.searchsorted(signal.time, np.arange(signal.time[0], signal.time[-1], 1.0 / hz)))
        return signal.with_arrays(signal.time[keep], signal.values[keep], signal.valid[keep])

    return replace(flight, signals={name: thin(flight.signals[name], hz) for name, hz in rates.items()})


def measured(flight, vehicle, air) -> dict | None:
    """What the ticks of a flight allow: least delays of LOSSES and least standard deviation; None where too little can be assessed."""
    table = observe(flight, vehicle, air, READY_S)
    if table is None:
        return None
    calm = (table.mode > GROUND) & (np.abs(table.rate).max(axis=1) < TURNS)
    table = replace(table, mode=np.where(calm, ASSESS, table.mode), upset=np.zeros_like(table.upset))
    B = vehicle.effectiveness()
    u, y, valid = program.inputs(table, B)
    valid = valid & calm[:, None] & np.array([True, True, True, False])
    seen = np.flatnonzero(valid[:, 0])
    if len(seen) * table.dt < LEAST_S:
        return None
    delays: dict[float, list[float]] = {loss: [] for loss in LOSSES}
    sds = []
    for onset in seen[(np.linspace(0.3, 0.7, ONSETS) * len(seen)).astype(int)]:
        for rotor in range(B.shape[1]):
            known = limits.on_ticks(
                B, u[:, :-2], y, valid, table.mode > GROUND, np.zeros((len(u), B.shape[1])), rotor, int(onset), table.dt
            ).information
            after = np.searchsorted(np.cumsum(valid[onset:, 0]) * table.dt, AFTER_S) + onset
            sds.append(float(limits.loss_sd(known[min(after, len(known) - 1)])))
            assessed = np.concatenate([np.zeros(onset), np.cumsum(valid[onset:, 0])]) * table.dt
            for loss in LOSSES:
                delays[loss].append(limits.delay(assessed, known, loss, 0.0, PERIOD_S))
    return {"assessed": len(seen) * table.dt, "sd": float(np.median(sds)), **{k: float(np.median(v)) for k, v in delays.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path)
    options = parser.parse_args()
    rates = [f"{hz:g} Hz" for hz in RATES_HZ]
    print(f"| log | assessed, s | | {' | '.join(rates)} |\n|---|---|---|{'---|' * len(rates)}")
    for path in options.logs:
        flight = logs.read(path)
        vehicle = airframes.identify(flight)
        air = airborne(flight)
        most = flight["motors"].rate_hz
        every = (thinned(flight, dict.fromkeys(flight.signals, hz)) if hz <= 1.1 * most else None for hz in RATES_HZ)
        found = [None if thin is None else measured(thin, vehicle, air) for thin in every]
        if not any(found):
            continue
        name, assessed = path.name.split(".")[0], max(one["assessed"] for one in found if one)
        lines = [(f"{loss:.0%} seen after, s", [f"{one[loss]:.1f}" if one else "" for one in found]) for loss in LOSSES]
        lines.append(("error after 10 s", [f"{one['sd']:.3f}" if one else "" for one in found]))
        for k, (what, cells) in enumerate(lines):
            first = f"{name} | {assessed:.0f}" if k == 0 else " | "
            print(f"| {first} | {what} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
