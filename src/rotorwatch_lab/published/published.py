"""A published method on a real flight, with outputs in the form of the default diagnoser's, so that all later stages are shared.

Each hop of the flight becomes a plant and a table (log_plant.py), the method runs over it with the threshold of published/decide.py
behind it, and its announcements are recorded as the default estimator's outputs are: engine/bindings/event_rows.py and all after it
do not know the difference. The losses there are the decision's; the method's raw output is kept beside them (own.py). What the default
method does beyond - it tests every onset, competes losses against disturbances
over whole windows, learns the noise on the way and refines a loss - a plain method does not, and `notes` says so.
"""

from __future__ import annotations

import functools
import inspect
from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import discovery
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch.flight.method_series import INTERVAL, MethodSeries, joined
from rotorwatch.toolkit import ASSESS, PLACES, Estimation, Hypotheses, TickOutput, Ticks, list_hypotheses, program, rotor_sets
from rotorwatch_lab.compiling.run import chosen, run, run_built
from rotorwatch_lab.published import decide, log_plant, origin, own
from rotorwatch_lab.published.log_plant import LogPlant
from rotorwatch_lab.published.own import Own

OTHER_NATS = 5.0  # by so much another rotor set must explain more before it takes the place of the announced one
SHOWN_S = 1.0  # losses shown are means over this time
MODEL_SD = 0.004  # of a loss: rotors are not equal


class Tuning(NamedTuple):
    """Result of `rotorwatch tune`: factors on the plant's noise, and the method's own keywords.

    q (n_x,), r (n_y,): factors on the variances of process and measurement noise. keywords: such as theta_walk.
    """

    q: Any = None
    r: Any = None
    keywords: Mapping[str, float] = {}


class Scaled:
    """A plant with its noise variances multiplied: Q by sqrt(q_i q_j), R by r. Everything else is the plant's own."""

    def __init__(self, system, q=None, r=None):
        """q (n_x,) and r (n_y,): factors above zero, which may be traced; None: 1."""
        self._system = system
        self._q = np.ones(system.n_x) if q is None else q
        self._r = np.ones(system.n_y) if r is None else r

    def __getattr__(self, name):
        return getattr(self._system, name)

    def Q(self, dt):
        """(n_x, n_x) scaled process noise."""
        from jax import numpy as jnp

        root = jnp.sqrt(jnp.asarray(self._q))
        return root[:, None] * self._system.Q(dt) * root[None, :]

    def R(self, u):
        """(n_y,) scaled measurement variances."""
        return self._r * self._system.R(u)


def method(name: Any, system, dt: float, tuning: Tuning | None = None):
    """The estimator of that name (`discovery.estimator`) on a plant. Raises ConfigError for an unknown name or keyword, or a plant that it
    is not defined for."""
    kind = discovery.estimator(name)
    tuning = tuning or Tuning()
    known = inspect.signature(kind).parameters
    for keyword in tuning.keywords:
        if keyword not in known:
            raise ConfigError(f"{discovery.title(name)} has no tuning called {keyword!r}.")
    if tuning.q is not None or tuning.r is not None:
        system = Scaled(system, tuning.q, tuning.r)
    return kind(system, dt, **tuning.keywords)


class Output(namedtuple("Output", "estimate decision level scatter")):
    """Output of a step: the method's estimate, the threshold's decision, and the level and scatter (4,) it is compared with."""


class Watched:
    """A method with thresholds behind it, stepped as one."""

    def __init__(self, estimator, thresholds: Sequence[decide.Threshold], dt: float):
        self.estimator, self.thresholds, self.dt = estimator, tuple(thresholds), dt
        self.system = estimator.system

    def init(self):
        """Initial carries of the method and all thresholds."""
        return self.estimator.init(), tuple(threshold.init() for threshold in self.thresholds)

    def step(self, carry, u, y, valid):
        """Advance by one step: an `Output` per threshold."""
        first, out = self.estimator.step(carry[0], u, y, valid)
        estimate = getattr(out, "estimate", out)
        results = [t.step(c, estimate, self.dt) for t, c in zip(self.thresholds, carry[1], strict=True)]
        outputs = tuple(Output(estimate, decision, c.level, c.scatter) for c, decision in results)
        return (first, tuple(c for c, _ in results)), outputs


class Seen(namedtuple("Seen", "theta innovation innovation_var log_odds statistic alarm onset best level scatter")):
    """The part of a step that a diagnosis needs: theta (n,), innovation and its variances (n_y,), and the decision."""


