"""Closed-loop survival: flights in which an estimator drives the control allocation, compared with the truth and with no reaction.

    from rotorwatch_lab.campaign import closed_loop
    result = closed_loop.run("plans/survival.toml", ["nobody", "truth", "default"], "survival", flights=2000)

An estimate at time t depends on the log up to t only, and until the first estimate a reconfigured flight equals the unreconfigured one. So
a flight is flown without reaction, its log is estimated, the first belief is entered in the flight's schedule
(lab/simulation/reconfigured.py), the flight is flown again, and so on, belief by belief: the part before stays the same to the last bit,
and the estimators are those of `rotorwatch diagnose`.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import discovery
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.choices import meant
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch.toolkit import LEARN, attainable, program
from rotorwatch_lab.campaign import batch, methods, work
from rotorwatch_lab.campaign import plan as plans
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.campaign.score import read_columns
from rotorwatch_lab.campaign.store import Folder
from rotorwatch_lab.control import certified, spinning
from rotorwatch_lab.control.airframe import Airframe
from rotorwatch_lab.control.allocation import DRIVEN_BY, believed, rows
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.published import log_plant
from rotorwatch_lab.simulation import logbook, loop, prepare, reconfigured, trajectories
from rotorwatch_lab.simulation.scenario import Scenario

NOBODY, TRUTH = "nobody", "truth"
CERTIFIED = "certified"  # allocation by the estimate, as far as that is better for all that is possible (control/certified.py)
BY = (*DRIVEN_BY, CERTIFIED)
EXCLUDED = 0.01  # an explanation less probable than this is not possible
ENTRIES = 8  # beliefs that a flight may act on, one after the other
MOVED = 0.1  # a belief is acted on when a rotor's effectiveness is this far from what was acted on before
REFRESH_S = 0.5  # ... and no sooner after that
# Of its hover thrust, on average over so long: a rotor that is used less does not show what it has lost.
IDLE, IDLE_S = 0.3, 1.0
DELAY_S = 0.1  # from an estimate to commands that follow it
# Of a channel's authority: with less left at hover, if losses are as large as they may be, the vehicle turns.
ROOM = 0.1
TURNED = np.cos(np.radians(100.0))
ABLE_M = 5.0  # a vehicle that strays further than this before anything has happened is not up to that wind
TRACK_M, TRACK_DEG = 2.0, 20.0  # recovered: nearer than this to where it should be, and not leaning more


COLUMNS = read_columns("closed_loop")


def fly(
    flown: batch.Flights,
    flights: Sequence[int],
    driver: str = "default",
    by: str = "estimate",
    aircraft: Callable[[np.ndarray, str], reconfigured.Reconfigured] = reconfigured.Reconfigured,
) -> list[dict[str, Any]]:
    """Fly the flights with a driver: "nobody", "truth", or an estimator's name. All must be of one cell of a plan (one frame). by: basis of
    the allocation, one of BY. aircraft(B, by): the simulated aircraft. Returns for each flight its columns of
    COLUMNS. Raises ConfigError."""
    _explains(driver, by)
    scenarios = [flown.flight(k) for k in flights]
    for s in scenarios:
        if s.trajectory["land"]:
            raise ConfigError("closed loop flights end in the air: set land = false in [scenario.trajectory].")
    plans = [prepare.plan(s) for s in scenarios]
    B = rows(prepare.vehicle(scenarios[0]))
    craft = aircraft(B, "estimate" if by == CERTIFIED else by)
    n, size = B.shape[1], len(plans)
    entries: list[list[reconfigured.Entry]] = [[] for _ in plans]
    if driver == TRUTH:
        entries = [_true(s, n) for s in scenarios]
    first, records = scenarios[0], _flown(craft, scenarios[0], plans, entries, size)
    able = [_able(*row) for row in zip(scenarios, plans, records, strict=True)]
    open_, turns = list(range(size)), ENTRIES if driver not in (NOBODY, TRUTH) else 0
    for _ in range(turns):
        # A flight without a new belief stays the same, and so do its estimates.
        here = [[row[k] for k in open_] for row in (flights, scenarios, plans, records, entries)]
        new = [(k, entry) for k, entry in zip(open_, _beliefs(driver, *here, craft, by, size), strict=True) if entry]
        if not new:
            break
        open_ = [k for k, _ in new]
        for k, entry in new:
            entries[k].append(entry)
        again = _flown(craft, first, [plans[k] for k in open_], [entries[k] for k in open_], size)
        for k, record in zip(open_, again, strict=True):
            records[k] = record
    results = zip(flights, scenarios, plans, records, entries, able, strict=True)
    return [_outcome(*row) for row in results]


class Assessor(NamedTuple):
    """Makes rows of flights (`work.Assessor`), one for each driver."""

    drivers: tuple[str, ...]
    by: str = "estimate"

    def __call__(self, plan: Plan, flights: Sequence[int], size: int) -> list[dict]:
        filled = [*flights, *[flights[-1]] * (size - len(flights))]  # one program for all parts
        results = []
        for driver in self.drivers:
            for outcome in fly(plan, filled, driver, self.by)[: len(flights)]:
                planned = plan.flight(outcome["flight"])
                losses = [1.0 if f["kind"] == "complete loss" else f["strength"] for f in planned.faults]
                end = outcome["onset_s"] if outcome["faulty"] else planned.duration_s
                results.append(
                    {
                        "method": driver, "frame": planned.airframe["frame"], "rotors": plan.rotors[outcome["flight"] % len(plan.cells)],
                        "broken": len(losses), "loss": max(losses, default=0.0), "wind_m_s": planned.wind["speed_m_s"],
                        "healthy_s": min(end, outcome["lost_s"] or end), **outcome,
                    }
                )  # fmt: skip
        return results


def run(
    plan: str | os.PathLike | Plan,
    drivers: Sequence[str] = (NOBODY, TRUTH, "default"),
    out: str | os.PathLike = "closed-loop",
    flights: int = 200,
    jobs: int | None = None,
    by: str = "estimate",
    progress: work.Progress | None = None,
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Fly a plan's flights with every driver: {"plan", "flights", "drivers": {driver: measures}}, also in out/summary.json.

    Finished parts are kept in the folder `out`: the same call resumes an interrupted run. Measures (`measures`) have 95 % intervals.
    jobs, scheduler: as for `work.run`. Raises ConfigError.
    """
    planned = plan if isinstance(plan, Plan) else plans.read(plan)
    if not drivers:
        raise ConfigError("Name at least one driver: nobody, truth, or an estimator.")
    for driver in drivers:
        if driver not in (NOBODY, TRUTH):
            discovery.estimator(driver)
    if by not in BY:
        raise ConfigError(f"by must be one of {', '.join(BY)}, not {by}{meant(by, BY)}.")
    for driver in drivers:
        _explains(driver, by)
    entered = replace(planned, text=f"{planned.text}\n# closed loop: {', '.join(drivers)}; by {by}\n")
    table = work.run(entered, flights, out, jobs, progress, Assessor(tuple(drivers), by), COLUMNS, scheduler)
    rows = table.to_pylist()
    lost = {d: {r["flight"]: r["lost_s"] for r in rows if r["method"] == d} for d in (TRUTH, NOBODY)}
    result = {
        "plan": planned.name,
        "flights": flights,
        "by": by,
        "drivers": {d: measures([r for r in rows if r["method"] == d], lost[TRUTH], lost[NOBODY]) for d in drivers},
    }
    Folder(out, COLUMNS).finish(table, result)
    return result


