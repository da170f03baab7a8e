"""The default estimator made runnable: its definition (engine/estimator/), built from arrays and run over ticks."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rotorwatch.base.compiling import running
from rotorwatch.core import Array
from rotorwatch.engine.bindings.hypothesis_list import Hypotheses
from rotorwatch.engine.bindings.plant_rows import any_air, any_multirotor, lower_rotors, packed
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.estimator import announcement, batch, estimator, estimator_sizes, noise, plant
from rotorwatch.engine.estimator.hypotheses import hypothesis_count
from rotorwatch.engine.estimator.plant import AIR, SHARE, Plant
from rotorwatch.engine.estimator.posterior import PLACES
from rotorwatch.engine.events.decisions import FALSE_ALARM_PERIOD_S
from rotorwatch.engine.motion.tick_table import AGAIN, TICKS_S, Ticks
from rotorwatch.errors import ConfigError

PIECE = 256  # ticks in one call


class TickOutput(NamedTuple):
    """Outputs of T ticks; `engine.estimator.Result` describes them, with the shapes of one tick."""

    theta: Array
    theta_sd: Array
    innovation: Array
    innovation_var: Array
    log_odds: Array
    statistic: Array
    best: Array
    onset: Array
    probability: Array
    announced: Array
    onsets: Array
    active: Array
    each: Array
    share: Array
    gives: Array
    detectable: Array
    biases: Array
    plausible: Array
    pushed: Array


def blank(T: int, hyp: Hypotheses) -> TickOutput:
    """T ticks without evidence; fields that only the default method uses stay so."""
    n, n_h = hyp.n, len(hyp.names)
    numbers = {
        "theta": (n,), "theta_sd": (n,), "innovation": (4,), "biases": (4,), "onset": (), "onsets": (PLACES,),
        "share": (PLACES,), "gives": (n,), "each": (PLACES, n),
    }  # fmt: skip
    flags = {"announced": (), "active": (PLACES, n)}
    filled = {k: np.zeros((T, *size)) for k, size in numbers.items()} | {
        "innovation_var": np.ones((T, 4)), "log_odds": np.full((T, n_h), -50.0), "statistic": np.full(T, -50.0),
        "best": np.zeros(T, int), "probability": np.full((T, n_h), 1.0 / n_h), "detectable": np.ones((T, n)),
        "plausible": np.ones(T, bool), "pushed": np.zeros(T, bool),
    } | {k: np.zeros((T, *size), bool) for k, size in flags.items()}  # fmt: skip
    return TickOutput(**{name: filled[name] for name in TickOutput._fields})


class Learned(NamedTuple):
    """Present estimate: state s = [x; theta] of the leading explanation, its covariance, and the variances of the noise (4 components, 4
    axes)."""

    s: Array
    P: Array
    variances: Array

    @property
    def spread(self) -> np.ndarray:
        """(4,) variance of everything but white noise over ten seconds: the size of this aircraft's disturbances (`Noise.spread`)."""
        return self.variances[1] + self.variances[2] + 5.0 * self.variances[3]


