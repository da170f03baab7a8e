"""The odds of an explanation: its prior log weight and its evidence, and what follows from them for a claim.

With the evidence log p_e of explanation e (`engine.estimator.explanations`), its log weight w_e, and the log-odds h_i by which others
testify to a loss of rotor i (`View.testimony`), summed over the rotors that lose thrust under e,

    P(loss of these rotors) = sum of exp(w_e + b log p_e + h_e) over explanations with it / sum over all

`rotorwatch fit-odds` fits the weights and the temper b to flights whose truth is known (docs/tuning.md). Where the rest is ten times
likelier, the loss is no event. Where it is not ten times less likely, it is an open claim, and where another rotor is not, that rotor is an
alternative. An open claim that is sure and exceeds all else by a margin becomes an event, and one that is not credible is dropped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.engine.bindings.explaining import Explanation, Fit
from rotorwatch.engine.events.decisions import CLEAR
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.flight.kinds import SUREST

COMMON = "common"  # all rotors lose thrust, each as much as the motion says: if none of them exceeds the others, a claim of one is open
# Log weights by the first word of an explanation's name, relative to a loss of one particular rotor. Added are "beside" for two at once,
# which have both their weights, "pushed" where a push is one of them, and "claimed" where the rotors are those of an announced loss.
WEIGHTS: dict[str, float] = {
    "loss": 0.0, "growing": 0.4, "stuck": 0.6, "capped": -3.2, "slow": -3.5, "turned": -2.8,
    "nothing": 4.0, "step": -0.6, "push": -1.7, "shift": -4.0, "move": -0.5, "wrench": 0.5, COMMON: -4.0,
    "beside": -4.0, "pushed": -2.0, "claimed": 1.0,
}  # fmt: skip
TEMPER = 0.5  # the likeliest is 0.26: a weaker one halves the log loss as well, and leaves fewer true losses in doubt (docs/tuning.md)


class Limits(NamedTuple):
    """Thresholds. clear: odds from which a claim stands, and a rotor is no alternative. named: the same against no fault of its rotors
    (a turned mount of the same rotor takes part of its loss, and spares nobody): claims with odds of 10 to 50 are right seven times of
    eight, others 99 times of 100 (docs/tuning.md). sure: probability from which an open claim becomes an event, a claim that grows or is
    ambiguous is dropped, and of all else from which an open claim is. scanned: nats by which an explanation that nothing but the scan has
    pointed to must exceed all others: real motors differ in lag, and controllers follow their own noise; healthy real flights reach 8."""

    clear: float = CLEAR
    named: float = 50.0
    sure: float = 0.95
    scanned: float = 10.0


LIMITS = Limits()
# Stated odds are this power of those that decide, as with a temper of 0.28: of 4,000 flights of known truth the likeliest is 0.54 (0.58 and
# 0.48 of each half); with 1 a stated 1 to 5 % is right in 13 % of 148 answers. LEAST is stated of any rotor: motion that no explanation
# models, such as a swinging load, makes claims; of 2,311 rotors below 1e-9, 0.6 % are at fault (docs/results.md#stated-probabilities).
POWER, LEAST = 0.55, 0.006
SCAN, BESIDE = "rivals", "remainder"  # origin of claims that only the scan has made; of those of a loss beside a known one


def stated(p: float) -> float:
    """What is stated of a rotor's fault of probability p: with o = (p / (1 - p))^POWER, LEAST + (SUREST - LEAST) o / (1 + o)."""
    yes, no = max(p, 0.0) ** POWER, max(1.0 - p, 0.0) ** POWER
    return LEAST + (SUREST - LEAST) * yes / (yes + no)


def group(name: str) -> str:
    """The name in WEIGHTS of an explanation: its first word."""
    return name.partition(" ")[0]


class Rival(NamedTuple):
    """An explanation. name: its first word is one of WEIGHTS; beside: name of what acts beside it."""

    name: str
    how: Explanation
    beside: str = ""

    @property
    def weak(self) -> tuple[int, ...]:
        """The rotors that may lose thrust, from 0."""
        return () if self.how.late or self.how.turned or self.how.cap else self.how.rotors


class Row(NamedTuple):
    """A rival's result. rotors: that it names; weak: of these, those that lose thrust under it; both from 0. loss, sd: of the weak."""

    name: str
    beside: str
    rotors: tuple[int, ...]
    weak: tuple[int, ...]
    log_p: float
    loss: np.ndarray
    sd: np.ndarray

    @property
    def group(self) -> str:
        """Its name in WEIGHTS."""
        return group(self.name)