def measures(rows: Sequence[dict], truth: Mapping[int, float | None], nobody: Mapping[int, float | None]) -> dict[str, Any]:
    """Measures of one driver's rows; truth, nobody: when each flight was lost with those drivers (None: never). survived: share of faulty
    flights; of_possible: share of those that knowing the truth saves, of_able: of those among them whose vehicle, healthy, keeps to its
    track; lost_healthy: flights without a fault that were lost; false_h: flights in which it acted falsely, per healthy hour; lost_false:
    how many of those were lost, and not (or later) with nobody, lost_false_able: of able vehicles; healthy_h; first_s, recovered_s,
    tilt_deg, off_m: medians of faulty flights; by_frame, possible_by_frame: survived and of_possible, by frame."""
    faulty = [r for r in rows if r["faulty"]]
    healthy = [r for r in rows if not r["faulty"]]
    possible = [r for r in faulty if r["flight"] in truth and truth[r["flight"]] is None]
    harmed = [r for r in rows if r["false"] and r["lost_s"] is not None and r["lost_s"] < (nobody.get(r["flight"]) or np.inf)]

    def survived(some: Sequence[dict]) -> dict[str, float] | None:
        return tools.share([r["survived"] for r in some])

    def median(key: str) -> dict[str, float] | None:
        return tools.boot([r[key] for r in faulty if r[key] is not None], np.median)

    hours, frames = sum(r["healthy_s"] for r in rows) / 3600.0, sorted({r["frame"] for r in rows})
    return {
        "faulty": len(faulty), "healthy": len(healthy), "survived": survived(faulty), "of_possible": survived(possible),
        "of_able": survived([r for r in possible if r["able"]]), "able": sum(r["able"] for r in rows),
        "lost_healthy": sum(not r["survived"] for r in healthy), "healthy_h": hours,
        "lost_false": len(harmed), "lost_false_able": sum(r["able"] for r in harmed),
        "false_h": tools.rate(sum(r["false"] for r in rows), hours),
        "right": tools.share([r["right"] for r in faulty if r["beliefs"]]),
        **{key: median(key) for key in ("first_s", "recovered_s", "tilt_deg", "off_m")},
        "by_frame": {f: survived([r for r in faulty if r["frame"] == f]) for f in frames},
        "possible_by_frame": {f: survived([r for r in possible if r["frame"] == f]) for f in frames},
    }  # fmt: skip


