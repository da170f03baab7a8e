"""Ablation of the comparison after the flight: every explanation left out, every constant halved and doubled, on claims of known truth.

Claims keep the evidence of all their explanations (odds_fit.py), so that no flight is diagnosed again. Weights are scaled as they are,
probabilities by their odds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rotorwatch.toolkit import odds
from rotorwatch_lab.campaign import odds_fit
from rotorwatch_lab.campaign.odds_fit import Counts, Labelled
from rotorwatch_lab.experiments import tools

FACTORS = {"half": 0.5, "double": 2.0}
Change = Callable[[Labelled], Labelled]


@dataclass(frozen=True)
class Effects:
    """base: as it is. found: (constant, variant) -> counts, claims that end otherwise, and those whose named rotors do."""

    claims: int
    base: Counts
    found: dict[tuple[str, str], tuple[Counts, int]]

    def to_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        rows = [{"constant": c, "variant": v, **n._asdict(), "changed": k} for (c, v), (n, k) in self.found.items()]
        return {"claims": self.claims, "as it is": self.base._asdict(), "variants": rows}

    def markdown(self) -> str:
        """A table of the variants that change an end: change of each count; and a sentence with the others."""
        heads = ("constant", "variant", *(name.replace("_", " ") for name in Counts._fields), "claims that end otherwise")
        rows = [["as it is", "", *self.base, self.claims]]
        rows += [[f"`{c}`", v, *(f"{x - y:+d}" for x, y in zip(n, self.base)), k] for (c, v), (n, k) in self.found.items() if k]
        quiet: dict[str, list[str]] = {}
        for (c, v), (_, k) in self.found.items():
            if not k:
                quiet.setdefault(c, []).append(v)
        names = ", ".join(f"`{c}` {' and '.join(v)}" for c, v in quiet.items())
        return tools.table(heads, rows) + (f"\n\nWithout effect: {names}." if names else "")


def run(data: Sequence[Labelled]) -> Effects:
    """The effects of all variants."""
    base = [odds_fit.ending(d) for d in data]
    found = {key: _compared(base, data, *change) for key, change in _variants(data).items()}
    return Effects(len(data), odds_fit.total(base), found)


def _variants(data: Sequence[Labelled]) -> dict[tuple[str, str], tuple]:
    """(constant, variant) -> (change of a claim, weights, temper, limits)."""
    same: Change = lambda d: d  # noqa: E731
    names = dict.fromkeys(r.name for d in data for r in d.claim.rows)
    found: dict[tuple[str, str], tuple] = {(name, "off"): (_without(name), None, None, odds.LIMITS) for name in names if name != "loss"}
    found["beside", "off"] = (_alone, None, None, odds.LIMITS)
    for word, factor in FACTORS.items():
        for group, weight in odds.WEIGHTS.items():
            if weight:
                found[f"weight of {group}", word] = (same, {**odds.WEIGHTS, group: weight * factor}, None, odds.LIMITS)
        found["temper", word] = (same, None, odds.TEMPER * factor, odds.LIMITS)
        for name, value in odds.LIMITS._asdict().items():
            scaled = value * factor if value > 1.0 else value * factor / (1.0 - value + value * factor)
            found[name, word] = (same, None, None, odds.LIMITS._replace(**{name: scaled}))
    return found


def _compared(base: Sequence[str], data: Sequence[Labelled], change: Change, weights, temper, limits) -> tuple[Counts, int]:
    ends = [odds_fit.ending(change(d), weights, temper, limits) for d in data]
    return odds_fit.total(ends), sum(a != b for a, b in zip(base, ends))


def _without(name: str) -> Change:
    def change(d: Labelled) -> Labelled:
        return _kept(d, [r.name != name and r.beside != name for r in d.claim.rows])

    return change


def _alone(d: Labelled) -> Labelled:
    return _kept(d, [not r.beside for r in d.claim.rows])


def _kept(d: Labelled, rows: Sequence[bool]) -> Labelled:
    return d._replace(claim=replace(d.claim, rows=tuple(r for r, keep in zip(d.claim.rows, rows) if keep)))
