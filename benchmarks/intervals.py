"""Measure how often every method's interval or set holds the losses, and calibrate them: writes published/conformal.csv of the laboratory
and the table of docs/estimate.md.

    python benchmarks/intervals.py --keep FOLDER [--flights 384] [--methods ekf,axkf] [--frames quad-x,hexa-x] [--jobs 1]

Flights of plans/intervals.toml, up to a loss of control, without the SETTLED_S after an onset. Factors are made of every second round of
all frames and autopilots; the table counts the other flights. FOLDER keeps what is finished: the same call goes on from there, and a larger
--flights adds to it. --methods, --frames: only these; the others' factors stay as they are. The table is of this call's. The default has a
loss or none, which no factor makes up for: it is measured when named, but its rows do not belong into the file.
"""

from __future__ import annotations

import argparse
import csv
import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rotorwatch.base import discovery
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import batch
from rotorwatch_lab.campaign.plan import read
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.published import conformal, log_plant, published

ROOT = Path(__file__).resolve().parents[1]
PLAN, PAGE = ROOT / "plans" / "intervals.toml", ROOT / "docs" / "estimate.md"
BEGIN, END = "<!-- calibrated: benchmarks/intervals.py -->\n", "<!-- end of what is calibrated -->\n"
SETTLED_S = 2.0
KEPT = np.linspace(0.0, 1.0, 101)  # quantiles of a flight's scores
ALL = "all"


class Scored(NamedTuple):
    """A method on a flight. scores: quantiles KEPT of its steps' scores (`conformal.scores`); half_width: median."""

    method: str
    flight: int
    kind: str
    rotors: int
    step_s: float
    scores: np.ndarray
    half_width: float


def measured(part: tuple[str, list[int]]) -> list[Scored]:
    """One method on flights of one cell."""
    method, numbers = part
    found = []
    for f in _flown(tuple(numbers)):
        B, time, kind = f.vehicle.effectiveness(), f.ticks.time, read(PLAN).kind(f.number)
        hops = log_plant.hops(f.ticks, B)
        if not hops or kind is None:
            continue
        try:
            series = published.default(f.ticks, B) if method == "default" else published.itself(method, f.ticks, B, hops)
        except ConfigError:
            return []  # not defined for this plant
        true, use = f.theta[np.searchsorted(time, series.time)], (series.status == 0) & (series.time < (f.lost_s or np.inf))
        use &= series.time >= time[hops[0].rows[0]]  # the same steps for all methods
        for fault in f.scenario.faults:
            use &= (series.time < fault["onset_s"]) | (series.time > fault["onset_s"] + SETTLED_S)
        if use.any():
            some = np.quantile(conformal.scores(series, true)[use], KEPT, method="higher")
            found.append(
                Scored(method, f.number, kind.name, B.shape[1], round(series.dt, 6), some, float(np.median(series.theta_off[use])))
            )
    return found


@functools.lru_cache(maxsize=1)
def _flown(numbers: tuple[int, ...]) -> list[batch.Flown]:
    return batch.fly(read(PLAN), numbers, len(numbers))


def calibrating(flight: int, cells: int) -> bool:
    """Whether the factors are made of this flight, or the table."""
    return flight // cells % 2 == 0


def made(rows: list[Scored], cells: int) -> dict[tuple[str, int, float], tuple[int, float]]:
    """(method, rotors, step) -> flights, factor."""
    groups: dict[tuple[str, int, float], list[np.ndarray]] = {}
    for row in rows:
        if calibrating(row.flight, cells):
            groups.setdefault((row.method, row.rotors, row.step_s), []).append(row.scores)
    found = {key: (len(some), conformal.factor(some)) for key, some in groups.items()}
    return {key: value for key, value in sorted(found.items()) if np.isfinite(value[1])}


def table(rows: list[Scored], factors: dict, cells: int) -> str:
    """Method x kind: per cent of the steps, mean over flights that made no factor, in which all losses are held, plain and calibrated."""
    tested = [r for r in rows if not calibrating(r.flight, cells) and (r.method, r.rotors, r.step_s) in factors]
    kinds = [ALL, *(k.name for k in read(PLAN).kinds)]
    lines = []
    for method in dict.fromkeys(r.method for r in tested):
        mine = [(r, factors[r.method, r.rotors, r.step_s][1]) for r in tested if r.method == method]
        cells_ = []
        for kind in kinds:
            held = [(np.mean(r.scores <= 1.0), np.mean(r.scores <= c)) for r, c in mine if kind in (ALL, r.kind)]
            cells_.append(", ".join(f"{100 * share:.0f}" for share in np.mean(held, axis=0)) if held else "-")
        wide = np.mean([(r.half_width, r.half_width * c) for r, c in mine], axis=0)
        lines.append([f"`{method}`", *cells_, ", ".join(f"{w:.2f}" for w in wide)])
    flights = {r.flight: r.kind for r in tested}
    counts = [sum(kind in (ALL, k) for k in flights.values()) for kind in kinds]
    heads = ("method", *(f"{kind} ({count})" for kind, count in zip(kinds, counts)), "half-width")
    return tools.table(heads, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, required=True)
    parser.add_argument("--flights", type=int, default=384)
    parser.add_argument("--methods", default="")
    parser.add_argument("--frames", default="quad-x,hexa-x,octa-x")
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    plan = read(PLAN)
    cells = len(plan.cells)
    names = given.methods.split(",") if given.methods else [n for n in discovery.estimators() if n != "default"]
    width = 8 * cells  # flights of a part: eight of each cell, whatever their number
    parts = [
        (name, list(range(first + cell, min(first + width, given.flights), cells)))
        for cell in range(cells) if plan.cells[cell].frame in given.frames.split(",")
        for first in range(0, given.flights, width) for name in names
    ]  # fmt: skip
    rows = tools.gathered(measured, [p for p in parts if p[1]], given.jobs, lambda s, _: print(f"{s:.1%}", flush=True), keep=given.keep)
    factors = made(rows, cells)
    old = [row for row in csv.reader(conformal.FACTORS.open()) if row[0] != "method"] if conformal.FACTORS.exists() else []
    old = [row for row in old if (row[0], int(row[1]), float(row[2])) not in factors]
    new = [[*key[:2], f"{key[2]:g}", count, f"{value:.4g}"] for key, (count, value) in factors.items()]
    with open(conformal.FACTORS, "w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [("method", "rotors", "step_s", "flights", "factor"), *sorted(old + new, key=lambda row: tuple(map(str, row)))]
        )
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page[: page.index(BEGIN) + len(BEGIN)] + table(rows, factors, cells) + "\n" + page[page.index(END) :], encoding="utf-8")
    print(table(rows, factors, cells))


if __name__ == "__main__":
    main()