def markdown(result: dict[str, Any]) -> str:
    """The drivers side by side, and survival by frame."""
    cell, drivers = tools.interval, result["drivers"]
    lines = {
        "faulty, healthy flights": lambda m: f"{m['faulty']}, {m['healthy']}",
        "survived": lambda m: cell(m["survived"]),
        "... of those that the truth saves": lambda m: cell(m["of_possible"]),
        "... and whose vehicle, healthy, keeps to its track": lambda m: cell(m["of_able"]),
        "healthy flights lost": lambda m: str(m["lost_healthy"]),
        "healthy hours": lambda m: f"{m['healthy_h']:.1f}",
        "acted falsely, flights an hour": lambda m: cell(m["false_h"], 2),
        "lost by that, of able vehicles": lambda m: f"{m['lost_false']}, {m['lost_false_able']}",
        "first acted on the broken rotors": lambda m: cell(m["right"]),
        "first acted after, s": lambda m: cell(m["first_s"], 2),
        "on track again after, s": lambda m: cell(m["recovered_s"], 2),
        "largest tilt, degrees": lambda m: cell(m["tilt_deg"], 2),
        "largest distance from the track, m": lambda m: cell(m["off_m"], 2),
    }
    for f in sorted({f for m in drivers.values() for f in m["by_frame"]}):
        lines[f"survived, {f}"] = lambda m, f=f: cell(m["by_frame"].get(f))
    return tools.side_by_side(f"{result['plan']}, {result['flights']} flights", drivers, lines)


def _flown(craft, first: Scenario, plans: list, entries: list, size: int) -> list[Any]:
    """The records of plans with these entries."""
    n = craft.allocator.B.shape[1]
    ready = [p._replace(schedule=reconfigured.schedule(n, m, ENTRIES)) for p, m in zip(plans, entries, strict=True)]
    return list(loop.fly_each(craft, ready, first.duration_s, first.rate_hz, first.record_hz, logbook.needed, size))


def _true(scenario: Scenario, n: int) -> list[reconfigured.Entry]:
    """Entries of a driver that knows every lasting loss, DELAY_S after its onset."""
    e, entries = np.ones(n), []
    for fault in sorted(scenario.faults, key=lambda f: f["onset_s"]):
        if fault["kind"] not in ("loss", "complete loss"):
            raise ConfigError(f"closed loop flights know losses and complete losses, not {fault['kind']}.")
        e = e.copy()
        e[fault["rotor"] - 1] = 0.0 if fault["kind"] == "complete loss" else 1.0 - fault["strength"]
        entries.append(_entry(scenario, fault["onset_s"] + DELAY_S, e, e, e))
    return entries


def _explains(driver: str, by: str) -> None:
    """Raise ConfigError for drivers without alternative explanations."""
    if by == "posterior" and driver not in (NOBODY, TRUTH, "default"):
        raise ConfigError(
            f"{driver} has one explanation at a time: with the allocation driven by a posterior name nobody, truth or default."
        )


