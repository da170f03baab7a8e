"""One batch of a campaign: flights of one cell flown, logged, turned into ticks and judged, side by side where that is possible.

What the default diagnoser does with a log happens here with the same functions - the log as the autopilot writes it, the airframe
found in it, airborne parts, thrusts, ticks, estimator, events - but without a file in between and with all flights of the batch
in one compiled scan.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes, default_estimator, detectors, limits, published
from rotorwatch.airborne import airborne
from rotorwatch.backend import jax as load_jax
from rotorwatch.campaign import score
from rotorwatch.campaign.plan import Plan
from rotorwatch.diagnose import READY_S, _explained, _overrides, observe
from rotorwatch.diagnosis import Event
from rotorwatch.errors import ConfigError
from rotorwatch.evidence import events, hypotheses
from rotorwatch.flight import Flight
from rotorwatch.simulation import logbook, one, simulate_batch
from rotorwatch.simulation import plan as flight_plan
from rotorwatch.simulation.scenario import Scenario
from rotorwatch.ticks import GROUND, LAG_S, Ticks
from rotorwatch.vehicle import Vehicle

TICK_BLOCK = (
    100  # tables are padded to a multiple of this, so that a flight's few ticks more or less need no other program
)
CPU_WIDTH, ACCELERATOR_WIDTH = 32, 1024
CACHE_BYTES = (
    2_500_000  # of the estimators' states that a processor keeps at hand: larger batches are slower, not faster
)


def width() -> int:
    """Flights in a batch: what fits a processor's cache, or fills an accelerator where JAX has found one."""
    return CPU_WIDTH if load_jax().default_backend() == "cpu" else ACCELERATOR_WIDTH


def side_by_side(carry: Any, size: int) -> int:
    """How many of `size` flights (a power of two) the estimator with this state steps at once."""
    tree = load_jax().tree
    each = sum(np.asarray(leaf).nbytes for leaf in tree.leaves(carry))
    if load_jax().default_backend() == "cpu":
        while size > 1 and size % 2 == 0 and size * each > CACHE_BYTES:
            size //= 2
    return size


@dataclass(frozen=True)
class Flown:
    """One flight on its way through the batch. theta (T, n): true losses at its ticks; lost_s: when it crashed, or None."""

    number: int
    scenario: Scenario
    flight: Flight
    vehicle: Vehicle
    air: tuple[tuple[float, float], ...]
    ticks: Ticks
    theta: np.ndarray
    lost_s: float | None


class Judged(NamedTuple):
    """What is kept of every tick: the default estimator's outputs, and whether its best hypothesis was plausible."""

    kept: default_estimator.Kept
    plausible: Any


def judge(plan: Plan, flights: Sequence[int], size: int) -> list[dict]:
    """Rows of results (score.py), one per flight and method. All flights must be of one cell; `size`: width that the batch is
    filled up to, always the same, so that a flight's result does not depend on who it flew with."""
    flown = fly(plan, flights, size)
    if not flown:
        return []
    B = flown[0].vehicle.effectiveness()
    if any(not np.array_equal(f.vehicle.effectiveness(), B) for f in flown):
        raise ConfigError("flights of one batch must have the same geometry; name the frame by a choice.")
    hyp, rows = hypotheses.make(B.shape[1]), []
    bounds = _bounds(flown, B, size)
    if "default" in plan.estimators:
        for f, bound, out in zip(flown, bounds, _default(flown, B, size), strict=True):
            seen = _all_events(f, events.read(out.kept, f.ticks, hyp, B))
            statistic = np.where(out.plausible, out.kept.statistic, score.NOTHING)
            rows.append(score.estimator("default", f, out.kept, statistic, seen, bound, plan))
    for name in plan.estimators:
        if name == "default":
            continue
        for f, bound in zip(flown, bounds, strict=True):
            kept = published.judge(name, f.ticks, B)
            seen = _all_events(f, events.read(kept, f.ticks, hyp, B))
            rows.append(score.estimator(name, f, kept, kept.statistic, seen, bound, plan))
    rules = {m.name: m for m in detectors.modules() if m.name in plan.detectors}
    for name in plan.detectors:
        for f, bound in zip(flown, bounds, strict=True):
            rows.append(score.rule(name, f, rules[name].detect(f.flight, f.vehicle, f.air), bound, plan))
    return rows


def fly(plan: Plan, flights: Sequence[int], size: int) -> list[Flown]:
    """Simulate the flights and look at them as `diagnose` looks at a log. Flights that never take off are left out."""
    scenarios = [plan.flight(k) for k in flights]
    filled = [*scenarios, *[scenarios[-1]] * (size - len(scenarios))]
    records = load_jax().tree.map(np.asarray, simulate_batch(filled, _needed))
    found = []
    for k, (number, scenario) in enumerate(zip(flights, scenarios, strict=True)):
        record = one(records, k)
        flight = logbook.flight(scenario, flight_plan(scenario), record)
        vehicle = airframes.identify(flight)
        air = airborne(flight)
        table = observe(flight, vehicle, air, READY_S)
        if table is None:
            continue
        # A tick's motion is a lag after its commands: that is when a loss shows in it.
        at = np.clip(np.searchsorted(record.time, table.command_time + LAG_S), 0, len(record.time) - 1)
        lost = np.flatnonzero(record.flies < 0.5)
        found.append(
            Flown(
                number, scenario, flight, vehicle, air, table, record.theta[at],
                float(record.time[lost[0]]) if lost.size else None,
            )
        )  # fmt: skip
    return found


