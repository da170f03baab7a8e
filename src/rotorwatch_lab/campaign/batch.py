"""A batch of a campaign: flights of one cell simulated, logged, turned into ticks and diagnosed, side by side where possible.

The simulator's log, in memory, goes through `diagnose` (`prepare`, `estimated`, `Case.answer`); only published methods run over all
flights of a batch at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np

from rotorwatch import detectors, logs
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import GROUND, LAG_S, Case, Estimated, Ticks, estimated, events, prepare, program
from rotorwatch_lab.campaign import methods, score
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.experiments import counting, limits
from rotorwatch_lab.published import decide, log_plant
from rotorwatch_lab.simulation import logbook
from rotorwatch_lab.simulation import plan as flight_plan
from rotorwatch_lab.simulation.loop import fly_each
from rotorwatch_lab.simulation.multirotor import MULTIROTOR
from rotorwatch_lab.simulation.scenario import Scenario

CPU_WIDTH, ACCELERATOR_WIDTH = 32, 1024


def width() -> int:
    """Flights in a batch: what fits a processor's cache, or fills an accelerator where JAX has found one."""
    return CPU_WIDTH if load_jax().default_backend() == "cpu" else ACCELERATOR_WIDTH


def where() -> str:
    """Which device JAX has found, and how many flights it takes at once, in words."""
    jax = load_jax()
    kind, devices = jax.default_backend(), jax.devices()
    name = "the processor" if kind == "cpu" else f"{len(devices)} x {devices[0].device_kind}"
    return f"on {name}, {width()} flights side by side{', estimators as native code' if methods.engine() == 'native' else ''}"


@dataclass(frozen=True)
class Flown:
    """A flight in a batch. ready: input of `diagnose` before the estimator; theta (T, n): true losses at its ticks; lost_s: time of its
    crash, or None."""

    number: int
    scenario: Scenario
    ready: Case
    theta: np.ndarray
    lost_s: float | None = None

    @property
    def flight(self) -> Flight:
        """Its log."""
        return self.ready.flight

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle identified from the log."""
        return self.ready.vehicle

    @property
    def ticks(self) -> Ticks:
        """Its ticks."""
        return cast(Ticks, self.ready.table)


def assess(plan: Plan, flights: Sequence[int], size: int) -> list[dict]:
    """Rows of results (score.py), one per flight and method. All flights must be of one cell; `size`: width that the batch is filled up to,
    always the same, so that a flight's result does not depend on the other flights of its batch."""
    flown = fly(plan, flights, size)
    return rows(plan, flown, size) if flown else []


def rows(plan: Plan, flown: Sequence[Flown], size: int, failed: Callable[[str, Exception], None] | None = None) -> list[dict]:
    """Rows of results of flights that have the same geometry and length of a tick. failed: called for a published estimator or a rule that
    raises, which then has no rows; None: it raises."""
    B = flown[0].vehicle.effectiveness()
    if any(not np.array_equal(f.vehicle.effectiveness(), B) for f in flown):
        raise ConfigError("flights of one batch must have the same geometry; name the frame by a choice.")
    results = []
    bounds = _bounds(flown, B, size)
    published = [name for name in plan.estimators if name != "default"]

    def row(label: str, f: Flown, estimate: Estimated, statistic, bound) -> dict:
        end = f.ready.by(estimate).answer().end
        raised = counting.alarms(end.events)
        results = score.estimator(label, f, estimate.out, statistic, raised, bound, plan, unasked(raised))
        return results | (score.answer(end) if estimate.default else {})

    if "default" in plan.estimators:
        for f, bound, estimate in zip(flown, bounds, by_default(flown), strict=True):
            statistic = np.where(estimate.out.plausible, estimate.out.statistic, score.NOTHING)
            results.append(row("default", f, estimate, statistic, bound))
    if published:
        tables = [f.ticks for f in flown]
        hops = [log_plant.hops(table, B) for table in tables]
        for name in published:
            with _caught(name, failed):
                outputs = methods.assess(name, tables, hops, B, size, tuple(d.tuning for d in plan.decisions))
                for decision, kept in zip(plan.decisions, outputs, strict=True):
                    label = decision.label(name)
                    results += [
                        row(label, f, Estimated(f.ticks, k, default=False, own_limit=decide.LIMIT), k.statistic, b)
                        for f, k, b in zip(flown, kept, bounds, strict=True)
                    ]
    rules = {m.name: m for m in detectors.modules() if m.name in plan.detectors}
    for name in plan.detectors:
        with _caught(name, failed):
            seen = [rules[name].detect(f.flight, f.vehicle, f.ready.air) for f in flown]
            results += [score.rule(name, f, s, bound, plan) for f, s, bound in zip(flown, seen, bounds, strict=True)]
    return results