def _entry(scenario: Scenario, since: float, mean, lower, upper, candidates=None, weights=None) -> reconfigured.Entry:
    """The schedule entry for that belief from `since` on: allocation, or a turning hover where full control of hover is lost."""
    bare = replace(scenario, airframe={**scenario.airframe, "payload_kg": 0.0})  # the autopilot knows of no payload
    frame = Airframe.of(prepare.plan(bare).craft)
    half = np.abs(frame.B).sum(axis=1) / 2.0
    hover = gains = None
    if attainable.margins(frame.B * lower, frame.mass * G0, half).depth < ROOM:
        hover = spinning.relaxed_hover(frame, mean)
        gains = spinning.design(frame, hover) if hover else None
    held = hover if gains else None
    return reconfigured.entry(len(mean), since, mean, lower, upper, held, gains, candidates, weights)


def _beliefs(driver: str, flights, scenarios, plans, records, entries, craft, by: str, size: int) -> list[reconfigured.Entry | None]:
    """The next entry of each flight, or None."""
    seen = [batch.prepared(*row) for row in zip(flights, scenarios, plans, records, strict=True)]
    here = [k for k, f in enumerate(seen) if f is not None]
    flown = [f for f in seen if f is not None]
    if not flown:
        return [None] * len(seen)
    B = flown[0].vehicle.effectiveness()
    if driver == "default":
        outputs = [estimate.out for estimate in batch.by_default(flown, whole=True)]
    else:
        tables = [f.ticks for f in flown]
        hops = [log_plant.hops(table, B) for table in tables]
        outputs = methods.assess(driver, tables, hops, B, size, ((),))[0]
    beliefs: list[reconfigured.Entry | None] = [None] * len(seen)
    for k, f, out in zip(here, flown, outputs, strict=True):
        certify = _certifier(craft, plans[k], out, entries[k]) if by == CERTIFIED else None
        beliefs[k] = _next(scenarios[k], f.ticks, out, entries[k], by, certify)
    return beliefs


def _certifier(craft, plan, out: program.TickOutput, entries: list[reconfigured.Entry]) -> Callable[..., np.ndarray | None]:
    """(tick, mean, lower, upper) -> the effectiveness (n,) that may be acted on, or None."""
    allocator, commands = craft.allocator, _commands(craft)
    demand = allocator.B @ np.full(allocator.n, float(plan.pilot.hover))
    before = entries[-1].mean if entries else np.ones(allocator.n)
    old = commands(demand, believed(before))

    def certify(k: int, mean, lower, upper) -> np.ndarray | None:
        others = np.where(out.active[k] > 0, 1.0 - out.each[k], 1.0)[np.asarray(out.share[k]) > EXCLUDED]
        possible = certified.possible(mean, lower, upper, others)
        for step in certified.STEPS:
            e = upper + step * (mean - upper)
            if np.abs(e - before).max() > MOVED and certified.is_better(allocator, demand, old, commands(demand, believed(e)), possible):
                return e
        return None

    return certify


@functools.cache
def _commands(craft) -> Callable[..., np.ndarray]:
    """(demand (4,), belief) -> commands (n,) of its allocator, compiled."""
    allocator = craft.allocator
    return load_jax().jit(lambda demand, belief: allocator.step(allocator.init(), demand, belief)[1].u)


