"""Comparison of all estimators on the same flights, the default method among them.

Each flight becomes ticks once. The default method assesses them on its own plant, a published one as `published.assess` runs it;
events are read the same way from both. Per estimator and group of flights:

    loss_rmse      of the faulty rotors from 2 s after the onset on, 0 where nothing was announced
    delay_s        median of onset to the first event that names the rotor
    right          share of faults whose first event names exactly these rotors;  named: or names them among alternatives
    false_alarms_h events before the onset or of other rotors, per hour assessed
    coverage       share of right events whose 95 % interval holds the loss
    p              of Wilcoxon's signed-rank test in pairs: mean error of all rotors' losses in each BLOCK_S of assessed flight against that
                   of the first in the table; small where the two differ by more than chance. Blocks are taken as independent
    us_per_step    microseconds of one step of a quad in a compiled scan, best of three
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import discovery
from rotorwatch.errors import ConfigError
from rotorwatch.toolkit import ASSESS, Estimated, estimated, program
from rotorwatch_lab.compiling.run import chosen, run
from rotorwatch_lab.experiments import counting, tools
from rotorwatch_lab.experiments.studies.compare_flights import Scene
from rotorwatch_lab.published import decide, published

SETTLED_S = 2.0
BLOCK_S = 5.0  # longer than errors hang together: memories and settling times are a second or two
LEAST_BLOCKS = 6  # fewer cannot be significant
PAPERS = ("aesmf", "atsukf", "axkf", "intermediate", "mh_lyapunov")  # the methods that the five papers propose
STEPS = 4096
SHORT = {"loss_rmse": "loss RMSE", "right": "right", "false_alarms": "false alarms", "coverage": "coverage"}
COLUMNS = ("flights", "faults", "loss_rmse", "delay_s", "right", "named", "false_alarms_h", "coverage")


class Compared(NamedTuple):
    """Results of one estimator on all flights. rows: group of flights -> measures; us_per_step; why: reason why it could not run, a
    sentence, else empty; blocks: group -> mean error of the losses in each BLOCK_S of its flights."""

    name: str
    rows: dict[str, dict[str, Any]]
    us_per_step: float
    why: str = ""
    blocks: dict[str, list[float]] | None = None


def compare(scenes: Sequence[Scene], names: Sequence[str] = (), progress: Callable | None = None) -> dict[str, Any]:
    """{"groups": {group: {estimator: measures}}, "us_per_step": {estimator: float}, "failed": {estimator: sentence}}.

    scenes: groups of flights, as `compare_flights` makes them. names: estimators, all of them when empty. progress: called with the
    finished share. Raises ConfigError for an unknown one, or no flights.
    """
    return gathered(scenes, list(each(scenes, names, progress)))


def each(scenes: Sequence[Scene], names: Sequence[str] = (), progress: Callable | None = None) -> Iterator[Compared]:
    """Estimators one by one, as soon as each has seen all flights. Arguments and errors as of `compare`."""
    if not scenes:
        raise ConfigError("There is no flight to compare estimators on.")
    names = known(names)
    for k, name in enumerate(names):
        trials: dict[str, list] = {s.group: [] for s in scenes}
        try:
            for i, scene in enumerate(scenes):
                trials[scene.group].append(_trial(name, scene))
                if progress:
                    progress((k + (i + 1) / len(scenes)) / len(names), name)
            speed = microseconds(name, scenes)
        except ConfigError as why:
            yield Compared(discovery.title(name), {}, float("nan"), str(why))
            continue
        blocks = {group: [error for trial in of for error in trial["blocks"]] for group, of in trials.items()}
        yield Compared(discovery.title(name), {group: _row(of) for group, of in trials.items()}, speed, "", blocks)


def known(names: Sequence[str]) -> list[str]:
    """The estimators of these names, all of them when empty. Raises ConfigError for an unknown one."""
    for name in names:
        discovery.estimator(name)
    return list(names) or list(discovery.estimators())


def gathered(scenes: Sequence[Scene], compared: Sequence[Compared]) -> dict[str, Any]:
    """Result of `compare` for these estimators."""
    groups: dict[str, dict] = {s.group: {} for s in scenes}
    blocks = {result.name: result.blocks or {} for result in compared}
    for result in compared:
        for group, row in result.rows.items():
            groups[group][result.name] = dict(row)
    for group, rows in groups.items():
        for name in (order := _ordered(rows)):
            rows[name]["p"] = paired(*(blocks[one].get(group, []) for one in (order[0], name))) if name != order[0] else None
    return {
        "groups": groups, "us_per_step": {result.name: result.us_per_step for result in compared if not result.why},
        "failed": {result.name: result.why for result in compared if result.why},
    }  # fmt: skip


def paired(first: Sequence[float], other: Sequence[float]) -> float | None:
    """p of Wilcoxon's signed-rank test of errors block by block; None with fewer than LEAST_BLOCKS."""
    from scipy.stats import wilcoxon

    if len(first) != len(other) or len(first) < LEAST_BLOCKS:
        return None
    difference = np.subtract(other, first)
    tested: Any = wilcoxon(difference) if difference.any() else None
    return float(tested.pvalue) if tested else 1.0


