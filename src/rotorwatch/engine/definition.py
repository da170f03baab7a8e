"""The definitions together, ready to run, and the samples of a flight in their form."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotorwatch.base import medians
from rotorwatch.base.arrays import distinct
from rotorwatch.base.compiling.running import Definition, Rows
from rotorwatch.base.compiling.shipped import files_in
from rotorwatch.engine import engine, feed
from rotorwatch.engine.drift import drift_sizes as trim_sizes
from rotorwatch.engine.drift import fit, many, outcome, stretch, time_blocks, trim, weighing
from rotorwatch.engine.estimator import (
    announcement,
    bank,
    estimator,
    evidence,
    explanations,
    hypotheses,
    kalman,
    model_error,
    noise,
    opposite,
    plant,
    plausibility,
    posterior,
)
from rotorwatch.engine.estimator import batch as estimator_whole
from rotorwatch.engine.estimator import estimator_sizes as estimator_sizes
from rotorwatch.engine.estimator import prior as estimator_prior
from rotorwatch.engine.events import calls, carried, changes, decisions, events, losses, records, reliance, texts, words
from rotorwatch.engine.intake import airborne, contact, deviations, front, mixer, planning, sense, sizes, ticks
from rotorwatch.engine.intake import craft as vehicle
from rotorwatch.engine.spin import many_ticks, rotors_off, subsets, turning
from rotorwatch.flight import Flight, Message

FRONT = (
    medians, decisions, vehicle, airborne, mixer, deviations, contact, sense, ticks, front, events, records, losses, changes, words, texts,
    reliance,
)  # fmt: skip
ESTIMATOR = (
    plant, noise, model_error, kalman, bank, hypotheses, evidence, plausibility, announcement, opposite, posterior, estimator,
)  # fmt: skip
TRIM = time_blocks, stretch, fit, weighing, outcome, trim
SPIN = subsets, rotors_off, turning
SIZES = sizes, estimator_sizes, trim_sizes
ENGINE = Definition(
    "engine",
    (
        *FRONT,
        *ESTIMATOR,
        *TRIM,
        *SPIN,
        engine,
        calls,
        estimator_whole,
        estimator_prior,
        explanations,
        many,
        many_ticks,
        planning,
        carried,
        feed,
    ),
    SIZES,
    [
        *(file for folder in ("intake", "estimator", "drift", "events", "spin") for file in files_in(f"engine/{folder}")),
        "base/medians.py",
        "engine/engine.py",
        "engine/feed.py",
    ],
    vectors=True,
)
PIECE = 1 << 15  # samples
KINDS = {
    "motors": front.OUTPUTS, "control": front.CONTROL, "gyro": front.GYRO, "accel": front.ACCEL, "velocity": front.VELOCITY,
    "state": front.STATE, "attitude": front.ATTITUDE, "voltage": front.VOLTAGE, "thrust": front.THRUSTS, "rates": front.RATES,
}  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Samples:
    """n samples in time order: kind, time [s], and the index of their numbers in `values`; NaN: unknown."""

    kind: np.ndarray
    time: np.ndarray
    at: np.ndarray
    values: np.ndarray

    def __len__(self):
        return len(self.time)

    def part(self, first: int, last: int) -> Samples:
        """Samples `first` to `last`, exclusive."""
        return Samples(self.kind[first:last], self.time[first:last], self.at[first:last], self.values)


class Part(NamedTuple):
    """Samples of one kind: name, time (n,), values (n, columns), and which of them are known, (n,) or (n, columns) bool (None: all)."""

    name: str
    time: np.ndarray
    values: np.ndarray
    valid: np.ndarray | None = None

    @staticmethod
    def of(flight: Flight, name: str, columns: int | None = None) -> Part:
        """Part from a signal; columns: only the first ones."""
        signal = flight[name]
        return Part(name, signal.time, signal.values[:, :columns], signal.valid[:, :columns])

    def rows(self, which: slice | np.ndarray) -> Part:
        """A selection of rows."""
        valid = None if self.valid is None else self.valid[which]
        return Part(self.name, self.time[which], self.values[which], valid)

    def numbers(self) -> np.ndarray:
        """The values, NaN where unknown."""
        if self.valid is None or self.valid.all():
            return self.values
        return np.where(self.valid if self.valid.ndim > 1 else self.valid[:, None], self.values, np.nan)


def pieces(parts: Iterable[Part], most: int = PIECE) -> Iterator[Samples]:
    """Like `merged`, about `most` samples at a time, to limit the memory for a long log. Samples of equal times come in one piece."""
    parts = [part for part in map(_in_order, parts) if len(part.time)]
    count = -(-sum(len(part.time) for part in parts) // most)
    if count < 2:
        yield merged(parts)
        return
    longest = max((part.time for part in parts), key=len)
    edges = distinct(longest[np.arange(1, count) * len(longest) // count])
    cuts = [[0, *np.searchsorted(part.time, edges).tolist(), len(part.time)] for part in parts]
    for k in range(len(edges) + 1):
        piece = merged(part.rows(slice(c[k], c[k + 1])) for part, c in zip(parts, cuts))
        if len(piece):
            yield piece


def _in_order(part: Part) -> Part:
    time = part.time
    return part if (time[1:] >= time[:-1]).all() else part.rows(np.argsort(time, kind="stable"))


def merged(parts: Iterable[Part]) -> Samples:
    """Samples of several signals in one order."""
    kinds, times, places, values, total = [], [], [], [], 0
    for part in parts:
        count, width = part.values.shape
        kinds.append(np.full(count, KINDS[part.name], np.int32))
        times.append(part.time)
        places.append((total + width * np.arange(count)).astype(np.int32))
        values.append(np.ascontiguousarray(part.numbers(), float).reshape(-1))
        total += count * width
    values.append(np.full(sizes.ROTORS, np.nan))  # as many as the largest kind has
    if not times:
        return Samples(np.empty(0, np.int32), np.empty(0), np.empty(0, np.int32), values[0])
    kind, time = np.concatenate(kinds), np.concatenate(times)
    order = np.lexsort((kind, time))
    return Samples(kind[order], time[order], np.concatenate(places)[order], np.concatenate(values))


def states(messages: Iterable[Message]) -> Part:
    """(n, 2): landed, armed: 1 or 0, -1: unchanged."""
    words = [(m.time, m.value > 0.5, m.kind == "armed") for m in messages if m.kind in ("landed", "armed")]
    rows = [(-1.0, float(value)) if armed else (float(value), -1.0) for _, value, armed in words]
    return Part("state", np.array([time for time, _, _ in words]), np.array(rows).reshape(-1, 2))


def craft(rotors: int, **facts: object) -> Rows:
    """A Vehicle with the known data."""
    made = ENGINE.new(vehicle.Vehicle)
    made.set(rotors=rotors, **facts)
    return made
