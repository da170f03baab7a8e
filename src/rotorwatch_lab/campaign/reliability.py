"""Reliability of stated probabilities: of all answers that state p, the share that is right.

Two statements are counted: the probability of an event's rotors (`events[].probability` of a loss or a slow response), right where all of
them are broken when it is announced; and, in every comparison of a claim, the probability of each rotor to be at fault, right where a
fault of this rotor begins there. Rotors that have been weak since before the claim are not counted, as it is about a change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import files, optional
from rotorwatch.flight.kinds import LOSS, SLOW_RESPONSE
from rotorwatch.toolkit import odds
from rotorwatch_lab.campaign import claims, odds_fit
from rotorwatch_lab.campaign.claims import HARMLESS, Flown
from rotorwatch_lab.campaign.plan import Plan, read
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.experiments.counting import EARLY_S

EDGES = (0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0)
LEAST = 50  # answers of a bin that is assessed
WITHIN = 0.03  # aim
STATEMENTS = {"event": "rotors of an event", "rotor": "a rotor at fault, in each comparison"}


class Bin(NamedTuple):
    """Answers that state a probability from `low` to `high`. stated: their mean; right: share with its interval (tools.share)."""

    statement: str
    low: float
    high: float
    stated: float
    right: dict[str, float]

    @property
    def assessed(self) -> bool:
        """True where there are enough answers."""
        return self.right["n"] >= LEAST

    @property
    def off(self) -> float:
        """Share that is right less what is stated."""
        return self.right["value"] - self.stated


def reliability(
    plan: Plan | str | PathLike | None = None,
    healthy: Sequence[str | PathLike] = (),
    flights: int = 1000,
    truths: Sequence[str | PathLike] = (),
    losses: Sequence[float] = (0.15, 0.25, 0.4),
    jobs: int | None = None,
    progress: Callable | None = None,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> list[Bin]:
    """Diagnose flights of known truth, and compare stated probabilities with how often they are right.

    plan: assessed by logs, flown with its own seed, or its file; flights: how many of it. healthy: logs. losses: each is put into every
    rotor of them once; they are assessed as they are, too. truths: tables of truth (docs/tuning.md#odds-of-explanations). jobs, scheduler:
    as for `many.run`. progress: called as progress(share, text). keep: a folder for what is finished, from which the same call goes on.
    Raises ConfigError, LogError.
    """
    plan = plan if plan is None or isinstance(plan, Plan) else read(plan)
    return bins(claims.collect(plan, flights, None, healthy, losses, truths, jobs, progress, scheduler, keep))


def bins(flown: Sequence[Flown]) -> list[Bin]:
    """All bins that hold an answer."""
    found = []
    for statement, said in (("event", _events(flown)), ("rotor", _rotors(flown))):
        pairs = np.array(list(said), float).reshape(-1, 2)
        which = np.clip(np.searchsorted(EDGES, pairs[:, 0], side="right") - 1, 0, len(EDGES) - 2)
        for k in np.unique(which):
            some, share = pairs[which == k], tools.share(pairs[which == k, 1])
            assert share is not None
            found.append(Bin(statement, EDGES[k], EDGES[k + 1], float(some[:, 0].mean()), share))
    return found


def _events(flown: Sequence[Flown]) -> Iterator[tuple[float, bool]]:
    """(stated probability, right) of each event."""
    for flight in flown:
        for e in flight.events:
            if e.kind in (LOSS, SLOW_RESPONSE) and e.rotors:
                broken = {f.rotor for f in flight.faults if f.kind not in HARMLESS and f.onset_s <= e.detected_s + EARLY_S}
                yield e.probability, set(e.rotors) <= broken


def _rotors(flown: Sequence[Flown]) -> Iterator[tuple[float, bool]]:
    """(stated probability, at fault) of each rotor in each comparison."""
    for flight in flown:
        for claim in flight.compared:
            what = odds_fit.truth(flight.faults, claim)
            if what is None:
                continue
            share = odds_fit.share(claim.logs())
            at_fault = [odds_fit.at_fault(r) for r in claim.rows]
            for i in range(flight.rotors):
                if i in what.must or i not in what.may:
                    said = float(sum(p for p, who in zip(share, at_fault) if i in who))
                    yield odds.stated(said), i in what.must


def to_dict(found: Sequence[Bin]) -> list[dict[str, Any]]:
    """The bins as JSON has them."""
    return [{**b._asdict(), "off": b.off, "assessed": b.assessed} for b in found]


def markdown(found: Sequence[Bin]) -> str:
    """A table of the bins with enough answers, and how many are within the aim."""
    assessed = [b for b in found if b.assessed]
    rows = [
        [STATEMENTS[b.statement], f"{b.low:g}–{b.high:g}", b.right["n"], f"{100 * b.stated:.1f}",
         tools.interval(b.right, None).replace(" %", "").replace(" to ", "–"), f"{100 * b.off:+.1f}"]
        for b in assessed
    ]  # fmt: skip
    within = sum(abs(b.off) <= WITHIN for b in assessed)
    heads = ("statement", "stated", "answers", "mean, %", "right, %", "difference")
    return (
        tools.table(heads, rows) + f"\n\n{within} of {len(assessed)} bins with {LEAST} answers and more within {100 * WITHIN:.0f} points.\n"
    )


def draw(found: Sequence[Bin], path: str | PathLike) -> None:
    """Write the figure: share that is right over the stated probability, with 95 % intervals. Raises ConfigError without matplotlib."""
    figure = optional.library("matplotlib.figure", "A figure").Figure(figsize=(6.0, 3.2), layout="constrained")
    for axes, (statement, title) in zip(figure.subplots(1, 2, sharey=True), STATEMENTS.items()):
        some = [b for b in found if b.statement == statement and b.assessed]
        x, y = [100 * b.stated for b in some], [100 * b.right["value"] for b in some]
        low, high = ([100 * abs(b.right[key] - b.right["value"]) for b in some] for key in ("low", "high"))
        axes.plot([0, 100], [0, 100], color="0.7", linewidth=1.0)
        axes.errorbar(x, y, yerr=[low, high], fmt="o", markersize=4, capsize=2)
        axes.set(title=title, xlabel="stated probability, %", xlim=(-3, 103), ylim=(-3, 103))
        axes.title.set_fontsize(9)
        axes.set_ylabel("right, %")
    with files.replacing(path) as unfinished:
        figure.savefig(unfinished, format="svg", metadata={"Date": None})
