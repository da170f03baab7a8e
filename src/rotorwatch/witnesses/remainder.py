"""Losses in the motion that known losses leave: the estimator run once more, with these taken from what was commanded.

In flight a second loss is announced beside a state that holds the first, with its uncertainty, and at odds of a thousand
(engine/estimator/plausibility.py). After the flight the first has a size: without B (loss x thrust) the motion is that of a whole vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from rotorwatch.engine.bindings import unexplained_evidence
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.program import estimate
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.witnesses.odds import BESIDE
from rotorwatch.witnesses.witness import View

SOURCE = Source(BESIDE, 3)


def claims(view: View, known: Sequence[Event], missing: np.ndarray) -> Iterator[Event]:
    """Open claims of a loss of each other rotor, at its likeliest onset. known: losses; missing (T, n): thrust that they take [hover
    thrusts]."""
    table, B = view.clear, view.B
    assert table is not None
    them, suspects = list_hypotheses(B.shape[1]), {r for e in known for r in e.suspects}
    _, out = estimate(replace(table, wrench=table.wrench - missing @ B.T), B, view.dynamics)
    single = np.array([kind == "single" for kind in them.kinds])
    odds = np.where(out.announced[:, None] & single, out.log_odds, -np.inf)
    best = odds.argmax(axis=1)
    for h in np.unique(best[out.announced]):
        (rotor,) = them.rotors[h]
        k = int(np.where(best == h, odds[:, h], -np.inf).argmax())
        if rotor + 1 not in suspects:
            yield unexplained_evidence.claim((rotor + 1,), view.began(out, k), float(table.time[k]), source=SOURCE)