def _ordered(rows: dict[str, dict[str, Any]]) -> list[str]:
    """Estimators, the smallest loss RMSE first; those that announced nothing false before others."""
    return sorted(rows, key=lambda name: (rows[name]["loss_rmse"] or 0.0, rows[name]["false_alarms"]))


def line(result: Compared) -> str:
    """An estimator's measures in a line, for progress output."""
    if result.why:
        return f"{result.name}: {result.why}"
    parts = []
    for group, row in result.rows.items():
        measures = ((words, cell(key, row[key])) for key, words in SHORT.items() if row[key] is not None)
        parts.append(f"{group}: {', '.join(f'{words} {value}' for words, value in measures)}")
    return f"{result.name}: {'; '.join(parts)}"


def _trial(name: str, scene: Scene) -> dict:
    """Outcome of one flight."""
    table = scene.ticks
    if name == "default":
        estimate = estimated(scene.ready)
    else:
        out, _ = published.assess(name, table, scene.B, hops=scene.hops)
        estimate = Estimated(table, out, default=False, own_limit=decide.LIMIT)
    raised, out = counting.alarms(scene.ready.by(estimate).answer().end.events), estimate.out
    assessing = table.mode == ASSESS
    rotors = tuple(sorted(r for r, _, _ in scene.faults))
    onset = min((t for _, t, _ in scene.faults), default=np.inf)
    counted = counting.count(raised, rotors, onset)
    trial: dict[str, Any] = {
        "assessed_s": float(assessing.sum() * table.dt), "fault": bool(scene.faults),
        "false_alarms": len(counted.false) + len(counted.wrong), "blocks": _blocks(scene, out.theta, assessing & ~table.upset),
    }  # fmt: skip
    if not scene.faults:
        return trial
    late = assessing & (table.time > onset + SETTLED_S) & ~table.upset
    error = np.concatenate([out.theta[late, r - 1] - loss for r, _, loss in scene.faults])
    trial["square"] = float(np.mean(error**2)) if error.size else None
    if counted.found:
        (_, (own, *_), event), loss = counted.own[0], {r: v for r, _, v in scene.faults}
        trial |= {"delay_s": counted.delay_s, "right": counted.right, "named": counted.named}
        if own == rotors and event is not None and event.loss:
            trial["covered"] = all(lo <= loss[r] <= hi for r, (lo, hi) in zip(event.rotors, event.interval))
    return trial


def _blocks(scene: Scene, theta: np.ndarray, assessed: np.ndarray) -> list[float]:
    """Mean absolute error of the losses theta (T, n) in each BLOCK_S of the assessed ticks (T,); a block without any is left out. The
    SETTLED_S after an onset do not count: they are the delay's."""
    time, true = scene.ticks.time, np.zeros(theta.shape)
    for rotor, onset, loss in scene.faults:
        true[time >= onset, rotor - 1] = loss
        assessed = assessed & ~((time >= onset) & (time < onset + SETTLED_S))
    block = np.floor(time / BLOCK_S)
    error = np.abs(theta - true).mean(axis=1)
    return [float(error[here].mean()) for k in np.unique(block[assessed]) if (here := assessed & (block == k)).any()]