def seen(outputs: Sequence[Output]) -> tuple[Seen, ...]:
    """The stored outputs of a step, for every threshold."""
    import jax.numpy as jnp

    def result(out: Output) -> Seen:
        e, d = out.estimate, out.decision
        return Seen(
            e.theta, e.innovation, jnp.diagonal(e.innovation_cov),
            d.log_odds, d.statistic, d.alarm, d.onset, d.best, out.level, out.scatter,
        )  # fmt: skip

    return tuple(result(out) for out in outputs)


def both(outputs: Sequence[Output]) -> tuple[Own, Seen]:
    """The method's raw output at a step, and the decision of the first threshold."""
    return own.own(outputs[0]), seen(outputs[:1])[0]


Decisions = tuple[tuple[tuple[str, float], ...], ...]
"""Keywords of `decide.Threshold`, for each of several thresholds."""


def watched(name: Any, dt: float, keywords: tuple, decisions: Decisions, p: dict) -> Watched:
    """The method on the plant of parameters p["plant"], with thresholds for the geometry p["B"] behind it."""
    tuning = Tuning(p.get("q"), p.get("r"), dict(keywords))
    thresholds = [decide.Threshold(p["B"], **dict(tuned)) for tuned in decisions]
    return Watched(method(name, log_plant.plant(p["plant"]), dt, tuning), thresholds, dt)


@functools.lru_cache(maxsize=64)
def builder(name: Any, dt: float, keywords: tuple = (), decisions: Decisions = ((),)) -> Callable:
    """build(parameters) for run_built: one compiled program for every flight with as many rotors. Native code is kept under the name of
    the method; one of another package, or passed as an object, has none, because its source may change."""
    build = functools.partial(watched, name, dt, keywords, decisions)
    ours = isinstance(name, str) and origin.source(discovery.estimator(name)).package == "rotorwatch"
    return build if ours else lambda p: build(p)


def run_hop(
    name: Any, hop: LogPlant, B: np.ndarray, time: np.ndarray, number: int, tuning: Tuning | None = None, progress=None
) -> tuple[MethodSeries, Seen]:
    """Run the method over one hop, the flight's `number`-th, of ticks at `time`: raw output, and the threshold's decisions. Native code
    where there is a compiler: XLA takes four times as long to build it."""
    tuning = tuning or Tuning()
    parameters: dict[str, Any] = {"plant": hop.parameters, "B": B}
    parameters |= {k: np.asarray(v) for k, v in (("q", tuning.q), ("r", tuning.r)) if v is not None}
    build, backend = builder(name, hop.dt, tuple(sorted(tuning.keywords.items()))), chosen(None, "auto")
    estimator, rows = build(parameters), (hop.u, hop.y, hop.valid)  # with values: a wrong configuration raises here
    try:
        outputs = run_built(build, parameters, *rows, both, progress, estimator.init(), backend)[1]
    except (load_jax().errors.JAXTypeError, ConfigError):  # its design needs values: compiled for this flight alone
        outputs = run(estimator, *rows, both, progress, backend=backend)[1]
    series = own.series(discovery.title(name), estimator.estimator, outputs[0], time[hop.rows], number, hop.dt, PLANT_NOTES)
    return series, outputs[1]


def assess(
    name: Any,
    table: Ticks,
    B: np.ndarray,
    dynamics: dict | None = None,
    tuning: Tuning | None = None,
    progress=None,
    hops: Sequence[LogPlant] | None = None,
) -> tuple[TickOutput, MethodSeries | None]:
    """Outputs of a published method on every tick of a flight, in the default estimator's form, and its raw output on the assessed ticks;
    None where no part of the flight was assessed.

    hops: of `log_plant.hops`, when they are known already. Ticks outside the assessed hops hold zeros. biases: the missing
    wrench besides that of the losses shown. log_odds: of `list_hypotheses(n)`. Raises ConfigError for an unknown method and slow logs.
    """
    discovery.estimator(name)
    hyp = list_hypotheses(B.shape[1])
    out, parts = program.blank(len(table.time), hyp), []
    for k, hop in enumerate(log_plant.hops(table, B, dynamics) if hops is None else hops, start=1):
        raw, decided = run_hop(name, hop, B, table.time, k, tuning, progress)
        record(out, decided, hop, hyp, B)
        parts.append(raw)
    return out, joined(parts) if parts else None


