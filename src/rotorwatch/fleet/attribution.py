"""Changes of an aircraft, their times and certainty: the balance of commands over its flights explained by wear, damage and shifted
weights.

For flight k, w_k is the wrench (roll, pitch, yaw) that its commands ask for in steady hover, as a share of the thrust
(witnesses/healthy/whole_flight.py), without the wind's part. A rotor that gives 1 - theta of its thrust is commanded 1 / (1 - theta) as
much, of a sum that grows by it, so that with e = theta / (1 - (1 - s_i) theta)

    w_k = mu + sum_i g_i e_i(k) + c(k) + noise_k,      g_i = s_i (B_i - mu): s_i the rotor's share of the thrust, B_i its column,

c: a shifted centre of mass, which moves roll and pitch but not yaw. Possible changes are a list of atoms, each with its first flight k0:

    step     e_i is larger by d from flight k0 on             damage; smaller, where it was large: exchanged without a note
    wear     e_i grows by s an hour in the air from k0 on     until rotor i is serviced
    centre   c is another vector from flight k0 on            a payload, a battery moved

A service begins a new level of its rotors, near the old one apart from the loss. Given the list, the model is linear, and its marginal
likelihood exact. The search adds the most probable atom while it is more probable than ODDS, and then moves and drops each in turn with all
others held, over every flight, until nothing changes. The evidence for rotor i is

    E_i = sum over its steps and wear, over all k0, of prior times Bayes factor, given everything that is no atom of rotor i,

divided by the same of the best other explanation where that is above 1. Its mean without a loss of rotor i is 1 at most: an e-value,
whatever the dependence between flights and however often it is evaluated.

Sources: V. Vovk and R. Wang, E-values: calibration, combination and applications, Annals of Statistics 49 (2021) 1736-1754. Exact sums over
one change at a time: P. Fearnhead, Exact and efficient Bayesian inference for multiple changepoint problems, Statistics and Computing 16
(2006) 203-213.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.fleet import scatter
from rotorwatch.fleet.prognosis import Lines
from rotorwatch.stats import multivariate_t as student
from rotorwatch.stats.tails import log_normal_cdf, normal_quantile
from rotorwatch.witnesses.healthy.whole_flight import CENTRE_RHO_SD, RHO_SD, SHIFT_SD

LOSS_SD = 0.15  # of e by a step, or by wear at the end of the history
STEPS, WEAR, CENTRES = 0.3, 0.3, 0.3  # prior mean numbers in an aircraft's history
ODDS = 20.0
MOST = 10  # atoms
LINES = 40  # onsets of wear that are evaluated
SERVICE_SD = np.sqrt(2.0) * scatter.ROTOR_SD
STEP, WORN, CENTRE = "step", "wear", "centre"


class Atom(NamedTuple):
    """A change. kind: step, wear or centre. rotor: 0-based, -1 of none. start: index of the first flight with it."""

    kind: str
    rotor: int
    start: int


@dataclass(frozen=True)
class Series:
    """An aircraft's flights in order. y (K, 3): wrench per thrust, without wind; noise (K, 3, 3): covariance of a flight's own noise and of
    the scatter between flights. hours (K,): in the air before each flight. G (3, n): the rotors' columns. use (K,): which flights count.
    services: (index of the first flight after it, rotor 0-based or -1 for all). level, level_covariance: of healthy aircraft of the build,
    or None."""

    y: np.ndarray
    noise: np.ndarray
    hours: np.ndarray
    G: np.ndarray
    use: np.ndarray
    services: tuple[tuple[int, int], ...] = ()
    level: np.ndarray | None = None
    level_covariance: np.ndarray | None = None

    def cuts(self, rotor: int) -> list[int]:
        """Boundaries of a rotor's history: 0, each service, K."""
        return sorted({0, len(self.y), *(k for k, r in self.services if r in (rotor, -1))})

    def profile(self, atom: Atom) -> np.ndarray:
        """(K,) factor of the atom's coefficient at each flight."""
        K = len(self.y)
        end = K if atom.rotor < 0 else next(c for c in self.cuts(atom.rotor) if c > atom.start)
        out = np.zeros(K)
        out[atom.start : end] = 1.0 if atom.kind != WORN else self.hours[atom.start : end] - self._before(atom.start)
        return out

    def _before(self, k: int) -> float:
        """Hours at the onset of wear that shows from flight k on: one flight earlier, so that it shows in flight k itself."""
        return float(self.hours[k - 1]) if k else float(self.hours[0] - self.mean_hours)

    @property
    def mean_hours(self) -> float:
        """Mean hours of a flight."""
        return float(self.hours[-1] - self.hours[0]) / max(len(self.hours) - 1, 1) or 1.0