def inputs(table: Ticks, B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u (T, n + 15), y (T, 4), valid (T, 4) of the estimator over ticks. u: `plant.packed`, mode, and restart: 1 at the first tick of a
    hop, AGAIN at a contact."""
    again = table.restart if table.contact is None else np.where(table.contact, AGAIN, table.restart)
    return np.column_stack([packed(table, B.shape[1]), table.mode, again]), table.wrench, table.valid


def parameters(B: np.ndarray, dt: float, dynamics=None) -> dict:
    """The arrays that the estimator is built from: geometry B (4, n), length of a tick dt [s], and the result of `learn` or the prior of
    any multirotor; on coaxial frames the lower rotors and the prior of their share. Raises ConfigError for other ticks."""
    lower, coaxial = lower_rotors(B), {}
    if lower is not None:
        coaxial = {"lower": lower, "share": np.array((dynamics or {}).get("share", [0.0, plant.SHARE_SD**2]), float)}
    if dt not in TICKS_S:
        lengths = ", ".join(f"{t:g}" for t in TICKS_S)
        raise ConfigError(f"The default estimator has no ticks of {dt:g} s; it has {lengths}.")
    known = dynamics or {}
    air = np.array(known["air"] if "air" in known else any_air(), float)
    arrays = {"B": B, "dt": np.array(dt), "air": air, **coaxial}
    if dynamics:
        return {**arrays, **{k: np.array(dynamics[k], float) for k in ("x0", "P0", "noise", "noise_weight")}}
    mean, P = any_multirotor(B.shape[1])
    return {
        **arrays,
        "x0": mean,
        "P0": P,
        "noise": np.tile(np.array(noise.GENERIC)[:, None], (1, 4)),
        "noise_weight": np.array(noise.GENERIC_WEIGHT),
    }


def threshold(n: int, dt: float) -> float:
    """Threshold [nats] of the evidence of all faults of n rotors for an announcement, in ticks of dt seconds."""
    vehicle = Plant()
    vehicle.rotors, vehicle.dt = n, dt
    return announcement.threshold(vehicle, announcement.GATES * FALSE_ALARM_PERIOD_S)


def estimate(table: Ticks, B: np.ndarray, dynamics=None, progress: Callable[[float], object] | None = None):
    """Run the default estimator over ticks: (`Learned`, `TickOutput` stacked). Raises ConfigError for ticks of an unknown length."""
    made = steps(table.dt, B, dynamics)
    out = made.run(*inputs(table, B), progress)
    return made.learned, out


def steps(dt: float, B: np.ndarray, dynamics=None) -> Steps:
    """The default estimator for ticks of dt seconds, continued as ticks come; `inputs` makes its rows. Raises ConfigError."""
    return Steps(parameters(B, dt, dynamics))


class Steps:
    """The default estimator of one vehicle, stepped as ticks come."""

    def __init__(self, parameters: dict):
        self.plant, self.state = laid_out(parameters), ENGINE.new(estimator.Estimator)
        self.rotors = np.shape(parameters["B"])[1]
        self._room = ENGINE.array(estimator.Result, PIECE)
        ENGINE.call(batch.begin, self.plant, self.state)

    def raise_threshold(self, nats: float) -> None:
        """Raise the threshold of announcements by so much from now on."""
        alarm = self.state.part("alarm")
        alarm.set(limit=float(alarm["limit"][0]) + nats)

    @property
    def learned(self) -> Learned:
        """Present estimate."""
        return learned(self.state, self.rotors)

    def run(self, u: np.ndarray, y: np.ndarray, valid: np.ndarray, progress=None) -> TickOutput:
        """Step over the rows u (T, n + 15), y and valid (T, 4); the stacked outputs. progress: called with the finished share, 0..1."""
        tables = [np.ascontiguousarray(u, float), np.ascontiguousarray(y, float), np.ascontiguousarray(valid, bool)]
        parts = []
        for first in range(0, max(len(u), 1), PIECE):
            rows = [table[first : first + PIECE] for table in tables]
            count = len(rows[0])
            ENGINE.call(batch.run, self.plant, self.state, count, *rows, self._room)
            parts.append(outputs(self._room, count, self.rotors))
            if progress and len(u):
                progress(min(1.0, (first + PIECE) / len(u)))
        return parts[0] if len(parts) == 1 else TickOutput(*map(np.concatenate, zip(*parts, strict=True)))


def square(kept: np.ndarray, n: int) -> np.ndarray:
    """Symmetric matrices (..., n, n) from the definitions' storage: row by row, each up to its diagonal."""
    rows, columns = np.tril_indices(n)
    found = np.empty((*kept.shape[:-1], n, n))
    found[..., rows, columns] = found[..., columns, rows] = kept[..., : len(rows)]
    return found


def learned(state: running.Rows, rotors: int) -> Learned:
    """Present estimate."""
    states = estimator_sizes.PLANT_STATES + rotors
    leader = state.part("branches").part("all")
    s, P = leader["s"][0, :states], square(leader["P"][0], states)
    return Learned(s.copy(), P.copy(), state.part("noise")["v"][0].copy())


def outputs(results: running.Rows, count: int, rotors: int) -> TickOutput:
    """The first of these results, of a vehicle with so many rotors."""
    return TickOutput(**{name: results[name][:count][fitting].copy() for name, fitting in _outputs(rotors)})


@functools.cache
def _outputs(rotors: int) -> list[tuple[str, tuple[slice, ...]]]:
    """(name, used length for a vehicle with so many rotors) of each output of a tick, of many ticks."""
    fitting = {estimator_sizes.ROTORS: rotors, estimator_sizes.HYPOTHESES: hypothesis_count(rotors)}
    kinds = ENGINE.type_of(estimator.Result)
    return [(name, tuple(slice(0, size) for size in (None, *(fitting.get(k, k) for k in kinds[name].shape)))) for name in kinds.names or ()]


def laid_out(parameters: dict) -> running.Rows:
    """A Plant of `parameters`, not yet completed."""
    B, lower = np.asarray(parameters["B"], float), parameters.get("lower")
    mean, variance = np.zeros(estimator_sizes.PLANT_STATES), np.zeros((estimator_sizes.PLANT_STATES, estimator_sizes.PLANT_STATES))
    mean[:AIR], variance[:AIR, :AIR] = parameters["x0"], parameters["P0"]
    more = {AIR: parameters["air"], **({} if lower is None else {SHARE: parameters["share"]})}
    for state, (m, v) in more.items():
        mean[state], variance[state, state] = m, v
    made = ENGINE.new(Plant)
    made.set(
        rotors=B.shape[1], dt=float(parameters["dt"]), effect=B, mean=mean, variance=variance,
        lower=np.zeros(B.shape[1]) if lower is None else np.asarray(lower, float),
        noise=np.asarray(parameters["noise"], float), noise_weight=float(parameters["noise_weight"]),
    )  # fmt: skip
    return made