def estimation(
    name: Any, table: Ticks, B: np.ndarray, dynamics: dict | None = None, tuning: Tuning | None = None, progress=None
) -> Estimation:
    """What `rotorwatch.diagnose` needs of a published method over a flight: the entry point `rotorwatch.estimation`. Arguments as of
    `assess`."""
    out, series = assess(name, table, B, dynamics, tuning, progress)
    return Estimation(out, series, tuple(notes(discovery.title(name))), decide.LIMIT)


def itself(name: Any, table: Ticks, B: np.ndarray, hops: Sequence[LogPlant], tuning: Tuning | None = None, progress=None) -> MethodSeries:
    """Raw output of the method on the assessed ticks of a flight with at least one such hop, without decisions."""
    return joined([run_hop(name, hop, B, table.time, k, tuning, progress)[0] for k, hop in enumerate(hops, start=1)])


def default(table: Ticks, B: np.ndarray, dynamics: dict | None = None, progress=None) -> MethodSeries:
    """What the default estimator says on the assessed ticks of a flight: losses of the rotors it holds for weak, and with which standard
    deviation a loss of the others would be measured. It has no states of this plant's; innovations are of the wrench."""
    _, out = program.estimate(table, B, dynamics, progress)
    rows = np.flatnonzero(table.mode == ASSESS)
    hop, none = np.cumsum(table.restart)[rows], np.zeros((len(rows), 0))
    sd = np.where(out.theta > 0.0, out.theta_sd, out.detectable)[rows]
    cov = np.einsum("ti,ij->tij", sd**2, np.eye(B.shape[1]))
    names = tuple(f"loss_{k + 1}" for k in range(B.shape[1]))
    wrench = ("roll", "pitch", "yaw", "thrust")
    return MethodSeries(
        "default", "wrench balance", INTERVAL, table.time[rows], hop, out.theta[rows], cov, none, none, out.innovation[rows],
        out.innovation_var[rows], np.where(table.valid[rows].any(axis=1), 0, 2), names, (), (), wrench, ("hover thrusts",) * 4, table.dt,
    )  # fmt: skip


PLANT_NOTES = (
    "the plant is rotational dynamics in hover thrusts of one rotor; its gains, noise and trim were identified before the first step, in a "
    "part of the flight that is taken as healthy, or from healthy flights: a loss is a change since then",
)


def notes(name: str) -> tuple[str, ...]:
    """Assumptions of a diagnosis by a published method."""
    return (
        f"{name} runs as published, on rotational dynamics whose gains, noise and trim were identified before assessing began",
        f"losses and intervals of rotors and events are those of the decision that all methods share, made of {name}'s estimates; {name}'s "
        "own losses and intervals are distinguished (own estimate)",
        "its losses become events by a threshold on the missing wrench; rotor sets that the geometry cannot distinguish "
        "are named together, but slow changes of wind, balance or battery may still pass for losses",
    )


def record(out: TickOutput, seen: Seen, hop: LogPlant, hyp: Hypotheses, B: np.ndarray) -> None:
    """Fill the rows of one hop in what `blank` made."""
    rows, dt, n = hop.rows, hop.dt, B.shape[1]
    fault = np.asarray(hyp.fault)
    odds = np.where(fault, seen.log_odds, -np.inf)
    probability = np.exp(odds - odds.max(axis=1, keepdims=True))
    away = seen.theta[:, :n] @ B.T - seen.level
    weight = 1.0 / (seen.scatter + np.array([0, 0, 0, (n * decide.COMMON_SD) ** 2]))
    announced, active, best, onset = _follow(seen, hyp, dt)
    losses, sd = _losses(_trailing_mean(away, max(1, round(SHOWN_S / dt)), announced), weight, active, B)
    to_wrench = np.concatenate([np.diag(hop.parameters["J"])[:3] / dt, [hop.parameters["m"]]])
    to_wrench[2] *= 1.0 / np.abs(hop.parameters["B_tau"][2]).max()
    weighted = np.einsum("ai,ta,ai->ti", B, weight, B)
    out.theta[rows], out.theta_sd[rows] = losses, sd
    out.innovation[rows], out.innovation_var[rows] = seen.innovation * to_wrench, seen.innovation_var * to_wrench**2
    out.log_odds[rows], out.statistic[rows], out.best[rows], out.onset[rows] = (seen.log_odds, seen.statistic, best, onset)
    out.probability[rows] = probability / probability.sum(axis=1, keepdims=True)
    out.announced[rows] = announced
    out.onsets[rows], out.active[rows], out.share[rows] = _explanations(announced, active, onset, out.probability[rows], hyp)
    out.detectable[rows] = np.maximum(decide.SIGMAS / np.sqrt(weighted), decide.LEAST) / 1.96
    out.biases[rows] = (hop.u * (seen.theta[:, :n] - losses)) @ B.T


