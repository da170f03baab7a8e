"""Evidence from the response to an excitation of the commands, for events that are ambiguous without it.

Commands in the null space of the geometry (null_space.py) cause no motion while all rotors are healthy; a flight in which
they were excited is an experiment. The commanded thrust that the motion does not show, e = y - G m of the thrust channel (plant.py), then
is

    e(t) = sum_i phi_i(t) theta_i + noise,        phi_i = B_i q_i,        q: the excess part of the thrusts

q is the component of the thrusts (n,) in ker B, less what follows from the commanded wrench (mixers that are no pseudo-inverse always have
such a part). It is chosen by the designer of the excitation, independently of gusts and of the controller's response to them: unlike the
evidence of a jump, which ages while model errors continue (posterior.py), this evidence counts in full. With the noise covariance Sigma
learned before, the information matrix and vector of theta are

    J = phi' Sigma^-1 phi,        z = phi' Sigma^-1 e

and the evidence of a set S of weak rotors is Gaussian: their losses have the mean m that explains the deficit in hover, all others scatter
as healthy rotors do (sd UNLIKE), W the diagonal of the variances:

    log BF_S = m' z - m' J m / 2 + (z - J m)' (J + W^-1)^-1 (z - J m) / 2 - log det(1 + W J) / 2

times the ratio of the posterior to the prior probability that the losses of S are above 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.bindings.event_rows import ESTIMATOR, read, sd_of
from rotorwatch.engine.bindings.plant_rows import lower_rotors
from rotorwatch.engine.bindings.program import estimate
from rotorwatch.engine.estimator import hypotheses
from rotorwatch.engine.estimator.model_error import AT_LIMIT
from rotorwatch.engine.estimator.plant import GAIN, PER_AXIS, SHARE, TAU
from rotorwatch.engine.events.decisions import CERTAIN, CREDIBLE
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.motion.tick_table import ASSESS, Ticks
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import LOSS
from rotorwatch.stats.nonnegative import least_squares
from rotorwatch.stats.tails import normal_cdf
from rotorwatch.witnesses import null_space
from rotorwatch.witnesses.witness import Events, Stage, View, Witness

SOURCE = Source("excitation", 2, ESTIMATOR.explained)
LEAST = 0.05  # hover thrusts of one rotor, beyond the mixer's own allocation: an excitation, not rounding
SHORTEST_S, GAP_S, ASIDE_S = 0.5, 1.0, 1.0  # of an excitation; between two; of flight used before and after
LONGEST = 400  # ticks used together
UNLIKE = 0.03  # relative scatter of healthy rotors' response to a command
LOSS_SD = 0.05  # sd of a loss derived from hover, besides RECOVERY_SHARE of it
OTHER = 1e-4  # prior weight of a set that no event names, relative to one that is named and to none
CONTAINS = 0.1  # ... of one that contains a named one: the smaller one is sufficient
TRIM_S = 2.0  # averaging time of the trim at the beginning of a flight and before an excitation
TRIM_SD = np.array([0.05, 0.05, 0.15, 0.2])  # uncertainty of the commanded wrench of trim, in hover thrusts of one rotor
AFTER_S = 2.0  # for which an excitation still shows in the evidence of jumps
DELAYS_S = (0.0, 0.02, 0.04, 0.07, 0.1)  # of a rotor, beyond the lag assumed for the ticks


class ExcitationEvidence(NamedTuple):
    """The evidence of one excitation. start, end [s]. J (D, n, n), z (D, n): information on the losses, for each of DELAYS_S."""

    start: float
    end: float
    J: np.ndarray
    z: np.ndarray


def find(table: Ticks, B: np.ndarray, dynamics=None) -> tuple[tuple[ExcitationEvidence, ...], ExcitationEvidence | None, tuple[Event, ...]]:
    """The excitations of a flight, in order; `trim` before the first of them; and the losses known by then. table: its ticks; B (4, n);
    dynamics: learned from the vehicle's healthy flights.

    Gains and noise are those of the default estimator when the first excitation began: from the response of weak rotors it would learn
    wrong gains."""
    N = null_space.null_space(B)
    full = table.thrust * table.hover[:, None]
    usable = (table.mode == ASSESS) & table.valid[:, 3] & (full < AT_LIMIT).all(axis=1) & (full > 0.0).all(axis=1)
    if not N.shape[1] or usable.sum() * table.dt < 2.0 * ASIDE_S:
        return (), None, ()
    q = _unneeded(table, N, usable)
    spans = _spans(table, usable & (np.abs(q).max(axis=1) > LEAST))
    if not spans:
        return (), None, ()
    before = until(table, spans[0][0])
    carry, out = estimate(before, B, dynamics)
    model = _model(carry, table, B)
    responses = []
    for a, b in spans:
        near = (table.time > table.time[a] - ASIDE_S) & (table.time < table.time[b] + ASIDE_S) & usable
        rows = np.flatnonzero(near)[:LONGEST]
        if rows.size * table.dt >= SHORTEST_S:
            span = float(table.command_time[a]), float(table.time[b])
            responses.append(_response(rows, span, q, model, table, B))
    return tuple(responses), trim(carry, out, before, B), read(out, before, B)


def trim(carry, out, table: Ticks, B: np.ndarray) -> ExcitationEvidence | None:
    """Change of the trim wrench since the flight was first assessed, as information on losses that began since then; its uncertainty is
    that of the wrench after a loss, and of this flight's random disturbances. None where nothing was assessed."""
    lacking, sd = shift(carry, out, table)
    if lacking is None:
        return None
    J, z = (B.T / sd**2) @ B, (B.T / sd**2) @ lacking
    D = len(DELAYS_S)
    return ExcitationEvidence(float(table.time[0]), float(table.time[-1]), np.tile(J, (D, 1, 1)), np.tile(z, (D, 1)))


