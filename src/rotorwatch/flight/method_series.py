"""A method's own output over a flight: losses with their covariance or set, states and innovations, step by step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

NORMAL_95 = 1.96
INTERVAL, SET = "95 % interval", "bound"
MOST_ROWS = 1000  # of a diagnosis' JSON


@dataclass(frozen=True, repr=False)
class MethodSeries:
    """T steps of one method on one plant, as the method computes them: nothing is clipped, held or decided.

    method, plant: names. says: INTERVAL, the method's covariance times 1.96, or SET, the half-widths of its set. time (T,): s of the log,
    end of each step; hop (T,): which flight of the log, from 1. theta (T, n): losses, then the plant's other parameters; theta_cov (T, n,
    n): their covariance, or the set's shape. x, x_var (T, n_x); innovation, innovation_var (T, n_y): measured less predicted, 0 without a
    measurement. status (T,): 0 fine, 1 not ready, 2 nothing measured. Names and units are the plant's. dt: s of a step. notes: the basis of
    the figures, a sentence each. made_of: name -> (values, off) (T,) of quantities derived from theta, such as the deviation of a
    helicopter's actuator. factor: by which intervals of theta are wider than the method's own, calibrated so that they hold; None: its
    own."""

    method: str
    plant: str
    says: str
    time: np.ndarray
    hop: np.ndarray
    theta: np.ndarray
    theta_cov: np.ndarray
    x: np.ndarray
    x_var: np.ndarray
    innovation: np.ndarray
    innovation_var: np.ndarray
    status: np.ndarray
    theta_names: tuple[str, ...]
    x_names: tuple[str, ...]
    x_units: tuple[str, ...]
    y_names: tuple[str, ...]
    y_units: tuple[str, ...]
    dt: float
    notes: tuple[str, ...] = ()
    made_of: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    factor: float | None = None

    @property
    def title(self) -> str:
        """'axkf on rate dynamics'."""
        return f"{self.method} on {self.plant.replace('_', ' ')}"

    @property
    def whose(self) -> str:
        """The origin of its intervals, a sentence."""
        if self.factor is not None:
            own = "half-width of its own set" if self.says == SET else "interval of its own covariance"
            return (
                f"The 95 % interval is {self.factor:.3g} times the {own}, calibrated on simulated flights with losses: it holds in flights "
                "like those (docs/estimate.md#calibrated-intervals)."
            )
        if self.says == SET:
            return f"The bound is the half-width of {self.method}'s own set: it holds while noise keeps the bounds that the set assumes."
        return f"The 95 % interval is 1.96 standard deviations of {self.method}'s own covariance."

    def off(self, variance: np.ndarray) -> np.ndarray:
        """Half-width of the interval for that variance (or squared half-width of a set)."""
        return (1.0 if self.says == SET else NORMAL_95) * np.sqrt(np.maximum(variance, 0.0))

    @property
    def theta_off(self) -> np.ndarray:
        """(T, n) half-width of the interval or bound of each loss."""
        return (1.0 if self.factor is None else self.factor) * self.off(np.diagonal(self.theta_cov, axis1=1, axis2=2))

    @property
    def lower(self) -> np.ndarray:
        """(T, n) lower end of the interval or bound."""
        return self.theta - self.theta_off

    @property
    def upper(self) -> np.ndarray:
        """(T, n) upper end."""
        return self.theta + self.theta_off

    @property
    def rotors(self) -> dict[int, int]:
        """Rotor (from 1) -> column of theta, of a plant whose losses are of rotors."""
        ends = [name.removeprefix("loss_") for name in self.theta_names]
        return {int(end): k for k, end in enumerate(ends) if end.isdigit() and self.theta_names[k] == f"loss_{end}"}

    def at(self, time: float) -> int | None:
        """The row of the last step that ended by `time` s; None before the first."""
        k = int(np.searchsorted(self.time, time, side="right")) - 1
        return k if k >= 0 else None

    def columns(self) -> dict[str, np.ndarray]:
        """Name -> (T,): the table for files. NAME_low, NAME_high: ends of the interval or bound of a loss; NAME_off: half-width of a
        state's interval, and of an innovation's by the method itself; cov_NAME_NAME: of two losses."""
        n, low, high = len(self.theta_names), self.lower, self.upper
        out = {"time_s": self.time, "hop": self.hop, "status": self.status}
        for k, name in enumerate(self.theta_names):
            out |= {name: self.theta[:, k], f"{name}_low": low[:, k], f"{name}_high": high[:, k]}
        for i in range(n):
            for j in range(i, n):
                out[f"cov_{self.theta_names[i]}_{self.theta_names[j]}"] = self.theta_cov[:, i, j]
        for prefix, names, values, off in (
            ("x", self.x_names, self.x, self.off(self.x_var)),
            ("innovation", self.y_names, self.innovation, self.off(self.innovation_var)),
        ):
            for k, name in enumerate(names):
                out |= {f"{prefix}_{name}": values[:, k], f"{prefix}_{name}_off": off[:, k]}
        for name, (values, off) in self.made_of.items():
            out |= {name: values, f"{name}_off": off}
        return out

    def to_dict(self, most: int | None = None) -> dict[str, Any]:
        """Plain data for JSON: the columns as lists, and their description. most: of rows; every k-th is then kept, and the last."""
        step = 1 if most is None else max(1, -(-len(self.time) // most))
        keep = np.unique(np.append(np.arange(0, len(self.time), step), max(len(self.time) - 1, 0)))[: len(self.time)]
        series = {
            name: [None if not np.isfinite(v) else int(v) if values.dtype.kind in "iu" else float(v) for v in values[keep]]
            for name, values in self.columns().items()
            if most is None or not name.startswith("cov_")
        }
        return {
            "method": self.method, "plant": self.plant, "says": self.says, "whose": self.whose, "step_s": self.dt, "every": step,
            "units": dict(zip(self.x_names, self.x_units)) | dict(zip(self.y_names, self.y_units)), "notes": list(self.notes),
            "series": series,
        }  # fmt: skip

    def plot(self, path=None):
        """A matplotlib figure of every loss (T,) with its interval or bound over time [s]. path: also write it there (.png, .svg, .pdf).
        Raises ConfigError where matplotlib is not installed."""
        from rotorwatch.flight.display import Panel, plot

        return plot(self.time, [Panel(f"{self.method}: loss, {self.says}", self.theta, self.theta_names, self.lower, self.upper)], path)

    def __repr__(self) -> str:
        span = f", {self.time[0]:.1f} to {self.time[-1]:.1f} s" if len(self.time) else ""
        return f"<MethodSeries of {self.title}: {len(self.time)} steps{span}>"


def joined(parts: Sequence[MethodSeries]) -> MethodSeries:
    """The hops of one flight, at least one, concatenated."""
    rows = "time hop theta theta_cov x x_var innovation innovation_var status".split()
    return replace(parts[0], **{name: np.concatenate([getattr(p, name) for p in parts]) for name in rows})
