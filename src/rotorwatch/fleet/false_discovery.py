"""Which rotors of a whole fleet are named, so that of those named at most a given share is named wrongly.

Every rotor has an e-value: evidence that has mean 1 at most when nothing is wrong with it. The k largest of m are named when the k-th is at
least m / (q k): the e-BH procedure, which keeps the false discovery rate below q whatever hangs on what, and when looked at after every
flight.

Source: R. Wang and A. Ramdas, False discovery rate control with e-values, Journal of the Royal Statistical Society B 84 (2022) 822-852.
"""

from __future__ import annotations

import numpy as np

RATE = 0.05


def named(log_e: np.ndarray, rate: float = RATE) -> np.ndarray:
    """(m,) bool: which of the hypotheses with log e-values (m,) are rejected at that false discovery rate."""
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