def row(rival: Rival, fit: Fit) -> Row:
    """The row of a rival's fit. A rotor does not gain thrust: the prior of a loss theta ends at 0, and the evidence of a fit whose prior
    does not is multiplied by 2 P(theta > 0). Where all may lose thrust, as by a battery that sags, those are weak that certainly lose more
    than the mean of the others."""
    n = len(fit.loss)
    usual = (fit.loss.sum() - fit.loss) / (n - 1) + WITHIN_95 * fit.sd if rival.name == COMMON else np.zeros(n)
    weak = tuple(sorted(i for i in rival.weak if fit.loss[i] > usual[i]))
    lost = rival.weak if not rival.how.gives else ()  # a stuck rotor has no loss
    log_p = fit.log_p + sum(_log_positive(fit.loss[i] / max(fit.sd[i], 1e-9)) for i in lost)
    return Row(rival.name, rival.beside, rival.how.rotors, weak, log_p, fit.loss[list(weak)], fit.sd[list(weak)])


def _log_positive(z: float) -> float:
    """log(2 Phi(z)), by its asymptote where Phi is too small."""
    return math.log(math.erfc(-z / math.sqrt(2.0))) if z > -30.0 else -0.5 * z * z - math.log(-z)


class Decision(Enum):
    """What becomes of a claim: an event that is a loss, or a slow motor; an open claim; nothing."""

    LOSS, SLOW, OPEN, DROPPED = "loss", "slow", "open", "dropped"


class Weighed(NamedTuple):
    """Probabilities: of a loss of the claimed rotors, with others or not, or of their slow response; of no loss; of these, of no fault
    of a claimed rotor; of each other set of rotors, from 0; of a slow response of each rotor. ahead: nats by which the likeliest
    explanation exceeds those of other rotors or kinds. best: the likeliest row with a size of each other set, unless one without is ten
    times likelier. common: of a loss of all rotors alike, which puts a claim in doubt and takes no part in the others."""

    claim: float
    none: float
    spared: float
    others: dict[tuple[int, ...], float]
    slow: np.ndarray
    ahead: float
    best: dict[tuple[int, ...], Row]
    common: float = 0.0

    def likeliest(self, among: Sequence[int]) -> tuple[int, ...] | None:
        """The likeliest other set of rotors, from 0, among these, from 1."""
        found = (who for who in self.others if set(who) <= {r - 1 for r in among})
        return max(found, key=lambda w: self.others[w], default=None)

    def near(self, limits: Limits = LIMITS) -> list[tuple[int, ...]]:
        """Sets of rotors, from 1, that explain the motion nearly as well as the claim."""
        return [tuple(i + 1 for i in sorted(who)) for who, p in self.others.items() if p > self.claim / limits.clear]