def _all_events(f: Flown, losses: Sequence[Event]) -> tuple[Event, ...]:
    """Losses, and outputs that do not follow the mixer, as `diagnose` puts them together."""
    overrides = _overrides(f.flight, f.vehicle, f.air)
    overridden = {e.rotors[0]: e for e in overrides}
    found = [e for e in losses if not _explained(e, overridden)]
    return tuple(sorted((*found, *overrides), key=lambda e: e.detected_s))


def _needed(record):
    """What a log and the truth need of a record: much less memory than all of it."""
    return record._replace(omega=(), rates_asked=(), q_asked=(), wind=())


def _padded(table: Ticks, B: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from rotorwatch.systems.wrench_balance import WrenchBalance

    u = np.column_stack([WrenchBalance(B).pack(table), table.mode, table.restart])
    more = length - len(u)

    def fill(a):
        return np.concatenate([a, np.zeros((more, *a.shape[1:]), a.dtype)])

    return fill(u), fill(table.wrench), fill(table.valid)


def _stacked(flown: Sequence[Flown], B: np.ndarray, size: int):
    """u, y, valid of all flights: (size, T, ...), filled up with the last flight and with ticks on the ground."""
    longest = max(len(f.ticks.time) for f in flown)
    length = -(-longest // TICK_BLOCK) * TICK_BLOCK
    tables = [_padded(f.ticks, B, length) for f in flown]
    tables += [tables[-1]] * (size - len(tables))
    return tuple(np.stack(parts) for parts in zip(*tables, strict=True))


@functools.lru_cache(maxsize=8)
def _program(build):
    """Compiled: parameters, first carry, u, y, valid (flights first) -> stacked `Judged`."""
    jax = load_jax()

    def single(parameters, carry, u, y, valid):
        estimator = build(parameters)

        def step(carry, row):
            carry, out = estimator.step(carry, *row)
            return carry, Judged(default_estimator._keep(out), out.plausible)

        return jax.lax.scan(step, carry, (u, y, valid))[1]

    return jax.jit(jax.vmap(single, in_axes=(None, None, 0, 0, 0)))


def _default(flown: Sequence[Flown], B: np.ndarray, size: int) -> list[Judged]:
    """The default estimator over every flight, side by side."""
    dt = flown[0].ticks.dt
    if dt not in (0.05, 0.1):
        raise ConfigError(f"commands every {dt:.1f} s are too slow: log motor outputs at 10 Hz or faster.")
    build = default_estimator._build_fast if dt < 0.08 else default_estimator._build_slow
    tree, parameters = load_jax().tree, default_estimator.parameters(B)
    carry, rows, found = build(parameters).init(), _stacked(flown, B, size), []
    step = side_by_side(carry, size)
    for start in range(0, len(flown), step):
        out = _program(build)(parameters, carry, *(a[start : start + step] for a in rows))
        out = tree.map(np.asarray, out)
        for k, f in enumerate(flown[start : start + step]):
            found.append(tree.map(lambda a, k=k, f=f: a[k, : len(f.ticks.time)], out))
    return found


def _bounds(flown: Sequence[Flown], B: np.ndarray, size: int) -> list[np.ndarray | None]:
    """(T,) information on the broken rotor's loss (limits.py) for each flight in which one rotor loses thrust at once, else None."""
    clear = [score.clear_fault(f.scenario) for f in flown]
    if not any(clear):
        return [None] * len(flown)
    u, y, valid = _stacked(flown, B, size)
    length = u.shape[1]
    theta = np.stack([np.concatenate([f.theta, np.zeros((length - len(f.theta), B.shape[1]))]) for f in flown])
    rotor = [c["rotor"] - 1 if c else 0 for c in clear]
    onset = [np.searchsorted(f.ticks.command_time + LAG_S, c["onset_s"]) if c else length for f, c in zip(flown, clear)]
    more = size - len(flown)
    theta = np.concatenate([theta, np.repeat(theta[-1:], more, axis=0)])
    found = limits.on_ticks(
        B, u[..., :-2], y, valid, u[..., -2] > GROUND, theta, np.array(rotor + rotor[-1:] * more),
        np.array(onset + onset[-1:] * more), flown[0].ticks.dt, batch=True,
    )  # fmt: skip
    return [found.information[k, : len(f.ticks.time)] if clear[k] else None for k, f in enumerate(flown)]