@dataclass(frozen=True)
class Found:
    """atoms, coefficients (e, e per hour, or (roll, pitch)) and their probabilities; candidates: {class: probability} of each atom.

    e (K, n): extra command of each rotor by the atoms; now (n,), now_sd (n,): at the last flight; own (K, n): single flights' estimates of
    e, without everything that is not this rotor's, and own_sd (K, n). evidence (n,): log E_i. level (3,): mu. rest (K, 3): residual in
    standard deviations. weight (K,): of each flight. when: (first, last) index of the onset of each atom, 95 %."""

    atoms: tuple[Atom, ...]
    coefficients: tuple[np.ndarray, ...]
    candidates: tuple[dict[int, float], ...]
    when: tuple[tuple[int, int], ...]
    e: np.ndarray
    now: np.ndarray
    now_sd: np.ndarray
    hidden: np.ndarray
    own: np.ndarray
    own_sd: np.ndarray
    evidence: np.ndarray
    level: np.ndarray
    level_covariance: np.ndarray
    rest: np.ndarray
    weight: np.ndarray


def loss(e: Any, n: int) -> Any:
    """theta of rotors with extra command e, of n that share the thrust alike; below 0 for estimates that scatter about 0."""
    return e / (1.0 + (1.0 - 1.0 / n) * np.maximum(e, -0.5))


def explain(series: Series) -> Found:
    """The most probable history of an aircraft, and the evidence for a loss of each of its rotors."""
    weight = np.ones(len(series.y))
    weight[series.use] = scatter.alone(series.y[series.use], series.noise[series.use])
    atoms: tuple[Atom, ...] = ()
    fit = _Fit(series, weight, atoms)
    for _ in range(2):
        atoms = _search(fit, atoms)
        fit = _Fit(series, weight, atoms)
        rest = series.y - fit.fitted
        weight = student.weights(rest, series.noise, scatter.NU)
        fit = _Fit(series, weight, atoms)
    atoms = _polished(fit, atoms)
    return _found(_Fit(series, weight, atoms), atoms)


