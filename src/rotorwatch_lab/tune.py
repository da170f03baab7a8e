"""Noise covariances from healthy flights: the gradient of a filter's likelihood, through the filter.

The innovations e of a well-tuned filter are white with the covariance S that it reports; their log-likelihood

    L = -1/2 sum_k ( e' S^-1 e + log det S + n log 2 pi )

is a function of the tuning, and JAX differentiates it through every step (Abbeel et al., Discriminative training of Kalman filters, RSS
2005, compare such criteria). Fitted: a factor on each state's process noise and on each measurement's variance, and how fast losses may
change: their random walk, or the memory of a method that has none. Healthy data alone would fit losses that never change; so every flight
counts once more with an inserted loss: an actuator with less effect is commanded more, u / (1 - loss), while the motion stays as
measured.

Works for every estimator that outputs innovation and innovation_cov.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Any

import numpy as np

from rotorwatch.base import checks, discovery, files
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.optional import tomllib
from rotorwatch.errors import ConfigError
from rotorwatch.toolkit import aerobatic, baselines, diagnose
from rotorwatch_lab.published import log_plant, published
from rotorwatch_lab.published.log_plant import LogPlant
from rotorwatch_lab.published.published import Scaled, Tuning

# Methods' names for the variance that a loss gains per second, or for their forgetting time.
PACES = ("theta_walk", "Q_theta", "theta_drift", "memory_s")
ROWS, SETTLE = 600, 40  # rows of a window, and of its beginning that does not count
LEAST_ROWS = 4 * SETTLE  # fewest rows of a usable table
WORDS = {"p": "roll rate", "q": "pitch rate", "r": "yaw rate", "f_z": "thrust"}
LOSS, GROWTH_S = 0.3, 0.3  # the inserted loss, and its time of growth
RANGE = 1e4  # factors stay within this
ROUNDS = 30
WALL = 1e3


@dataclass(frozen=True)
class Table:
    """A flight on a plant: system, u (T, n_u), y (T, n_y), valid (T, n_y), dt [s]. `LogPlant` has the same fields."""

    system: Any
    u: np.ndarray
    y: np.ndarray
    valid: np.ndarray
    dt: float


@dataclass(frozen=True)
class Fit:
    """Result of a fit. before, after: log-likelihood of one measured row, on the flights fitted to; held_out: the data kept back from the
    fit, held_out_before and held_out_after: the same on that, healthy rows only. notes: doubts about the tuning, a sentence each."""

    estimator: str
    plant: str
    dt: float
    tuning: Tuning
    before: float
    after: float
    flights: tuple[str, ...] = field(default=())
    held_out: str = ""
    held_out_before: float = float("nan")
    held_out_after: float = float("nan")
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict:
        """The fields as in the file."""
        t = self.tuning
        names = ("held_out", "held_out_before", "held_out_after") if self.held_out else ()
        checked = {name: getattr(self, name) for name in names}
        return {
            "estimator": self.estimator, "plant": self.plant, "dt": self.dt, "q": [float(v) for v in t.q],
            "r": [float(v) for v in t.r], "keywords": {k: float(v) for k, v in t.keywords.items()},
            "found": {
                "log_likelihood_before": self.before, "log_likelihood_after": self.after, "flights": list(self.flights), **checked,
                "notes": list(self.notes),
            },
        }  # fmt: skip


def pace_of(name: str, estimator: Any) -> str | None:
    """The keyword by which a method takes how fast losses may change, a number that it keeps under this name; None without one."""
    known = inspect.signature(discovery.estimator(name).__init__).parameters
    return next((k for k in PACES if k in known and np.ndim(known[k].default) == 0 and hasattr(estimator, k)), None)


def fit(
    name: str, tables: Sequence[LogPlant | Table], keywords: dict | None = None, rounds: int = ROUNDS, progress: Callable | None = None
) -> Fit:  # fmt: skip
    """Fit the tuning of a method to healthy flights. keywords: the method's tuning to start from, else its defaults.

    progress: called with the finished share, 0..1. Raises ConfigError for an unknown method, one without innovations, or
    flights that are too short."""
    from scipy.optimize import minimize

    jax = load_jax()
    tables = [t for t in tables if t.u.shape[0] >= LEAST_ROWS]
    if not tables:
        raise ConfigError(f"Tuning needs a healthy flight of at least {LEAST_ROWS} rows after the learning time.")
    if len({(t.dt, t.system.n_u) for t in tables}) > 1:
        raise ConfigError("Tuning needs flights of one build, logged at one rate.")
    system, dt = tables[0].system, tables[0].dt
    pace = pace_of(name, published.method(name, system, dt, Tuning(keywords=keywords or {})))
    score = jax.jit(jax.value_and_grad(_objective(name, tables, dict(keywords or {}), pace)))
    start = np.zeros(system.n_x + system.n_y + (pace is not None))
    first = float(score(start)[0])
    if not np.isfinite(first):
        raise ConfigError(f"{name} gives no finite likelihood on these flights; start from another tuning.")
    calls, good = 0, start

    def value(p):
        nonlocal calls, good
        calls += 1
        if progress:
            progress(min(1.0, calls / (1.5 * rounds)))
        L, slope = score(p)
        if np.isfinite(L) and np.isfinite(slope).all():
            good = p.copy()
            return float(L), np.asarray(slope)
        back = p - good  # a step too far: the way back is downhill
        return first + WALL, WALL * back / max(back @ back, 1e-12)

    limit = float(np.log(RANGE))
    bounds, how = [(-limit, limit)] * start.size, {"maxiter": rounds}
    best = minimize(value, start, jac=True, method="L-BFGS-B", bounds=bounds, options=how)
    factors = np.exp(best.x)
    n_x, n_y = system.n_x, system.n_y
    chosen = dict(keywords or {})
    if pace is not None:
        usual = inspect.signature(discovery.estimator(name).__init__).parameters[pace].default
        chosen[pace] = float(chosen.get(pace, usual)) * float(factors[-1])
    tuning = Tuning(factors[:n_x], factors[n_x : n_x + n_y], chosen)
    notes = _at_bounds(factors, system, pace)
    if not best.fun < first:
        notes.append("The fit found nothing better than the tuning it started from.")
    return Fit(name, checks.plant_name(system), dt, tuning, -first, -float(best.fun), notes=tuple(notes))


def tune(logs: baselines.Given | Iterable[baselines.Given], estimator: str, rounds: int = ROUNDS, progress: Callable | None = None) -> Fit:
    """`fit` the named estimator to healthy logs of one build, and check it on data that was not fitted.

    logs: healthy flights of one build, or their files. estimator: the name of a published method. rounds: of the fit at most. progress:
    called with the finished share. Logs that are not healthy or not of one build are rejected (`baselines.healthy`). Of two flights and
    more the last is kept back for the check, of a single long one its last quarter. Fit.notes state what was rejected, which factors ended
    at their bounds, and whether the held-out data became less likely. Raises LogError, VehicleError or ConfigError with one sentence."""
    if estimator == "default":
        raise ConfigError("The default estimator learns its noise in flight; tune a published one, such as ekf.")
    discovery.estimator(estimator)
    kept, aside = baselines.healthy(logs, diagnose)
    for one in kept:
        aerobatic.decline(one.flight, "the published methods model hover, so that there is nothing to tune to.")
    taught, held, held_name = _held_out([(one.name, _hops(one)) for one in kept])
    found = fit(estimator, taught, rounds=rounds, progress=progress)
    notes = [*aside, *found.notes]
    if held:
        rows = [len(hop.u) - SETTLE for hop in held]
        each = ([log_likelihood(estimator, hop, tuning) for hop in held] for tuning in (None, found.tuning))
        before, after = (float(np.average(values, weights=rows)) for values in each)
        found = replace(found, held_out=held_name, held_out_before=before, held_out_after=after)
        if after < before:
            notes.append(
                f"The tuning is worse: on {held_name}, which it was not fitted to, the log-likelihood of a row falls from "
                f"{before:.3f} to {after:.3f}; do not use it, or tune to more flights."
            )
    else:
        notes.append("The tuning was not checked: give a second healthy flight, which is then kept back for that.")
    return replace(found, flights=tuple(one.name for one in kept), notes=tuple(notes))


def _hops(one: baselines.Candidate) -> list[LogPlant]:
    """The hops of a healthy flight that are long enough to count."""
    from rotorwatch.toolkit import READY_S, observe

    table = observe(one.flight, one.vehicle, one.air, READY_S)
    hops = log_plant.hops(table, one.vehicle.effectiveness()) if table is not None else ()
    return [hop for hop in hops if len(hop.u) >= LEAST_ROWS]


def _held_out(flights: Sequence[tuple[str, list[LogPlant]]]) -> tuple[list[LogPlant], list[LogPlant], str]:
    """Hops to fit to, hops to check on, and the name of the latter: the last flight, or the last quarter of a single long hop."""
    flights = [(name, hops) for name, hops in flights if hops]
    if len(flights) > 1:
        name, held = flights[-1]
        return [hop for _, hops in flights[:-1] for hop in hops], held, name
    hops = [hop for _, found in flights for hop in found]
    cut = len(hops[-1].u) * 3 // 4 if hops else 0
    if not hops or len(hops[-1].u) - cut < LEAST_ROWS:
        return hops, [], ""
    return [*hops[:-1], hops[-1].part(0, cut)], [hops[-1].part(cut)], f"the last quarter of {flights[0][0]}"


def _at_bounds(factors: np.ndarray, system, pace: str | None) -> list[str]:
    """A sentence on the factors (n_x + n_y, and the pace's) that ended at their bounds; none when there is none."""
    what = [f"process noise of {name}" for name in _names(system, "x_names", system.n_x)]
    what += [f"measurement noise of {name}" for name in _names(system, "y_names", system.n_y)]
    ends = [(w, f) for w, f in zip([*what, pace], factors) if abs(np.log(f)) > 0.999 * np.log(RANGE)]
    if not ends:
        return []
    said = ", ".join(f"{name} ({'largest' if factor > 1 else 'smallest'})" for name, factor in ends)
    return [
        f"The fit ran into its bounds, factors of {RANGE:g} up and down: {said}. The flights do not determine these, or the plant "
        "model is structurally wrong."
    ]


def _names(system, kind: str, count: int) -> list[str]:
    """Names of a plant's states or measurements, numbered where it has none."""
    names = [str(name) for name in getattr(system, kind, range(1, count + 1))]
    return [WORDS.get(name, name) for name in names]


def log_likelihood(name: str, table: LogPlant | Table, tuning: Tuning | None = None) -> float:
    """Mean log-likelihood of a row of one flight under a tuning; the first rows do not count."""
    from rotorwatch_lab.compiling.run import run

    estimator = published.method(name, table.system, table.dt, tuning)
    _, (e, S) = run(estimator, table.u, table.y, table.valid, _innovation)
    jax = load_jax()
    L = np.asarray(jax.vmap(_log_normal)(e, S, np.asarray(table.valid)))[SETTLE:]
    return float(L.mean())


def _innovation(out):
    estimate = getattr(out, "estimate", out)
    return estimate.innovation, estimate.innovation_cov


def _log_normal(e, S, valid):
    """log N(e; 0, S) of the valid components alone."""
    import jax.numpy as jnp

    S = jnp.where(valid[:, None] & valid[None, :], S, jnp.eye(e.shape[0]))
    L = jnp.linalg.cholesky(S)
    z = load_jax().scipy.linalg.solve_triangular(L, jnp.where(valid, e, 0.0), lower=True)
    return -0.5 * (z @ z) - jnp.log(jnp.diagonal(L)).sum() - 0.5 * np.log(2 * np.pi) * valid.sum()


def _objective(name: str, tables, keywords: dict, pace: str | None) -> Callable:
    """Negative mean log-likelihood of the log factors p, over windows of all tables, each once healthy and once with a loss."""
    jax = load_jax()
    jnp = jax.numpy
    rows = min(ROWS, *(t.u.shape[0] for t in tables))
    plants, windows = [], []
    for t in tables:
        last = t.u.shape[0] - rows
        for start in [*range(0, last, rows), last]:  # the last window may overlap the one before
            u, y, valid = (np.asarray(a)[start : start + rows] for a in (t.u, t.y, t.valid))
            for lost in (None, len(windows) // 2 % t.system.n_u):
                plants.append(t.parameters if isinstance(t, LogPlant) else len(plants))
                windows.append((_with_loss(u, lost, t.dt), np.where(valid, y, 0.0), valid))
    u, y, valid = (np.stack(column) for column in zip(*windows))
    shared = all(isinstance(t, LogPlant) for t in tables)
    if not shared and any(t.system is not tables[0].system for t in tables):
        raise ConfigError("Tuning on simulated flights needs one plant for all of them.")
    stacked = np.arange(len(u))
    if shared:
        stacked = jax.tree.map(lambda *a: np.stack([np.asarray(v, float) for v in a]), *plants)
    n_x, n_y, dt = tables[0].system.n_x, tables[0].system.n_y, tables[0].dt

    def one(p, parameters, u, y, valid):
        system = log_plant.plant(parameters) if shared else tables[0].system
        scaled = Scaled(system, jnp.exp(p[:n_x]), jnp.exp(p[n_x : n_x + n_y]))
        estimator = published.method(name, scaled, dt, Tuning(keywords=keywords))
        if pace is not None:  # constructors may require numbers: the factor applies to their result
            setattr(estimator, pace, getattr(estimator, pace) * jnp.exp(p[-1]))

        def step(carry, row):
            carry, out = estimator.step(carry, *row)
            return carry, _log_normal(*_innovation(out), row[2])

        L = jax.lax.scan(jax.checkpoint(step), estimator.init(), (u, y, valid))[1]
        count = (valid[SETTLE:].any(axis=1)).sum()
        return L[SETTLE:].sum() / jnp.maximum(count, 1)

    def objective(p):
        return -jax.vmap(one, (None, 0, 0, 0, 0))(p, stacked, u, y, valid).mean()

    return objective


def _with_loss(u: np.ndarray, actuator: int | None, dt: float) -> np.ndarray:
    """Commands (T, n_u) as if the actuator had lost LOSS in the middle of the window, and been commanded more to compensate it."""
    if actuator is None:
        return u
    since = np.maximum(np.arange(len(u)) - len(u) // 2, 0) * dt
    loss = LOSS * -np.expm1(-since / GROWTH_S)
    lost = u.copy()
    lost[:, actuator] = u[:, actuator] / (1.0 - loss)
    return lost


def write(found: Fit, path: str | PathLike) -> None:
    """Write a tuning file (TOML)."""
    d = found.to_dict()
    lines = [
        f"# Found by `rotorwatch tune`; use it with `rotorwatch diagnose --estimator {found.estimator} --tuning FILE`.",
        *(f"{k} = {_toml(d[k])}" for k in ("estimator", "plant", "dt", "q", "r")),
        "\n[keywords]",
        *(f"{k} = {_toml(v)}" for k, v in d["keywords"].items()),
        "\n[found]",
        *(f"{k} = {_toml(v)}" for k, v in d["found"].items()),
    ]
    with files.replacing(path) as unfinished:
        unfinished.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml(value) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list):
        return f"[{', '.join(_toml(v) for v in value)}]"
    return f"{value:.6g}"


def read(path: str | PathLike, estimator: str) -> Tuning:
    """The tuning in a file, for that estimator. Raises ConfigError with one sentence for any other content."""
    try:
        with open(path, "rb") as file:
            d = tomllib.load(file)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as why:
        raise ConfigError(f"{path} is not a tuning file: {why}.") from None
    if d.get("estimator") != estimator:
        raise ConfigError(f"{path} holds a tuning for {d.get('estimator', 'no estimator')}, not for {estimator}.")
    found = []
    for key, size in (("q", 3), ("r", 4)):
        value = d.get(key, [1.0] * size)
        numbers = isinstance(value, list) and all(isinstance(v, int | float) and 0 < v < np.inf for v in value)
        if not numbers or len(value) != size:
            raise ConfigError(f"{path}: {key} must be {size} numbers above zero.")
        found.append(np.array(value, float))
    keywords = d.get("keywords", {})
    if not isinstance(keywords, dict) or not all(isinstance(v, int | float) for v in keywords.values()):
        raise ConfigError(f"{path}: keywords must be numbers by name.")
    return Tuning(found[0], found[1], {k: float(v) for k, v in keywords.items()})