def _row(trials: list[dict]) -> dict:
    """Row of the table: all flights of one group."""
    faulty = [t for t in trials if t["fault"]]
    delays = [t["delay_s"] for t in faulty if "delay_s" in t]
    squares = [t["square"] for t in faulty if t["square"] is not None]
    covered = [t["covered"] for t in faulty if "covered" in t]
    hours = sum(t["assessed_s"] for t in trials) / 3600.0

    def share(key):
        return float(np.mean([t.get(key, False) for t in faulty])) if faulty else None

    return {
        "flights": len(trials), "faults": len(faulty),
        "loss_rmse": float(np.sqrt(np.mean(squares))) if squares else None,
        "delay_s": float(np.median(delays)) if delays else None,
        "right": share("right"), "named": share("named"),
        "false_alarms": sum(t["false_alarms"] for t in trials),
        "false_alarms_h": sum(t["false_alarms"] for t in trials) / hours if hours else None,
        "coverage": float(np.mean(covered)) if covered else None,
    }  # fmt: skip


def _theta(out):
    return getattr(out, "estimate", out).theta


def microseconds(name: str, scenes: Sequence[Scene]) -> float:
    """Microseconds of one step over a table of STEPS rows, compiled before, best of three; of the scene with the fewest rotors."""
    return min(timings(name, scenes, 3))


def timings(name: str, scenes: Sequence[Scene], repeats: int) -> list[float]:
    """Time of one step as in `microseconds` [us], for each of so many repeats; NaN for a published method where no scene has a hop to
    evaluate."""
    scene = min(scenes, key=lambda s: s.B.shape[1])
    if name == "default":
        table, B = scene.ticks, scene.B
        u, y, valid = program.inputs(table, B)
        u[:, -1] = 0.0  # a flight repeated is no new flight
        rows = _repeated(u, y, valid)
        return _timed(lambda: program.steps(table.dt, B).run(*rows), repeats)
    if not scene.hops:
        return [float("nan")] * repeats
    hop = scene.hops[0]
    estimator = published.method(name, hop.system, hop.dt)
    rows = _repeated(hop.u, hop.y, hop.valid)
    return _timed(lambda: run(estimator, *rows, select=_theta, backend=chosen(None, "auto")), repeats)


def _repeated(u, y, valid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = np.arange(STEPS) % len(u)
    return u[rows], y[rows], valid[rows]


def _timed(go: Callable, repeats: int) -> list[float]:
    go()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        go()
        times.append(1e6 * (time.perf_counter() - began) / STEPS)
    return times


def cell(key: str, value: Any) -> str:
    """A measure as text."""
    if value is None:
        return "-"
    if key in ("flights", "faults", "false_alarms"):
        return str(value)
    if key in ("right", "named", "coverage"):
        return f"{100 * value:.0f} %"
    if key == "p":
        return f"{value:.3f}" if value >= 0.001 else "< 0.001"
    digits = {"false_alarms_h": 0, "us_per_step": 0, "loss_rmse": 3}.get(key, 2)
    return f"{value:.{digits}f}"


def markdown(result: dict[str, Any], form: Callable = tools.table) -> str:
    """The tables in Markdown, or as `form` (heads, rows) writes one, best loss first, one for each group of flights."""
    heads = ("estimator", "loss RMSE", "p", "delay, s", "right", "named", "false alarms/h", "coverage", "us a step")
    keys = ("loss_rmse", "p", "delay_s", "right", "named", "false_alarms_h", "coverage")
    parts = []
    for group, rows in result["groups"].items():
        count = next(iter(rows.values()), {"flights": 0, "faults": 0})
        sign = "##" if form is tools.table else "%"
        flights = f"{count['flights']} flights, {count['faults']} with a fault; p: paired test of the errors against the first."
        parts.append(f"\n{sign} {group[0].upper()}{group[1:]}\n\n{flights if form is tools.table else '% ' + flights}\n")
        order = _ordered(rows)
        cost = {name: cell("us_per_step", result["us_per_step"].get(name)) for name in order}
        parts.append(form(heads, ([f"`{n}`", *(cell(k, rows[n].get(k)) for k in keys), cost[n]] for n in order)))
    for name, why in result["failed"].items():
        parts.append(f"\n`{name}`: {why}")
    return "\n".join(parts) + "\n"