class _Fit:
    """The solved linear model of a list of atoms, and the gain of any further atom."""

    def __init__(self, series: Series, weight: np.ndarray, atoms: tuple[Atom, ...]):
        self.series, self.weight, self.atoms = series, weight, atoms
        root = np.sqrt(np.where(series.use, weight, 0.0))
        self.W = np.linalg.inv(np.linalg.cholesky(series.noise)) * root[:, None, None]  # (K, 3, 3)
        self.g = self.W @ series.G  # (K, 3, n)
        X, ridge = self._design()
        self.D = self.W @ X  # (K, 3, q)
        self.y = np.einsum("kij,kj->ki", self.W, series.y)
        self.A = np.einsum("kip,kiq->pq", self.D, self.D) + np.diag(ridge)
        b = np.einsum("kip,ki->p", self.D, self.y)
        if series.level is not None and series.level_covariance is not None:
            inverse = np.linalg.inv(series.level_covariance)
            self.A[:3, :3] += inverse
            b[:3] += inverse @ series.level
        else:
            self.A[:3, :3] += 1e-6 * np.eye(3)
        self.covariance = np.linalg.inv(self.A)
        self.beta = self.covariance @ b
        self.left = self.y - self.D @ self.beta
        self.fitted = X @ self.beta

    def _design(self) -> tuple[np.ndarray, np.ndarray]:
        """(K, 3, q) the unweighted columns of the model, and each one's prior precision (q,); `where`: the first column of each atom."""
        s, eye = self.series, np.eye(3)
        K, n = len(s.y), s.G.shape[1]
        columns, ridge = [np.broadcast_to(eye, (K, 3, 3))], [0.0] * 3  # mu
        for k, r in s.services:
            for i in range(n) if r < 0 else (r,):
                p = s.profile(Atom(STEP, i, k)) if k < K else np.zeros(K)
                columns.append(p[:, None, None] * s.G[None, :, i, None])
                ridge.append(SERVICE_SD**-2)
        self.where = []
        for atom in self.atoms:
            self.where.append(len(ridge))
            shape = eye if atom.kind == CENTRE else s.G[:, atom.rotor, None]
            columns.append(s.profile(atom)[:, None, None] * shape)
            yaw = (CENTRE_RHO_SD * 0.5 * SHIFT_SD) ** -2
            ridge += [SHIFT_SD**-2, SHIFT_SD**-2, yaw] if atom.kind == CENTRE else [self.precision(atom)]
        # Torque need not fall as thrust does: a rotor's yaw is known to RHO_SD only, relative to its total loss.
        for i in sorted({a.rotor for a in self.atoms if a.rotor >= 0}):
            mine = [s.profile(a) for a in self.atoms if a.rotor == i]
            p = np.clip(np.sum([v / max(v.max(), 1e-9) for v in mine], axis=0), 0.0, 1.0)
            columns.append(p[:, None, None] * (eye[:, 2:] * s.G[2, i]))
            ridge.append((RHO_SD * 0.5 * LOSS_SD) ** -2)
        return np.concatenate(columns, axis=2), np.array(ridge)

    def precision(self, atom: Atom) -> float:
        """Prior precision of a rotor's atom: LOSS_SD at the end of its profile."""
        p = self.series.profile(atom)
        return (LOSS_SD / max(float(p.max()), 1e-9)) ** -2

    def odds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Log of prior times Bayes factor of a further atom: steps (n, K), wear (n, K), centre (K,); and (n, K) the steps that are
        gains."""
        s = self.series
        K, n = len(s.y), s.G.shape[1]
        flights = max(int(s.use.sum()), 1)
        steps, wear, gains = (np.full((n, K), -np.inf) for _ in range(3))
        lost = self.extra()
        for i in range(n):
            g = self.g[:, :, i]
            r, c, d = (g * self.left).sum(axis=1), (g * g).sum(axis=1), np.einsum("ki,kiq->kq", g, self.D)
            for a, b in itertools.pairwise(s.cuts(i)):
                part, h = slice(a, b), s.hours[a:b]
                h0 = np.array([s._before(k) for k in range(a, b)])
                R0, R1, C0, C1, C2 = (_after(x) for x in (r[part], h * r[part], c[part], h * c[part], h * h * c[part]))
                D0, D1 = _after(d[part]), _after(h[:, None] * d[part])
                # Without sisters a loss from the first flight on is part of the level.
                loss = _log_factor(R0, C0 - _through(D0, self.covariance), np.full(b - a, LOSS_SD))
                steps[i, part] = loss[0]
                gains[i, part] = np.where(lost[part, i] > 0.0, loss[1], -np.inf)
                information = C2 - 2 * h0 * C1 + h0**2 * C0 - _through(D1 - h0[:, None] * D0, self.covariance)
                slope_sd = LOSS_SD / np.maximum(max(float(s.hours[b - 1]), 1e-9) - h0, 1e-9)
                wear[i, part] = _log_factor(R1 - h0 * R0, information, slope_sd)[0]
        steps += np.log(STEPS / (n * flights))
        gains += np.log(STEPS / (n * flights))
        wear += np.log(WEAR / (n * flights))
        wear[:, 0] += np.log1p(0.5 * flights)  # as often from the first flight on as later
        W2 = self.W[:, :, :2]
        r = _after(np.einsum("kij,ki->kj", W2, self.left))
        c = _after(np.einsum("kij,kil->kjl", W2, W2).reshape(K, 4)).reshape(K, 2, 2)
        d = _after(np.einsum("kij,kiq->kjq", W2, self.D).reshape(K, -1)).reshape(K, 2, -1)
        c = c - np.einsum("kip,pq,kjq->kij", d, self.covariance, d)
        full = c + np.eye(2) * SHIFT_SD**-2
        centre = 0.5 * np.einsum("ki,ki->k", r, np.linalg.solve(full, r[..., None])[..., 0])
        centre -= 0.5 * np.linalg.slogdet(full * SHIFT_SD**2)[1]
        centre += np.log(CENTRES / flights)
        centre[0] = -np.inf  # an aircraft's own centre is its level
        return steps, wear, centre, gains

    def extra(self) -> np.ndarray:
        """(K, n): e of each rotor by its atoms."""
        out = np.zeros((len(self.series.y), self.series.G.shape[1]))
        for atom, at in zip(self.atoms, self.where):
            if atom.rotor >= 0:
                out[:, atom.rotor] += self.series.profile(atom) * self.beta[at]
        return out


def _after(x: np.ndarray) -> np.ndarray:
    """Sums from each row to the last."""
    return np.cumsum(x[::-1], axis=0)[::-1]


def _through(d: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("kp,pq,kq->k", d, covariance, d)


def _log_factor(num: np.ndarray, information: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log Bayes factors of a coefficient with a half-normal prior of scale tau: above 0, and below 0."""
    information = np.maximum(information, 0.0)
    total = information + tau**-2
    both = 0.5 * num**2 / total - 0.5 * np.log(total * tau**2)
    z = num / np.sqrt(total)
    return both + np.log(2.0) + log_normal_cdf(z), both + np.log(2.0) + log_normal_cdf(-z)


