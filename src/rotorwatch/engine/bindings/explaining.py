"""Explanations of one change in a log, compared: engine/estimator/explanations.py on a table of ticks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rotorwatch.engine.bindings.learning import dynamics
from rotorwatch.engine.bindings.program import Learned, inputs, laid_out, parameters
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.estimator import estimator, explanations, kalman
from rotorwatch.engine.motion.tick_table import GROUND, Ticks

NEVER = 1 << 30  # a tick
FORGOTTEN = 1e-17  # share of a command that a lag has left of it: below the resolution of a number


class Explanation(NamedTuple):
    """rotors: those that lose thrust, from 0; end_s: when they have it again; grows: walk of the loss, 1 per sqrt(s). gives: standard
    deviation of a thrust that they give whatever they are commanded; late: s by which they follow their commands more slowly, instead of a
    loss; cap: most thrust that they give [hover thrusts], instead of a loss, 0: as much as commanded; turned: standard deviation of the yaw
    by their turned mounts, instead of a loss. step: standard deviation of a step of the trim of each axis, in those of this flight's
    disturbances; lifts: of thrust, too. force: factor of the disturbances; drift: of the trim in roll and pitch [hover thrusts per
    sqrt(s)], lever: by which it yaws the vehicle in a side force. push: standard deviation of each component of a torque that turns with
    the world, swells: its walk, 1 per sqrt(s); lift: thrust that it takes [hover thrusts]. load: share of the trim of roll and pitch that
    grows with all thrust."""

    rotors: tuple[int, ...] = ()
    end_s: float = np.inf
    grows: float = 0.0
    gives: float = 0.0
    late: float = 0.0
    cap: float = 0.0
    turned: float = 0.0
    step: float = 0.0
    lifts: bool = True
    force: float = 1.0
    drift: float = 0.0
    lever: float = 0.0
    load: float = 0.0
    push: float = 0.0
    swells: float = 0.0
    lift: float = 0.0


class Fit(NamedTuple):
    """log_p: evidence, relative to nothing in particular. loss, sd (n,)."""

    log_p: float
    loss: np.ndarray
    sd: np.ndarray


@dataclass(frozen=True)
class Span:
    """Ticks of one hop around a change at `onset`, an index, which may be over at `ends` [s]. width (4,): standard deviation of this
    flight's disturbances."""

    ticks: Ticks
    B: np.ndarray
    y: np.ndarray
    onset: int
    learned: Learned
    ends: tuple[float, ...] = ()

    @property
    def width(self) -> np.ndarray:
        """Standard deviation of this flight's disturbances."""
        return np.clip(3.0 * np.sqrt(self.learned.spread), 0.03, 1.0)


def lagged(ticks: Ticks, B: np.ndarray, lag_s: float) -> Ticks:
    """Ticks whose commands have passed a first-order lag of `lag_s` s: thrust_k = a thrust_k-1 + (1 - a) command_k, a = exp(-dt / lag).

    With b the terms of the commands, the sums s_m of the last m of them double: s_2m(k) = s_m(k) + a^m s_m(k - m)."""
    kept = float(np.exp(-ticks.dt / lag_s))
    thrust = (1.0 - kept) * ticks.thrust
    thrust[:1] = ticks.thrust[:1]
    length = 1
    while length < len(thrust) and kept > FORGOTTEN:
        thrust[length:] += kept * thrust[:-length].copy()
        kept, length = kept * kept, 2 * length
    return replace(ticks, thrust=thrust, wrench=thrust @ B.T)


def span(table: Ticks, B: np.ndarray, learned: Learned, onset_s: float, before_s: float, end_s: float, missing: np.ndarray) -> Span:
    """The ticks from `before_s` s before a change to `end_s`, of its hop. missing (T, n): thrust that rotors lack, which is no question
    here [hover thrusts]."""
    k = int(np.searchsorted(table.command_time, onset_s))
    starts = np.flatnonzero(table.restart)
    first = int(starts[starts <= k][-1]) if (starts <= k).any() else 0
    last = int(starts[starts > k][0]) if (starts > k).any() else len(table.time)
    rows = np.flatnonzero(table.mode[first:last] > GROUND) + first
    rows = rows[(table.command_time[rows] >= onset_s - before_s) & (table.command_time[rows] <= end_s)]
    part = table.part(rows)
    y = part.wrench - missing[rows] @ B.T
    return Span(part, B, y, int(np.searchsorted(part.command_time, onset_s)), learned)


def _free(rotors: Sequence[int], n: int) -> list[int]:
    """Three rotors, none of these where there are as many."""
    return sorted(range(n), key=lambda i: i in rotors)[:3]


def compare(where: Span, them: Sequence[Explanation]) -> list[Fit]:
    """The fit of each explanation. The first one decides how far inputs are trusted."""
    n, ticks = where.B.shape[1], where.ticks
    u, _, valid = inputs(ticks, where.B)
    plant = laid_out(parameters(where.B, ticks.dt, dynamics(where.learned, where.B)))
    for end_s in where.ends:  # known no better, as the onset
        valid = valid & ~((ticks.command_time >= end_s) & (ticks.command_time < end_s + explanations.SETTLES_S))[:, None]
    tables = np.ascontiguousarray(u, float), np.ascontiguousarray(where.y, float), np.ascontiguousarray(valid, bool)
    noise = np.ascontiguousarray(np.asarray(where.learned.variances).reshape(-1))
    time = ticks.command_time

    def tick(at_s: float) -> int:
        return int(np.searchsorted(time, at_s)) if np.isfinite(at_s) else NEVER

    rows, others = ENGINE.array(explanations.Explanation, len(them)), ENGINE.array(kalman.Branch, max(len(them) - 1, 1))
    columns = {
        name: np.array([getattr(e, name) for e in them])
        for name in ("grows", "gives", "late", "cap", "turned", "force", "drift", "lever", "load", "push", "swells", "lift")
    }
    rows.fill(
        rotors=np.array([sum(1 << i for i in e.rotors) for e in them]), end=np.array([tick(e.end_s) for e in them]),
        carriers=np.array([_free(e.rotors, n) for e in them]),
        step=np.array([e.step * where.width * (1.0, 1.0, 1.0, e.lifts) for e in them]), **columns,
    )  # fmt: skip
    state = ENGINE.new(estimator.Estimator)
    ENGINE.call(explanations.explain, plant, state, noise, len(time), *tables, where.onset, len(them), rows, others)
    fit, loss, sd = rows["fit"], rows["loss"][:, :n], np.sqrt(np.maximum(rows["variance"][:, :n], 0.0))
    return [Fit(float(fit[k]), loss[k].copy(), sd[k]) for k in range(len(them))]
