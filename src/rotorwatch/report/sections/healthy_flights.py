"""Comparison with healthy flights of the same build."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rotorwatch.answer.wording import VERDICTS, percent, probability, rotors
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import drawing, markup, places, plain
from rotorwatch.report import words as spelled
from rotorwatch.report.blocks import Block, Pairs

name, title, order = "healthy_flights", "Against healthy flights of this build", 60
views = ("page", "terminal")


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    return diagnosis if rows(diagnosis) else None


def words(data: Diagnosis) -> list[Block]:
    return [Pairs(rows(data))]


def page(data: Diagnosis, divs: dict[str, str]) -> str:
    return f"<h2>{title}</h2>{''.join(markup.rendered(words(data), name))}{drawing.baseline(data)}"


def rows(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """(name, sentence) rows of the comparison; empty without one."""
    facts = diagnosis.whole_flight
    if not facts:
        return []
    count, share = facts.get("flights"), float(np.expm1(facts.get("common") or 0.0))
    verdict = VERDICTS.get(str(facts.get("verdict")), plain(facts.get("verdict"))).lower()
    likely = [c for c in facts.get("causes") or () if c.get("probability", 0) >= 0.05]
    rows = {
        "answer": f"{verdict}: {facts.get('reason', '')}",
        "compared with": "" if count is None else f"{count} healthy flight{'s' if count != 1 else ''} of this build",
        "what explains the difference": "; ".join(f"{_cause(c, diagnosis)} {probability(float(c['probability']))}" for c in likely),
    }
    if facts.get("common") is not None and facts.get("verdict") != "inconclusive":
        rows["all rotors together"] = (
            f"{percent(abs(share))} {'more' if share > 0 else 'less'} command than on the healthy flights (battery, payload and air "
            "density also change it)"
        )
    return [(name, text) for name, text in rows.items() if text]


def _cause(facts: Mapping[str, Any], diagnosis: Diagnosis) -> str:
    """'rotor 3 (front left)', 'a shifted centre of mass'."""
    if facts.get("rotors"):
        return rotors(facts["rotors"], places(diagnosis))
    return f"a shifted {spelled(str(facts.get('kind', '')))}"