@dataclass(frozen=True)
class Comparison:
    """A claim and its explanations. rotors: claimed, from 1. named: a loss of them is claimed, else of any one of them. origin: source of
    the claim. grows: slowly. n: rotors of the vehicle. rows: of a named claim the first is its loss. said (n,): testimony on each rotor;
    empty: none."""

    onset_s: float
    rotors: tuple[int, ...]
    named: bool
    alternatives: tuple[tuple[int, ...], ...]
    origin: str
    grows: bool
    n: int
    rows: tuple[Row, ...]
    said: tuple[float, ...] = ()

    def logs(self, weights: Mapping[str, float] | None = None, temper: float | None = None) -> np.ndarray:
        """Log weight, evidence and testimony of each row."""
        w, b = WEIGHTS if weights is None else weights, TEMPER if temper is None else temper
        said = self.said or (0.0,) * self.n
        return np.array([sum(w[name] for name in self.weights(r)) + b * r.log_p + sum(said[i] for i in r.weak) for r in self.rows])

    def weights(self, one: Row) -> tuple[str, ...]:
        """Names in WEIGHTS of what adds to the log weight of a row."""
        other = group(one.beside)
        names = [one.group, *(("beside", other) if other else ()), *(("pushed",) if other == "push" else ())]
        return (*names, "claimed") if self.claims(one) else tuple(names)

    def weighed(self, weights: Mapping[str, float] | None = None, temper: float | None = None) -> Weighed:
        """The probabilities."""
        logs = self.logs(weights, temper)
        apart = np.array([r.group == COMMON for r in self.rows])
        alike = apart & np.array([not r.weak for r in self.rows])
        rest = float(np.logaddexp.reduce(logs[~apart]))
        common = float(np.exp(-np.logaddexp(0.0, rest - logs[alike])).sum())
        rows, logs = [r for r, out in zip(self.rows, apart) if not out], logs[~apart]
        share = np.exp(logs - rest)
        sums: dict[tuple[int, ...], float] = {}
        best: dict[tuple[int, ...], Row] = {}
        sized: dict[tuple[int, ...], float] = {}
        mine = np.array([self.claims(r) for r in rows])
        for k in np.argsort(logs, kind="stable"):
            if rows[k].weak and not mine[k]:
                sums[rows[k].weak] = sums.get(rows[k].weak, 0.0) + float(share[k])
                if rows[k].group != "stuck":  # its size is of its command's effect
                    best[rows[k].weak] = rows[k]
                    sized[rows[k].weak] = float(share[k])
        none = np.array([not r.weak for r in rows]) & ~mine
        suspects = {r - 1 for who in (self.rotors, *self.alternatives) for r in who}
        spared = none & np.array([suspects.isdisjoint(r.rotors) for r in rows])
        slow = np.zeros(self.n)
        for r, p in zip(rows, share):
            if r.group == "slow":
                slow[r.rotors[0]] += p
        kinds = [(r.weak, r.rotors if r.group == "slow" else ()) for r in rows]
        first = int(np.argmax(logs))
        ahead = logs[first] - max((x for x, kind in zip(logs, kinds) if kind != kinds[first]), default=-np.inf)
        others = {who: sums[who] for who in sorted(sums)}
        best = {who: one for who, one in best.items() if sized[who] > sums[who] / (1.0 + LIMITS.clear)}
        claim, nobody, free = (float(share[those].sum()) for those in (mine, none, spared))
        return Weighed(claim, nobody, free, others, slow, float(ahead), best, common)

    def claims(self, one: Row) -> bool:
        """True for a row under which the claimed rotors are at fault."""
        if not self.named:
            return False
        claim = tuple(r - 1 for r in self.rotors)
        if one.group in ("slow", "capped") and one.rotors == claim:
            return True
        return any(set(who) <= set(one.weak) for who in (claim, *(tuple(r - 1 for r in a) for a in self.alternatives)))

    def decided(self, found: Weighed, limits: Limits = LIMITS) -> Decision:
        """What becomes of the claim."""
        return self._confirmed(found, limits) if self.named else self._settled(found, limits)

    def _confirmed(self, found: Weighed, limits: Limits) -> Decision:
        if len(self.rotors) == 1 and found.slow[self.rotors[0] - 1] > limits.sure and found.ahead > limits.scanned:
            return Decision.SLOW
        clear = limits.clear / (1.0 + limits.clear)
        if found.none > (limits.sure if self.grows or self.alternatives else clear):
            return Decision.DROPPED
        if found.claim < 1.0 - clear:  # another rotor, or none in particular
            return Decision.OPEN if max(found.others.values(), default=0.0) > 0.5 else Decision.DROPPED
        doubted = found.spared > 1.0 / (1.0 + limits.named) or found.common > 1.0 - clear
        unsure = doubted or found.claim < 0.5 or (found.claim < clear and not found.near(limits))
        return Decision.OPEN if unsure else Decision.LOSS

    def _settled(self, found: Weighed, limits: Limits) -> Decision:
        who, slow = found.likeliest(self.rotors), int(np.argmax(found.slow))
        share = 0.0 if who is None else found.others[who]
        sure = limits.named / (1.0 + limits.named) if self.origin == BESIDE else limits.sure
        if share * (1.0 - found.common) > sure and (found.ahead > limits.scanned or self.origin != SCAN):
            return Decision.LOSS if who in found.best else Decision.OPEN
        if found.slow[slow] > limits.sure and found.ahead > limits.scanned and slow + 1 in self.rotors:
            return Decision.SLOW
        return Decision.OPEN if share > 1.0 - limits.sure else Decision.DROPPED

    def to_dict(self) -> dict[str, Any]:
        """The documented JSON structure (docs/json.md)."""
        nothing = next(r.log_p for r in self.rows if r.name == "nothing")
        found = self.weighed()
        any_of = {r - 1 for r in self.rotors}
        claimed = found.claim if self.named else sum(p for who, p in found.others.items() if any_of.intersection(who))
        return {
            "onset_s": self.onset_s, "rotors": self.rotors, "named": self.named, "alternatives": self.alternatives, "origin": self.origin,
            "grows": self.grows, "said": [round(x, 3) for x in self.said],
            "decision": self.decided(found).value, "probability": stated(claimed * (1.0 - found.common)),
            "probability_none": 1.0 - stated((1.0 - found.none) * (1.0 - found.common)),
            "explanations": [
                {
                    "name": r.name, "beside": r.beside, "rotors": [i + 1 for i in r.rotors], "weak": [i + 1 for i in r.weak],
                    "nats": r.log_p - nothing,
                }
                for r in self.rows
            ],
        }  # fmt: skip


def read(found: Mapping[str, Any], n: int) -> Comparison:
    """The comparison from `to_dict`'s output, of n rotors, without losses."""
    none = np.zeros(0)
    rows = tuple(
        Row(r["name"], r["beside"], tuple(i - 1 for i in r["rotors"]), tuple(i - 1 for i in r["weak"]), r["nats"], none, none)
        for r in found["explanations"]
    )
    alternatives = tuple(tuple(a) for a in found["alternatives"])
    return Comparison(
        found["onset_s"], tuple(found["rotors"]), found["named"], alternatives, found["origin"], found["grows"], n, rows,
        tuple(found.get("said", ())),
    )  # fmt: skip
