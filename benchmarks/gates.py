"""How much of the default estimator's evidence on healthy flights its other conditions let pass: the factor GATES of announcement.py.

    python benchmarks/gates.py [--flights 2000] [--seed 4977] [--jobs 1] [--keep FOLDER]

Flights of plans/open.toml whose rotors are healthy, each as its log would be. Counted, for thresholds `shift` nats higher than the one in
use: flights in which the evidence of a fault passes the threshold at an assessed tick, and how many of these are announced. Printed with
the exact 95 % interval of the share (Clopper and Pearson, Biometrika 26, 1934). The last shift is that of a factor of 1. --seed: instead of
the plan's own. --keep: what is finished; the same call goes on from there.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from math import log
from pathlib import Path

from scipy.stats import beta

from rotorwatch.engine.estimator.announcement import GATES
from rotorwatch.toolkit import ASSESS, program
from rotorwatch_lab.campaign import batch
from rotorwatch_lab.campaign.plan import read
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.experiments.studies import false_alarms

OPEN = Path(__file__).resolve().parents[1] / "plans" / "open.toml"
SHIFTS = (-4.0, -2.0, 0.0, -log(GATES))


def assessed(part: tuple[int, list[int]]) -> list[tuple[str, float, list[tuple[bool, bool]]]]:
    """(kind, assessed hours, (passed, announced) at each of SHIFTS) of these flights of one cell, with this seed."""
    seed, numbers = part
    plan, rows = replace(read(OPEN), seed=seed), []
    for flown in batch.fly(plan, numbers, batch.CPU_WIDTH):
        table, B = flown.ticks, flown.vehicle.effectiveness()
        _, out = program.estimate(table, B)
        found = []
        for shift in SHIFTS:
            passed = bool(false_alarms.crossed(table, out, shift).any())
            raised = passed and bool((out.announced if not shift else false_alarms.announced(table, flown.vehicle, shift)).any())
            found.append((passed, raised))
        kind = plan.kind(flown.number)
        rows.append((kind.name if kind else "", float((table.mode == ASSESS).sum() * table.dt / 3600.0), found))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=2000)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    plan = read(OPEN)
    plan = replace(plan, seed=plan.seed if given.seed is None else given.seed)
    parts = [
        (plan.seed, [k for k in numbers if plan.kind(k).name.startswith("healthy")])  # type: ignore
        for numbers in tools.batches(given.flights, len(plan.cells), batch.CPU_WIDTH)
    ]
    rows = tools.gathered(
        assessed, [part for part in parts if part[1]], given.jobs, keep=given.keep, progress=lambda s, _: print(f"{s:.1%}")
    )
    hours = sum(row[1] for row in rows)
    print(f"{len(rows)} healthy flights, {hours:.1f} assessed hours")
    lines = []
    for k, shift in enumerate(SHIFTS):
        passed, raised = (sum(row[2][k][j] for row in rows) for j in (0, 1))
        low, high = beta.ppf(0.025, raised, passed - raised + 1) if raised else 0.0, beta.ppf(0.975, raised + 1, max(passed - raised, 1e-9))
        lines.append([f"{shift:+g}", passed, raised, f"{raised / max(passed, 1):.3f}", f"{low:.3f} to {high:.3f}", f"{raised / hours:.3f}"])
    print(tools.table(("shift, nats", "evidence passes", "announced", "share", "95 %", "announced an hour"), lines))
    kinds = sorted({row[0] for row in rows})
    print(tools.table(("kind", "flights", *(f"passes, announced at {s:+g}" for s in SHIFTS)), [
        [kind, sum(r[0] == kind for r in rows), *(
            ", ".join(str(sum(r[2][k][j] for r in rows if r[0] == kind)) for j in (0, 1)) for k in range(len(SHIFTS))
        )] for kind in kinds
    ]))  # fmt: skip


if __name__ == "__main__":
    main()