@contextmanager
def _caught(name: str, failed: Callable[[str, Exception], None] | None) -> Iterator[None]:
    """Passes exceptions of a method to `failed`, where given."""
    try:
        yield
    except Exception as why:
        if failed is None:
            raise
        failed(name, why)


class Flights(Protocol):
    """Source of flights: a plan, or a study's own."""

    def flight(self, k: int) -> Scenario:
        """The scenario of flight k."""
        ...


def fly(plan: Flights, flights: Sequence[int], size: int) -> list[Flown]:
    """Simulate the flights and prepare them as `diagnose` prepares a log. Flights that never take off are left out."""
    return [f for row in simulated(plan, flights, size) if (f := prepared(*row)) is not None]


def simulated(plan: Flights, flights: Sequence[int], size: int) -> Iterator[tuple[int, Scenario, Any, Any]]:
    """(number, scenario, plan, record) of each flight; size: width that the batch is filled up to."""
    scenarios = [plan.flight(k) for k in flights]
    plans = [_planned(k, scenario) for k, scenario in zip(flights, scenarios, strict=True)]
    first = scenarios[0]
    records = fly_each(MULTIROTOR, plans, first.duration_s, first.rate_hz, first.record_hz, logbook.needed, size)
    return zip(flights, scenarios, plans, records, strict=True)


def logged(number: int, scenario: Scenario, plan: Any, record: Any) -> Flight:
    """A flight of `simulated` as it is read from the log file that its autopilot would write. Raises LogError."""
    suffix = next(suffix for suffix, autopilot in logbook.SUFFIXES.items() if autopilot == scenario.autopilot)
    return logs.from_bytes(logbook.log(scenario, plan, record), f"flight-{number}{suffix}")


def prepared(number: int, scenario: Scenario, plan: Any, record: Any) -> Flown | None:
    """A simulated flight as `diagnose` prepares a log; None if it never took off."""
    ready = prepare(logbook.flight(scenario, plan, record))
    if ready.table is None:
        return None
    # A tick's motion is a lag after its commands: that is when a loss shows in it.
    at = np.clip(np.searchsorted(record.time, ready.table.command_time + LAG_S), 0, len(record.time) - 1)
    lost = np.flatnonzero(record.flies < 0.5)
    return Flown(number, scenario, ready, record.theta[at], float(record.time[lost[0]]) if lost.size else None)


def _planned(number: int, scenario: Scenario) -> Any:
    """The flight's numbers. Raises ConfigError that names the flight: draws may be too much only together."""
    try:
        return flight_plan(scenario)
    except ConfigError as error:
        raise ConfigError(f"flight {number}: {error}") from error


def unasked(raised: Sequence[counting.Alarm]) -> list[float]:
    """Times [s] of alarms from sources other than an estimator: outputs, losses of control, hindsight. They have no threshold."""
    return [a.detected_s for a in raised if a.event is not None and a.event.source.name != events.ESTIMATOR.name]


def by_default(flown: Sequence[Flown], whole: bool = False) -> list[Estimated]:
    """Every flight through the default estimator, as `diagnose` does it; whole: as of `estimated`."""
    return [estimated(f.ready, whole=whole) for f in flown]


def _bounds(flown: Sequence[Flown], B: np.ndarray, size: int) -> list[np.ndarray | None]:
    """(T,) information on the loss of the broken rotor (limits.py) for each flight in which one rotor loses thrust at once, else None."""
    clear = [score.clear_fault(f.scenario) if np.isfinite(f.theta).all() else None for f in flown]
    if not any(clear):
        return [None] * len(flown)
    u, y, valid = methods.stacked([program.inputs(f.ticks, B) for f in flown], size)
    length = u.shape[1]
    theta = np.stack([np.concatenate([np.nan_to_num(f.theta), np.zeros((length - len(f.theta), B.shape[1]))]) for f in flown])
    rotor = [c["rotor"] - 1 if c else 0 for c in clear]
    onset = [np.searchsorted(f.ticks.command_time + LAG_S, c["onset_s"]) if c else length for f, c in zip(flown, clear)]
    padding = size - len(flown)
    theta = np.concatenate([theta, np.repeat(theta[-1:], padding, axis=0)])
    bound = limits.on_ticks(
        B, u[..., :-2], y, valid, u[..., -2] > GROUND, theta, np.array(rotor + rotor[-1:] * padding),
        np.array(onset + onset[-1:] * padding), flown[0].ticks.dt, batch=True,
    )  # fmt: skip
    return [bound.information[k, : len(f.ticks.time)] if clear[k] else None for k, f in enumerate(flown)]