def shift(carry, out, table: Ticks) -> tuple[np.ndarray | None, np.ndarray]:
    """Growth of the commanded trim wrench (4,) since the hop was first assessed, and its standard deviation (4,)."""
    sd = np.sqrt(TRIM_SD**2 + carry.spread)
    starts = np.flatnonzero(table.restart)
    assessed = (table.mode == ASSESS) & (np.arange(len(table.time)) >= (starts[-1] if starts.size else 0))
    time, biases = table.time[assessed], np.asarray(out.biases)[assessed]
    if time.size == 0 or time[-1] - time[0] < 2.0 * TRIM_S:
        return None, sd
    return biases[time > time[-1] - TRIM_S].mean(axis=0) - biases[time < time[0] + TRIM_S].mean(axis=0), sd


def until(table: Ticks, k: int) -> Ticks:
    """The ticks before tick k."""
    whole = {f.name: getattr(table, f.name) for f in fields(table)}
    return replace(table, **{name: v[:k] for name, v in whole.items() if isinstance(v, np.ndarray)})


def _unneeded(table: Ticks, N: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """q (T, n): thrusts in the null space, less their regression on the commanded wrench (twice: the first one includes excitations)."""
    excess = table.thrust @ N
    inputs = np.column_stack([table.wrench, np.ones(len(excess))])
    calm, q = usable, (excess - median(excess[usable], axis=0)) @ N.T
    for _ in range(2):
        if calm.sum() < 4 * inputs.shape[1]:
            break
        K = np.linalg.lstsq(inputs[calm], excess[calm], rcond=None)[0]
        q = (excess - inputs @ K) @ N.T
        calm = usable & (np.abs(q).max(axis=1) < 0.5 * LEAST)
    return q


def _spans(table: Ticks, responses: np.ndarray) -> list[tuple[int, int]]:
    """First and last ticks of spells that are no more than GAP_S apart and last SHORTEST_S."""
    ticks = np.flatnonzero(responses)
    if not ticks.size:
        return []
    breaks = np.flatnonzero(np.diff(table.time[ticks]) > GAP_S)
    starts, ends = ticks[np.r_[0, breaks + 1]], ticks[np.r_[breaks, ticks.size - 1]]
    return [(int(a), int(b)) for a, b in zip(starts, ends) if table.time[b] - table.time[a] >= SHORTEST_S]


class _Model(NamedTuple):
    """left (T,): e; more (T, n): factor on q of the thrust that the lower rotors of coaxial arms add, per unit of their uncertain share,
    whose standard deviation is sd; noise."""

    left: np.ndarray
    more: np.ndarray
    sd: float
    noise: null_space.Noise


def _model(carry, table: Ticks, B: np.ndarray) -> _Model:
    """e with the gain and, on coaxial frames, the lower rotors' share of `carry`."""
    n, lower = B.shape[1], lower_rotors(B)
    s, P = np.asarray(carry.s), np.asarray(carry.P)
    left = table.wrench[:, 3] - s[3 * PER_AXIS + GAIN] * n * table.load
    extra, sd = np.zeros(n), 0.0
    if lower is not None:
        extra = B[3] * (lower - (B[3] * lower).mean())
        left, sd = left + s[SHARE] * (table.thrust @ extra), float(np.sqrt(P[SHARE, SHARE]))
    return _Model(left, extra, sd, null_space.Noise(np.asarray(carry.variances)[:, 3], np.array(TAU)))


def _response(rows, span, q, model: _Model, table: Ticks, B: np.ndarray) -> ExcitationEvidence:
    """The information of one excitation, seen at ticks `rows`."""
    n, time, here = B.shape[1], table.time, rows - rows[0]
    J, z = [], []
    whiten = np.linalg.cholesky(null_space.covariance(model.noise, here[-1] + 1, table.dt)[np.ix_(here, here)])
    for delay in DELAYS_S:
        late = np.column_stack([np.interp(time[rows] - delay, time, q[:, i]) for i in range(n)])
        white = np.linalg.solve(whiten, np.column_stack([B[3] * late, late @ model.more * model.sd, model.left[rows]]))
        phi, share, e = white[:, :n], white[:, n], white[:, n + 1]
        scale = max(1.0, _unexplained(white[:, : n + 1], e))
        # The lower rotors' share is integrated out; its prior is of variance one here.
        known = share / (scale + share @ share)
        J.append((phi.T @ phi - np.outer(phi.T @ share, known @ phi)) / scale)
        z.append((phi.T @ e - phi.T @ share * (known @ e)) / scale)
    return ExcitationEvidence(span[0], span[1], np.stack(J), np.stack(z))


def _unexplained(phi: np.ndarray, e: np.ndarray) -> float:
    """Mean square of the residual of e (T,) after its best fit by phi (T, k): one where the noise is as modelled."""
    fit = phi @ np.linalg.lstsq(phi, e, rcond=1e-6)[0]
    return float(((e - fit) ** 2).sum() / max(len(e) - min(phi.shape), 1))


class Prior(NamedTuple):
    """Losses of the rotors of a set before the excitation: mean (n,) and sd (n,); the others have 0 and UNLIKE."""

    mean: np.ndarray
    sd: np.ndarray


def prior(rotors: Sequence[int], n: int, losses: np.ndarray | None = None) -> Prior:
    """Prior of a set (0-based): with the losses (n,) that hover has shown, or a general one."""
    named = np.isin(np.arange(n), list(rotors))
    if losses is None:
        return Prior(np.zeros(n), np.where(named, hypotheses.LOSS_WIDTH, UNLIKE))
    spread = hypotheses.RECOVERY_SHARE * np.max(losses, initial=0.0) + LOSS_SD
    return Prior(np.where(named, losses, 0.0), np.where(named, spread, UNLIKE))


def evidence(responses: Sequence[ExcitationEvidence], rotors: Sequence[int], before: Prior) -> tuple[float, np.ndarray, np.ndarray]:
    """Log evidence that these rotors (0-based) are weak, against none; and the posterior mean (n,) and covariance (n, n) of all losses."""
    n, named = len(before.mean), list(rotors)
    J, z = (np.sum([getattr(response, name) for response in responses], axis=0) for name in ("J", "z"))
    total, base, mean, cov = [], [], [], []
    none = np.full(n, UNLIKE)
    for own_J, own_z in zip(J, z, strict=True):
        log, m, P = _gaussian(own_J, own_z, before.mean, before.sd)
        above = _positive(m[named], P[np.ix_(named, named)])
        above /= _positive(before.mean[named], np.diag(before.sd[named] ** 2))
        total.append(log + np.log(max(above, 1e-300)))
        base.append(_gaussian(own_J, own_z, np.zeros(n), none)[0])
        mean.append(m)
        cov.append(P)
    k = int(np.argmax(total))
    return float(np.logaddexp.reduce(total) - np.logaddexp.reduce(base)), mean[k], cov[k]


def _positive(mean: np.ndarray, cov: np.ndarray) -> float:
    """Probability that all of one or two Gaussian numbers, mean (k,) and cov (k, k), are above 0."""
    sd = np.sqrt(np.diag(cov))
    if not len(mean):
        return 1.0
    if len(mean) == 1:
        return float(normal_cdf(mean[0] / sd[0]))
    x = np.linspace(max(0.0, mean[0] - 8.0 * sd[0]), max(0.0, mean[0]) + 8.0 * sd[0], 401)
    density = np.exp(-0.5 * ((x - mean[0]) / sd[0]) ** 2) / (sd[0] * np.sqrt(2.0 * np.pi))
    slope = cov[0, 1] / cov[0, 0]
    rest = np.sqrt(max(cov[1, 1] - slope * cov[0, 1], 1e-18))
    joint = density * normal_cdf((mean[1] + slope * (x - mean[0])) / rest)
    return float(np.diff(x) @ (joint[1:] + joint[:-1]) / 2)


def _gaussian(J: np.ndarray, z: np.ndarray, mean: np.ndarray, sd: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Log evidence of losses that are Gaussian, mean (n,) and sd (n,), against losses of exactly 0; and their posterior."""
    A = np.eye(len(z)) + sd[:, None] * J * sd[None, :]
    y = sd * (z - J @ mean)
    x = np.linalg.solve(A, y)
    log = mean @ z - 0.5 * mean @ J @ mean + 0.5 * y @ x - 0.5 * np.linalg.slogdet(A)[1]
    return float(log), mean + sd * x, sd[:, None] * np.linalg.inv(A) * sd[None, :]


def shares(
    responses: Sequence[ExcitationEvidence], named: dict[tuple[int, ...], np.ndarray], n: int, before: ExcitationEvidence | None = None
) -> dict[tuple[int, ...], float]:
    """Probability of each set of weak rotors (0-based; (): none): the named ones, with the losses (n,) that hover gives them, all single
    rotors and all pairs. before: the trim, which a loss since then has changed and an older one has not."""
    logs: dict[tuple[int, ...], float] = {(): 0.0}
    for who in (*combinations(range(n), 1), *combinations(range(n), 2)):
        old = evidence(responses, who, prior(who, n))[0]
        new = evidence([*responses, before], who, prior(who, n))[0] if before else old
        logs[who] = np.log(OTHER) + np.logaddexp(old, new) - np.log(2.0)
    for who, losses in named.items():
        weight = CONTAINS if any(set(other) < set(who) for other in named) else 1.0
        logs[who] = np.logaddexp(logs.get(who, -np.inf), np.log(weight) + evidence(responses, who, prior(who, n, losses))[0])
    top = max(logs.values())
    weights = {who: float(np.exp(v - top)) for who, v in logs.items()}
    total = sum(weights.values())
    return {who: w / total for who, w in sorted(weights.items(), key=lambda item: -item[1])}


def candidates(event: Event, B: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """The sets of rotors (0-based) that may explain an event, each with the losses (n,) that explain the deficit of thrust and moment in
    hover, by non-negative least squares. B (4, n)."""
    n = B.shape[1]
    lacking = B[:, [r - 1 for r in event.rotors]] @ np.array(event.loss)
    sets = {}
    for who in (event.rotors, *event.alternatives):
        members = sorted(r - 1 for r in who)
        losses = np.zeros(n)
        losses[members] = np.minimum(least_squares(B[:, members], lacking)[0], 1.0)
        if who is event.rotors or losses.max() > hypotheses.NONE:  # a set that explains nothing in hover is no candidate
            sets[tuple(members)] = losses
    return sets


def resolve(events: Sequence[Event], table: Ticks, B: np.ndarray, dynamics=None) -> tuple[tuple[Event, ...], tuple[str, ...]]:
    """The losses of a flight, updated by the evidence of its excitations, and sentences on events that no rotor caused.

    Ambiguous events are resolved where an excitation after them shows which rotors it was, and so are those announced during an excitation
    (weak rotors respond to it by apparent jumps of others); losses that only an excitation shows are added. Without an excitation the
    events are unchanged. table, B, dynamics: as for `find`."""
    responses, before, known = find(table, B, dynamics)
    if not responses:
        return tuple(events), ()
    open_ = {e.detected_s: e for e in known if e.alternatives}
    result, notes = [], []
    for e in events:
        if not e.alternatives and e.detected_s in open_ and e.end_s is None:
            e = open_[e.detected_s]  # the excitation has distorted the weights of its explanations since
        during = [q for q in responses if q.start < e.detected_s < q.end + AFTER_S]
        later = [q for q in responses if q.start > e.onset_s and (e.end_s is None or q.end < e.end_s)]
        if not during and (not e.alternatives or not later):
            result.append(e)
            continue
        later = later or during
        resolved, note = _resolved(e, later, B)
        result += [resolved] if resolved else []
        notes += [note] if note else []
    if not result:
        loss, note = _unseen(responses, before, B)
        result += [loss] if loss and not notes else []
        notes += [note] if note and not notes else []
    return tuple(result), tuple(notes)


def _unsure(event: Event, posterior: dict[tuple[int, ...], float], extra: dict) -> Event:
    """The event with all remaining sets as alternatives, its own first: it stays, or becomes, ambiguous."""
    if event.alternatives:
        return replace(event, extra=extra)
    named = tuple(sorted(event.rotors))
    left = [tuple(k + 1 for k in who) for who, p in posterior.items() if who and p >= CREDIBLE]
    others = tuple(who for who in left if who != named)
    names = ", ".join("+".join(map(str, who)) for who in others)
    reason = (
        f"during the excitation, commands and motion changed as if rotor {' and '.join(map(str, event.rotors))} had lost thrust, "
        f"but {names} would look the same"
    )
    return replace(event, alternatives=others, reason=reason, extra=extra) if others else replace(event, extra=extra)


def _unseen(responses: Sequence[ExcitationEvidence], before: ExcitationEvidence | None, B: np.ndarray) -> tuple[Event | None, str]:
    """The loss that only the excitations show, from since the flight was assessed (the trim `before` has then changed as well) or from
    before; otherwise None and, where that is certain, the sentence that there is none."""
    n = B.shape[1]
    posterior = shares(responses, {}, n, before)
    best, share = next(iter(posterior.items()))
    when = _when(responses)
    if not best:
        well = f"the excitation of the commands from {when} drew the response of a vehicle with healthy rotors"
        return None, well if share > CERTAIN else ""
    whole = [responses, *([[*responses, before]] if before else [])]
    _, mean, cov = max((evidence(some, best, prior(best, n)) for some in whole), key=lambda weighed: weighed[0])
    loss, bounds = _losses(best, mean, cov, B)
    if posterior[()] > 1.0 - CERTAIN or max(low for low, _ in bounds) < UNLIKE:
        return None, ""
    others = tuple(tuple(k + 1 for k in who) for who, p in posterior.items() if who != best and p >= CREDIBLE)
    who = tuple(k + 1 for k in best)
    reason = f"the excitation of the commands from {when} drew the response of a vehicle with weak rotor {' and '.join(map(str, who))}"
    reason += f", but {', '.join('+'.join(map(str, o)) for o in others)} would look the same" if others else ""
    extra = {"asked": _extra(responses, posterior)}
    start, end = responses[0].start, responses[-1].end
    return Event(LOSS, who, start, end, None, loss, bounds, share, others, reason, extra, SOURCE), ""


def _when(responses: Sequence[ExcitationEvidence]) -> str:
    return f"{responses[0].start:.1f} to {responses[-1].end:.1f} s"


def _extra(responses: Sequence[ExcitationEvidence], posterior: dict[tuple[int, ...], float]) -> dict:
    """For an event's `extra`: the time of the excitation, and the probabilities of the remaining sets."""
    left = {"+".join(str(k + 1) for k in who) or "none": round(p, 6) for who, p in posterior.items() if p > 1e-3}
    return {"start_s": responses[0].start, "end_s": responses[-1].end, "probability": left}


def _losses(who: tuple[int, ...], mean: np.ndarray, cov: np.ndarray, B: np.ndarray) -> tuple[tuple, tuple]:
    """Losses of the rotors `who` (0-based) and their 95 % intervals."""
    index = list(who)
    loss = np.clip(mean[index], 0.0, 1.0)
    sd = sd_of(loss, np.sqrt(np.diag(cov)[index]), B)
    bounds = tuple((max(0.0, float(v - WITHIN_95 * s)), min(1.0, float(v + WITHIN_95 * s))) for v, s in zip(loss, sd, strict=True))
    return tuple(float(v) for v in loss), bounds


def _resolved(event: Event, responses: Sequence[ExcitationEvidence], B: np.ndarray) -> tuple[Event | None, str]:
    named = candidates(event, B)
    n = B.shape[1]
    posterior = shares(responses, named, n)
    best, share = next(iter(posterior.items()))
    when, extra = _when(responses), {**event.extra, "asked": _extra(responses, posterior)}
    if share < CERTAIN:
        return _unsure(event, posterior, extra), ""
    if not best:
        return None, (
            f"a shift of thrust at {event.onset_s:.1f} s might have come from rotors {'+'.join(map(str, event.rotors))} or others; the "
            f"excitation of the commands from {when} drew the response of a vehicle with healthy rotors"
        )
    _, mean, cov = evidence(responses, best, prior(best, n, named.get(best)))
    loss, bounds = _losses(best, mean, cov, B)
    who = tuple(k + 1 for k in best)
    names = " and ".join(map(str, who))
    reason = (
        f"commands and motion changed at {event.onset_s:.1f} s as if rotors had lost thrust, and the excitation of the commands "
        f"from {when} drew a response that only weak rotors {names} give"
    )
    return replace(event, rotors=who, loss=loss, interval=bounds, probability=share, alternatives=(), reason=reason, extra=extra), ""


def _hear(view: View, losses: Events) -> Events:
    if view.table is None or not view.over or not view.default or not view.hovers:
        return losses
    resolved, notes = resolve(losses, view.table, view.B, view.dynamics)
    view.assumptions += notes
    return resolved


WITNESSES = (Witness("excitation", Stage.CLAIMS, 10, _hear),)  # the first: it resolves the estimator's losses