def _classes(fit: _Fit) -> tuple[np.ndarray, list[Atom]]:
    """Log odds of a loss or gain of each rotor and, last, of the centre (n + 1,), summed over flights; and the best atom of each."""
    steps, wear, centre, gains = fit.odds()
    n = len(steps)
    rows, best = [], []
    for i in range(n):
        by_kind = {STEP: np.logaddexp(steps[i], gains[i]), WORN: wear[i]}
        rows.append(np.logaddexp.reduce([v for one in by_kind.values() for v in one]))
        kind = max(by_kind, key=lambda k: by_kind[k].max())
        best.append(Atom(kind, i, int(np.argmax(by_kind[kind]))))
    rows.append(np.logaddexp.reduce(centre))
    best.append(Atom(CENTRE, -1, int(np.argmax(centre))))
    return np.array(rows), best


def _search(fit: _Fit, atoms: tuple[Atom, ...]) -> tuple[Atom, ...]:
    """Atoms added while one is probable; after each addition the earlier ones are polished."""
    while len(atoms) < MOST:
        odds, best = _classes(_Fit(fit.series, fit.weight, atoms))
        top = int(np.argmax(odds))
        if odds[top] < np.log(ODDS) or best[top] in atoms:
            break
        atoms = _polished(fit, (*atoms, best[top]))
    return atoms


def _polished(fit: _Fit, atoms: tuple[Atom, ...]) -> tuple[Atom, ...]:
    """Each atom moved to its most probable flight given the others, or dropped."""
    for _ in range(6):
        before = atoms
        for atom in before:
            if atom not in atoms:
                continue
            rest = tuple(a for a in atoms if a != atom)
            odds, best = _classes(_Fit(fit.series, fit.weight, rest))
            top = int(np.argmax(odds))
            atoms = rest if odds[top] < np.log(ODDS) or best[top] in rest else (*rest, best[top])
        if set(atoms) == set(before):
            break
    return tuple(sorted(atoms, key=lambda a: (a.start, a.rotor, a.kind)))