def _next(
    scenario: Scenario,
    ticks,
    out: program.TickOutput,
    entries: list[reconfigured.Entry],
    by: str,
    certify: Callable[..., np.ndarray | None] | None = None,
) -> reconfigured.Entry | None:
    """The first belief after the last entry that is far enough from it, as far as `certify` (`_certifier`) lets it be acted on. Where the
    vehicle has to turn, its hover is that of the mean."""
    if len(entries) == ENTRIES:
        return None
    weak = np.asarray(out.active[:, 0], bool)
    mean = np.where(weak, 1.0 - np.clip(out.theta, 0.0, 1.0), 1.0)
    apart = np.where(weak, 2.0 * out.theta_sd, 0.0)
    since = ticks.time + DELAY_S
    before, last_s = (entries[-1].mean, float(entries[-1].since)) if entries else (np.ones(weak.shape[1]), -np.inf)
    # Allocation that leaves a rotor alone hides its loss: that it has recovered is believed when it is used again.
    idle = np.cumsum(ticks.thrust, axis=0)
    n = max(1, round(IDLE_S / ticks.dt))
    idle = (idle - np.concatenate([np.zeros_like(idle[:n]), idle[:-n]])) / n < IDLE
    mean = np.where(idle, np.minimum(mean, before), mean)
    candidates = weights = None
    expected, awaited = mean, before
    if by == "posterior":  # what counts is what the explanations expect together
        candidates, weights = np.where(out.active > 0, 1.0 - out.each, 1.0), np.asarray(out.share)
        awaited = entries[-1].weights @ entries[-1].candidates if entries else before
        expected = np.einsum("tk,tkn->tn", weights, candidates)
        stays = idle & (expected > awaited)
        expected = np.where(stays, awaited, expected)
        candidates = np.where(stays[:, None], awaited, candidates)
    due = (np.abs(expected - awaited).max(axis=1) > MOVED) & (since > last_s + REFRESH_S) & (ticks.mode > LEARN)
    low, high = np.clip(mean - apart, 0.0, 1.0), np.clip(mean + apart, 0.0, 1.0)
    for k in np.flatnonzero(due):
        acted = certify(k, mean[k], low[k], high[k]) if certify else mean[k]
        if acted is not None:
            others = (candidates[k], weights[k]) if candidates is not None and weights is not None else ()
            made = _entry(scenario, float(since[k]), mean[k], low[k], high[k], *others)
            return made if made.turning > 0.5 else made._replace(mean=acted)
    return None


@functools.cache
def _setpoints():
    """`trajectories.table`, compiled."""
    return load_jax().jit(trajectories.table, static_argnums=(1, 2))


def _off(plan, record) -> np.ndarray:
    """(T,) distance from the setpoint [m]."""
    return np.linalg.norm(record.p - np.asarray(_setpoints()(plan.way, len(record.time), float(record.time[0])).p), axis=1)


def _flying(record) -> np.ndarray:
    """(T,) True once it has left the ground."""
    return np.maximum.accumulate(-record.p[:, 2] > 1.0)


def _able(scenario: Scenario, plan, record) -> bool:
    """True if the vehicle, healthy, keeps to its track in a flight without schedule entries."""
    until = min((f["onset_s"] for f in scenario.faults), default=np.inf)
    return bool(_off(plan, record)[_flying(record) & (record.time < until)].max(initial=0.0) < ABLE_M)


def _outcome(number: int, scenario: Scenario, plan, record, entries: list[reconfigured.Entry], able: bool) -> dict:
    """Outcome of a flight, see COLUMNS; first_s of healthy flights counts from the take-off."""
    faults = scenario.faults
    onset = min((f["onset_s"] for f in faults), default=float(plan.way.take_off))
    broken = {f["rotor"] - 1 for f in faults}
    time, height = record.time, -record.p[:, 2]
    upright = 1.0 - 2.0 * (record.q[:, 1] ** 2 + record.q[:, 2] ** 2)
    flying = _flying(record)
    down = flying & ((height < 0.15) | (upright < TURNED) | (record.flies < 0.5))
    lost = float(time[np.argmax(down)]) if down.any() else None
    off = _off(plan, record)
    tilt = np.degrees(np.arccos(np.clip(upright, -1.0, 1.0)))
    late = flying & (time > onset)
    astray = np.flatnonzero(late & ((off > TRACK_M) | (tilt > TRACK_DEG)))
    recovered = None
    if lost is None and (not astray.size or astray[-1] < len(time) - 1):
        recovered = float(time[astray[-1]] - onset) if astray.size else 0.0
    # What came too late, after the crash, was never acted on.
    acted = [m for m in entries if lost is None or m.since < lost]
    accused = set(np.flatnonzero(acted[0].mean < 1.0 - MOVED).tolist()) if acted else set()
    first = float(acted[0].since) if acted else None
    early = first is not None and (first < onset or not accused & broken)
    return {
        "flight": number, "faulty": bool(faults), "onset_s": onset, "able": able, "survived": lost is None, "lost_s": lost,
        "beliefs": len(acted), "first_s": None if first is None else first - onset,
        "false": early if faults else first is not None, "right": bool(acted) and accused == broken,
        "turning": any(m.turning > 0.5 for m in acted), "tilt_deg": float(tilt[late].max(initial=0.0)),
        "off_m": float(off[late].max(initial=0.0)), "recovered_s": recovered,
    }  # fmt: skip