def _follow(seen: Seen, hyp: Hypotheses, dt: float):
    """Which rotors are announced at each step: announced (T,), active (T, n), best (T,), onset (T,) steps back.

    A set is replaced when another one explains OTHER_NATS more, grown when it holds the announced one, and over after decide.OVER_S
    without a sign of it; an end is announced too, so that it is written down with its time.
    """
    T = len(seen.alarm)
    announced, active = np.zeros(T, bool), np.zeros((T, hyp.n), bool)
    best, onset = seen.best.astype(int).copy(), seen.onset.copy()
    over = decide.LIMIT * decide.FADE
    current: frozenset[int] = frozenset()
    same_set: np.ndarray = np.zeros(0, int)
    quiet = 0
    for k in range(T):
        if current:
            best_of_set = seen.log_odds[k, same_set].max()
            quiet = quiet + 1 if best_of_set < over else 0
            if quiet * dt >= decide.OVER_S:
                announced[k], best[k], onset[k] = True, same_set[0], quiet
                current, quiet = frozenset(), 0
        rotors = frozenset(hyp.rotors[seen.best[k]])
        if seen.alarm[k] and rotors != current and not announced[k]:
            if not current or rotors > current or seen.log_odds[k, seen.best[k]] > seen.log_odds[k, same_set].max() + OTHER_NATS:
                announced[k], current, quiet = True, rotors, 0
        if announced[k]:
            same_set = np.array([h for h, s in enumerate(hyp.rotors) if hyp.fault[h] and frozenset(s) == current], int)
        active[k, sorted(current)] = True
    return announced, active, best, onset


def _explanations(announced, active, onset, probability, hyp: Hypotheses):
    """Ticks since the onset (T, K), rotors (T, K, n) and probabilities (T, K) of what was announced last and of its alternatives."""
    T = len(announced)
    since, sets, share = np.zeros((T, PLACES)), np.zeros((T, PLACES, hyp.n), bool), np.zeros((T, PLACES))
    sets[:, 0], share[:, 0] = active, 1.0
    births = np.flatnonzero(announced)
    for k, stop in zip(births, [*births[1:], T]):
        since[k:stop] = onset[k] + np.arange(stop - k)[:, None]
        named = tuple(int(i) for i in np.flatnonzero(active[k]))
        if named:
            found = rotor_sets(hyp, probability[k])
            share[k:stop, 0] = found.get(named, 0.0)
            others = [item for item in found.items() if item[0] != named]
            for place, (rotors, p) in enumerate(others[: PLACES - 1], start=1):
                sets[k:stop, place, list(rotors)] = True
                share[k:stop, place] = p
    return since, sets, share


def _trailing_mean(values: np.ndarray, width: int, restart: np.ndarray) -> np.ndarray:
    """Mean of the last `width` rows, never reaching back over a row where `restart` holds."""
    k = np.arange(len(values))
    since = np.maximum.accumulate(np.where(restart, k, 0))
    first = np.maximum(k - width + 1, since)
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return (total[k + 1] - total[first]) / (k + 1 - first)[:, None]


def _losses(away: np.ndarray, weight: np.ndarray, active: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Losses (T, n) of the announced rotors by weighted least squares on the missing wrench, 0..1, and their sd."""
    losses, sd = np.zeros(active.shape), np.zeros(active.shape)
    for pattern in np.unique(active[active.any(axis=1)], axis=0):
        rows, M = np.flatnonzero((active == pattern).all(axis=1)), B[:, pattern]
        information = np.einsum("ai,ta,aj->tij", M, weight[rows], M) + 1e-9 * np.eye(M.shape[1])
        moment = np.einsum("ai,ta->ti", M, weight[rows] * away[rows])
        covariance = np.linalg.inv(information)
        where = np.ix_(rows, np.flatnonzero(pattern))
        losses[where] = np.clip(np.einsum("tij,tj->ti", covariance, moment), 0.0, 1.0)
        sd[where] = np.sqrt(np.einsum("tii->ti", covariance) + MODEL_SD**2)
    return losses, sd
