"""Selection of the rotors of a whole fleet to be named, with a bounded share of false ones.

Every rotor has an e-value: evidence with a mean of at most 1 when nothing is wrong with it. The k largest of m are named when the k-th is
at least m / (q k): the e-BH procedure, which keeps the false discovery rate below q under any dependence, also when evaluated after every
flight.

Source: R. Wang and A. Ramdas, False discovery rate control with e-values, Journal of the Royal Statistical Society B 84 (2022) 822-852.
"""

from __future__ import annotations

import numpy as np

RATE = 0.05


def named(log_e: np.ndarray, rate: float = RATE) -> np.ndarray:
    """(m,) bool: hypotheses with log e-values (m,) that are rejected at that false discovery rate."""
    log_e = np.asarray(log_e, float)
    m = log_e.size
    if not m:
        return np.zeros(0, bool)
    order = np.argsort(-log_e, kind="stable")
    enough = log_e[order] >= np.log(m / (rate * np.arange(1, m + 1)))
    k = int(np.flatnonzero(enough)[-1]) + 1 if enough.any() else 0
    out = np.zeros(m, bool)
    out[order[:k]] = True
    return out