def _found(fit: _Fit, atoms: tuple[Atom, ...]) -> Found:
    s = fit.series
    n = s.G.shape[1]
    e = fit.extra()
    coefficients = tuple(fit.beta[at : at + (2 if atom.kind == CENTRE else 1)] for atom, at in zip(atoms, fit.where))
    candidates, when = [], []
    for atom in atoms:
        without = _Fit(s, fit.weight, tuple(a for a in atoms if a != atom))
        odds, _ = _classes(without)
        share = np.exp(odds - odds.max())
        share /= share.sum() + np.exp(-odds.max())
        candidates.append({(i if i < n else -1): float(p) for i, p in enumerate(share) if p > 0.01})
        when.append(_when(without, atom))
    evidence = np.zeros(n)
    for i in range(n):
        rest = tuple(a for a in atoms if a.rotor != i)
        odds, _ = _classes(_Fit(s, fit.weight, rest))
        others = max(0.0, float(np.delete(odds, i).max()))
        evidence[i] = odds[i] - others
    last = np.zeros((n, len(fit.beta)))
    for atom, at in zip(atoms, fit.where):
        if atom.rotor >= 0:
            last[atom.rotor, at] = s.profile(atom)[-1]
    now_sd = np.sqrt(np.maximum(np.einsum("np,pq,nq->n", last, fit.covariance, last), 0.0))
    # Each flight's own estimate of each rotor's e, with all else as explained.
    inverse = np.linalg.inv(s.noise)
    information = np.einsum("in,kij,jn->kn", s.G, inverse, s.G)
    single = e + np.einsum("in,kij,kj->kn", s.G, inverse, s.y - fit.fitted) / information
    rest = np.einsum("kij,kj->ki", np.linalg.inv(np.linalg.cholesky(s.noise)), s.y - fit.fitted)
    return Found(
        atoms, coefficients, tuple(candidates), tuple(when), e, e[-1], now_sd, _hidden(fit), single, information**-0.5, evidence,
        fit.beta[:3], fit.covariance[:3, :3], rest, fit.weight,
    )  # fmt: skip


def _when(without: _Fit, atom: Atom) -> tuple[int, int]:
    """95 % interval of the first flight of an atom, given its kind and rotor."""
    steps, wear, centre, gains = without.odds()
    row = centre if atom.kind == CENTRE else (wear if atom.kind == WORN else np.logaddexp(steps, gains))[atom.rotor]
    p = np.exp(row - row.max())
    total = np.cumsum(p) / p.sum()
    return int(np.searchsorted(total, 0.025)), int(np.searchsorted(total, 0.975))


def _hidden(fit: _Fit) -> np.ndarray:
    """(n,) upper 97.5 % bound of e at the last flight, for undetected wear since the first flight or the last service."""
    s = fit.series
    out = np.zeros(s.G.shape[1])
    for i in range(len(out)):
        start = s.cuts(i)[-2]
        atom = Atom(WORN, i, min(start, len(s.y) - 1))
        if any(a.rotor == i and a.start >= start for a in fit.atoms):
            continue
        p = s.profile(atom)
        column = (p[:, None] * fit.g[:, :, i]).reshape(-1)
        D = fit.D.reshape(column.size, -1)
        information = column @ column - (column @ D) @ fit.covariance @ (D.T @ column) + fit.precision(atom)
        mean, sd = float(column @ fit.left.reshape(-1)) / information, information**-0.5
        out[i] = (mean + sd * normal_quantile(0.975, -mean / sd)) * p[-1]  # a loss is not below 0
    return out


def lines(series: Series, found: Found, rotor: int) -> Lines | None:
    """The possible lines of the loss of a wearing rotor, one for each possible onset of the wear; None without wear."""
    since = series.cuts(rotor)[-2]
    live = [a for a in found.atoms if a.rotor == rotor and a.kind == WORN and a.start >= since]
    if not live:
        return None
    rest = tuple(a for a in found.atoms if a != live[-1])
    row = _Fit(series, found.weight, rest).odds()[1][rotor, since:]
    p = np.exp(row - row.max())
    starts = [int(k) for k in np.argsort(-p, kind="stable")[:LINES] if p[k] > 1e-3]
    found_lines, n = [], series.G.shape[1]
    for k in starts:
        atom = Atom(WORN, rotor, since + k)
        fit = _Fit(series, found.weight, (*rest, atom))
        at, last = fit.where[-1], np.zeros(len(fit.beta))
        for one, place in zip(fit.atoms, fit.where):
            if one.rotor == rotor:
                last[place] = series.profile(one)[-1]
        hours = float(last[at])
        e, part = float(last @ fit.beta), float(hours * fit.beta[at])
        # In the loss itself wear is a line, not in the extra command.
        slope = (1.0 + (1.0 - 1.0 / n) * max(e, 0.0)) ** -2
        J = np.stack([last, np.eye(len(last))[at]])
        growth = float(loss(e, n) - loss(e - part, n)) / hours
        found_lines.append((p[k], float(loss(e, n)), growth, J @ fit.covariance @ J.T * slope**2))
    weight, now, growth, covariances = (np.array(column) for column in zip(*found_lines))
    return Lines(weight / weight.sum(), now, growth, covariances)
