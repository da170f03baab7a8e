"""The log weights of explanations and their temper, fitted to claims whose truth is known.

For claim c with the explanations e, of which T_c agree with what was done to the vehicle,

    P_c = sum_{e in T_c} exp(w_e + b log p_e) / sum_e exp(w_e + b log p_e)
    minimise  -sum_c log( (1 - OUTSIDE) P_c + OUTSIDE ) + sum_g (w_g - w0_g)^2 / (2 WIDTH^2)

over the weights w_g of the groups of explanations (that of a loss is 0) and log b, with the weights w0 in use: multinomial logistic
regression. b is below 1 where residuals are less white than the filters believe. OUTSIDE is the share of claims that something else than
any explanation makes, such as a swinging load: without it a single one of 30 nats decides b. Flights of other seeds check the result.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch.toolkit import odds
from rotorwatch_lab.campaign import claims
from rotorwatch_lab.campaign.claims import HARMLESS, Fault, Flown
from rotorwatch_lab.campaign.plan import Plan, read
from rotorwatch_lab.experiments import tools

OUTSIDE = 0.01
WIDTH = 1.5  # nats: how far the data of few claims move a weight
FIXED = ("loss",)  # of one rotor: what the others are relative to
NEAR_S = 3.0  # a claim's onset and the fault's
LATER_S = 23.0  # of motion that a claim is compared on
LATENT = ("slow", "capped")  # faults that show only when the rotor is commanded so
LEAST = 30  # claims that a fit needs


class Truth(NamedTuple):
    """Rotors, from 0: that a true explanation must have at fault, at least one of them, and that it may."""

    must: frozenset[int]
    may: frozenset[int]

    def agrees(self, row: odds.Row) -> bool:
        """True for an explanation that agrees."""
        named = at_fault(row)
        return named <= self.may and (not self.must or bool(named & self.must))


def at_fault(row: odds.Row) -> set[int]:
    """Rotors, from 0, that an explanation has at fault."""
    return set(row.weak) | (set(row.rotors) if row.group in LATENT else set())


def truth(faults: Sequence[Fault], claim: odds.Comparison) -> Truth | None:
    """What was true of a claim; None where a fault begins while it is compared, so that nothing and the fault are both true."""
    harmful = [f for f in faults if f.kind not in HARMLESS and f.onset_s < claim.onset_s + LATER_S]
    must = [f for f in harmful if f.onset_s - NEAR_S <= claim.onset_s <= (np.inf if f.kind in LATENT else f.grown_s) + NEAR_S]
    if not must and any(f.onset_s > claim.onset_s for f in harmful):
        return None
    return Truth(frozenset(f.rotor - 1 for f in must), frozenset(f.rotor - 1 for f in harmful))


class Labelled(NamedTuple):
    """A claim with the explanations that agree with the truth, and whether its flight is healthy."""

    claim: odds.Comparison
    agrees: np.ndarray
    truth: Truth
    healthy: bool


def labelled(flown: Sequence[Flown]) -> list[Labelled]:
    """All claims of these flights whose truth is among their explanations."""
    found = []
    for flight in flown:
        for claim in flight.compared:
            what = truth(flight.faults, claim)
            agrees = np.array([what is not None and what.agrees(r) for r in claim.rows])
            if what is not None and agrees.any():
                found.append(Labelled(claim, agrees, what, not flight.broken))
    return found


def log_loss(data: Sequence[Labelled], weights: Mapping[str, float] | None = None, temper: float | None = None) -> float:
    """Mean of -log((1 - OUTSIDE) P + OUTSIDE) with the probability P of the truth, in nats."""
    if not data:
        return float("nan")
    return float(np.mean([_surprise(d.claim.logs(weights, temper), d.agrees)[0] for d in data]))


def _surprise(logs: np.ndarray, agrees: np.ndarray) -> tuple[float, float]:
    """-log((1 - OUTSIDE) P + OUTSIDE), and its slope over -log P."""
    p = float(np.exp(np.logaddexp.reduce(logs[agrees]) - np.logaddexp.reduce(logs)))
    seen = (1.0 - OUTSIDE) * p + OUTSIDE
    return -float(np.log(seen)), (1.0 - OUTSIDE) * p / seen


def share(logs: np.ndarray) -> np.ndarray:
    """Probabilities from their logarithms, to within a constant."""
    p = np.exp(logs - logs.max())
    return p / p.sum()


def fit(data: Sequence[Labelled], width: float = WIDTH, temper: float | None = None) -> tuple[dict[str, float], float]:
    """(weights, temper) of greatest penalised likelihood; temper: fixed, where given. Raises ConfigError for too few claims."""
    if len(data) < LEAST:
        raise ConfigError(f"Weights need {LEAST} claims of known truth, these flights have {len(data)}: give more flights.")
    from scipy.optimize import minimize

    free = [g for g in odds.WEIGHTS if g not in FIXED]
    prior = np.array([odds.WEIGHTS[g] for g in free])
    has = [np.array([[g in d.claim.weights(r) for g in free] for r in d.claim.rows], float) for d in data]
    log_p = [np.array([r.log_p for r in d.claim.rows]) for d in data]

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        w, b = x[:-1], np.exp(x[-1])
        value, slope = float(((w - prior) ** 2).sum()) / (2.0 * width**2), np.append((w - prior) / width**2, 0.0)
        for d, columns, p in zip(data, has, log_p):
            logs = columns @ w + b * p
            surprise, steep = _surprise(logs, d.agrees)
            value += surprise
            change = steep * (share(logs) - share(np.where(d.agrees, logs, -np.inf)))
            slope[:-1] += columns.T @ change
            slope[-1] += b * float(p @ change)
        return value, slope if temper is None else np.append(slope[:-1], 0.0)

    start = np.append(prior, np.log(odds.TEMPER if temper is None else temper))
    found = minimize(cost, start, jac=True, method="L-BFGS-B").x
    return {**odds.WEIGHTS, **{g: float(v) for g, v in zip(free, found)}}, float(np.exp(found[-1]))


class Counts(NamedTuple):
    """Claims by what becomes of them: named alone and rightly or not (of healthy flights, of others), in doubt, dropped though true."""

    right: int
    wrong_healthy: int
    wrong_other: int
    doubt: int
    dropped_true: int


def counts(
    data: Sequence[Labelled], weights: Mapping[str, float] | None = None, temper: float | None = None, limits: odds.Limits = odds.LIMITS
) -> Counts:
    """What becomes of the claims with these constants."""
    return total([ending(d, weights, temper, limits) for d in data])


def total(ends: Sequence[str]) -> Counts:
    """How many claims end in each way."""
    return Counts(*(ends.count(name) for name in Counts._fields))


def ending(d: Labelled, weights: Mapping[str, float] | None = None, temper: float | None = None, limits: odds.Limits = odds.LIMITS) -> str:
    """What becomes of a claim: one of the fields of Counts, or "dropped"."""
    found = d.claim.weighed(weights, temper)
    decision = d.claim.decided(found, limits)
    named = _named(d.claim, found, decision, limits)
    if named is not None:
        return "right" if named and named <= d.truth.may else "wrong_healthy" if d.healthy else "wrong_other"
    if decision is odds.Decision.DROPPED:
        return "dropped_true" if d.truth.must & _meant(d.claim) else "dropped"
    return "doubt"


def _meant(claim: odds.Comparison) -> set[int]:
    return {r - 1 for r in claim.rotors}


def _named(claim: odds.Comparison, found: odds.Weighed, decision: odds.Decision, limits: odds.Limits) -> set[int] | None:
    """Rotors, from 0, that the claim names with certainty after the comparison; None where it names none, or several sets."""
    if decision is odds.Decision.SLOW:
        return {claim.rotors[0] - 1 if claim.named else int(np.argmax(found.slow))}
    if decision is not odds.Decision.LOSS:
        return None
    if not claim.named:
        return set(found.likeliest(claim.rotors) or ())
    return None if claim.alternatives or found.near(limits) else _meant(claim)


class Result(NamedTuple):
    """weights, temper: fitted. claims: of training, held out. training, loss: log loss with the constants in use, and fitted, of training
    and held out; counts: of the ends of the claims that were held out. data: all claims."""

    weights: dict[str, float]
    temper: float
    claims: tuple[int, int]
    training: tuple[float, float]
    loss: tuple[float, float]
    counts: tuple[Counts, Counts]
    data: tuple[Labelled, ...]


def evaluate(training: Sequence[Flown], checking: Sequence[Flown], width: float = WIDTH) -> Result:
    """Fit to the flights of `training` and check on others. Raises ConfigError."""
    data, other = labelled(training), labelled(checking)
    weights, temper = fit(data, width)
    fitted = (weights, temper)
    return Result(
        weights, temper, (len(data), len(other)), (log_loss(data), log_loss(data, *fitted)), (log_loss(other), log_loss(other, *fitted)),
        (counts(other), counts(other, *fitted)), (*data, *other),
    )  # fmt: skip


def fit_odds(
    plan: Plan | str | PathLike,
    healthy: Sequence[str | PathLike] = (),
    flights: int = 1800,
    held_out: int = 900,
    seed: int = 101,
    jobs: int | None = None,
    progress: Callable | None = None,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> Result:
    """Fit to claims in flights of a plan with `seed` and every second healthy log, and check on flights with the seed after it and the
    other logs. Neither may be the plan's own seed.

    plan: assessed by logs (docs/campaigns.md#plans), or its file. healthy: logs. flights, held_out: how many to fit to, to check on. seed:
    of those to fit to. jobs, scheduler: as for `many.run`. progress: called as progress(share, text). keep: a folder for what is finished,
    from which the same call goes on. Raises ConfigError, LogError.
    """
    plan = plan if isinstance(plan, Plan) else read(plan)
    if plan.seed in (seed, seed + 1):
        raise ConfigError(f"The seeds {seed} and {seed + 1} train and check; {plan.seed} is the plan's own: give another --seed.")
    reported, part = progress or (lambda share, text="": None), flights / (flights + held_out)

    def some(count: int, own: int, logs: Sequence, share: float, size: float) -> list[Flown]:
        tell = functools.partial(_portion, reported, share, size)
        return claims.collect(plan, count, own, logs, jobs=jobs, progress=tell, scheduler=scheduler, keep=keep)

    return evaluate(some(flights, seed, healthy[::2], 0.0, part), some(held_out, seed + 1, healthy[1::2], part, 1.0 - part))


def _portion(tell: Callable, start: float, size: float, share: float, text: str = "") -> None:
    tell(start + size * share, text)


def to_dict(result: Result) -> dict[str, Any]:
    """The result as JSON has it."""
    before, after = result.counts
    plain = {name: value for name, value in result._asdict().items() if name != "data"}
    return {**plain, "counts": [before._asdict(), after._asdict()], "present": {"weights": odds.WEIGHTS, "temper": odds.TEMPER}}


def markdown(result: Result) -> str:
    """Tables: constants in use and fitted; what they make of the claims that were held out."""
    rows = [[f"`{g}`", f"{w:.1f}", f"{result.weights[g]:.2f}"] for g, w in odds.WEIGHTS.items()]
    rows.append(["temper", f"{odds.TEMPER:.2f}", f"{result.temper:.3f}"])
    ends = [[name.replace("_", " "), *(getattr(c, name) for c in result.counts)] for name in Counts._fields]
    losses = [["log loss, training", *(f"{v:.3f}" for v in result.training)], ["log loss, held out", *(f"{v:.3f}" for v in result.loss)]]
    return (
        f"{result.claims[0]} claims for training, {result.claims[1]} held out.\n\n"
        + tools.table(("explanation", "in use", "fitted"), rows)
        + "\n\n"
        + tools.table(("held out", "in use", "fitted"), [*losses, *ends])
    )
