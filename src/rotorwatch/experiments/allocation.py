"""Is the allocation exact? Random demands on all frames with random losses, against SciPy's solver of bounded least squares.

    from rotorwatch.experiments import allocation
    for row in allocation.study(10_000):
        print(row)

`python benchmarks/allocation.py` prints the table of docs/control.md.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes
from rotorwatch.backend import jax as load_jax
from rotorwatch.control import allocation
from rotorwatch.control.allocation import Allocator, Belief

MOST = 12  # rotors
SETS = 3  # candidates of an ambiguous belief


class Problems(NamedTuple):
    """Demands (N, 4) on a vehicle B (4, n) and what is believed of its rotors: `Belief` with a leading N."""

    B: np.ndarray
    demand: np.ndarray
    belief: Belief


class Row(NamedTuple):
    """A frame's worst difference of a command from the oracle's; bounded: share of commands at 0 or 1; turns: the most; None for
    "posterior"."""

    frame: str
    rotors: int
    by: str
    demands: int
    worst: float
    bounded: float
    turns: int | None


def frames() -> list[str]:
    """Every airframe of up to MOST rotors, but those of the same geometry."""
    found: dict[bytes, str] = {}
    for name in airframes.names():
        B = allocation.rows(airframes.named(name))
        if B.shape[1] <= MOST:
            found.setdefault(np.round(B, 6).tobytes(), name)
    return sorted(found.values())


def problems(frame: str, count: int, seed: int = 0) -> Problems:
    """Random demands, a third of them small, a third large, a third beyond what the vehicle can do, a fifth exactly at a corner of it;
    a quarter of the rotors weak, one in sixteen dead; bounds about the mean; candidates with other rotors weak."""
    B = allocation.rows(airframes.named(frame))
    n = B.shape[1]
    rng = np.random.default_rng([seed, n, sum(frame.encode())])

    def losses(*shape):
        e = np.where(rng.random(shape) < 0.25, rng.random(shape), 1.0)
        return np.where(rng.random(shape) < 1.0 / 16.0, 0.0, e)

    mean = losses(count, n)
    half = np.abs(B).sum(axis=1) / 2.0
    demand = rng.random((count, n)) @ B.T * rng.choice([0.5, 1.0, 2.0], (count, 1))
    demand += half * rng.standard_normal((count, 4)) * rng.choice([0.0, 0.2, 1.0], (count, 1))
    corner = rng.random(count) < 0.2
    demand = np.where(corner[:, None], (mean * (rng.random((count, n)) < 0.5)) @ B.T, demand)
    lower = np.maximum(mean - rng.choice([0.0, 0.1, 1.0], (count, 1)) * rng.random((count, n)), 0.0)
    upper = np.minimum(mean + rng.choice([0.0, 0.1, 1.0], (count, 1)) * rng.random((count, n)), 1.0)
    return Problems(B, demand, Belief(mean, lower, upper, losses(count, SETS, n), rng.random((count, SETS))))


def oracle(allocator: Allocator, demand: np.ndarray, belief: Belief) -> np.ndarray:
    """u (n,) of one problem, by SciPy from the definition: rows stacked, bounded-variable least squares of Stark and Parker."""
    from scipy.optimize import lsq_linear

    half = np.abs(allocator.B).sum(axis=1) / 2.0
    W = np.diag(allocator.weights / np.where(half > 0.0, half, 1.0))
    C, b, n, root = W @ allocator.B, W @ demand, allocator.n, np.sqrt(allocator.eps)
    if allocator.by == "posterior":
        share = np.sqrt(belief.weights / belief.weights.sum())
        blocks = [(s * C * e, s * b) for s, e in zip(share, belief.candidates, strict=True)]
        mean = share**2 @ belief.candidates
    else:
        mean = belief.mean
        blocks = [(C * mean, b)]
    if allocator.by == "bounds":
        spread = np.sqrt((belief.upper - mean) * (mean - belief.lower))
        blocks.append((np.diag(spread * np.linalg.norm(C, axis=0)), np.zeros(n)))
    ridge = root * np.eye(n)
    free = np.linalg.lstsq(np.vstack([C * mean, ridge]), np.append(b, np.zeros(n)), rcond=None)[0]
    A = np.vstack([*(block for block, _ in blocks), ridge])
    y = np.concatenate([*(right for _, right in blocks), root * np.clip(free, 0.0, 1.0)])
    return lsq_linear(A, y, (0.0, 1.0), method="bvls", tol=1e-15, max_iter=300).x


def solver(allocator: Allocator):
    """Compiled: demands (N, 4) and beliefs -> (`Allocation` with a leading N, turns (N,))."""
    jax = load_jax()

    def one(demand, belief):
        return allocator.step_counting(allocator.init(), demand, belief)[1:]

    return jax.jit(jax.vmap(one))


def compare(frame: str, count: int, by: str = "estimate", seed: int = 0, run: Any = None) -> Row:
    """One frame's row. run: what `solver` made for this allocator, if there already is one."""
    posed = problems(frame, count, seed)
    allocator = Allocator(posed.B, by=by)
    out, turns = (run or solver(allocator))(posed.demand, posed.belief)
    u, turns = np.asarray(out.u), np.asarray(turns)
    worst = 0.0
    for k in range(count):
        belief = Belief(*(leaf[k] for leaf in posed.belief))
        worst = max(worst, float(np.abs(u[k] - oracle(allocator, posed.demand[k], belief)).max()))
    at = float(((u == 0.0) | (u == 1.0)).mean())
    return Row(frame, allocator.n, by, count, worst, at, None if by == "posterior" else int(turns.max()))


def study(demands: int, by: str = "estimate", progress: Any = None) -> list[Row]:
    """`demands` in all, spread over every frame."""
    names = frames()
    rows = []
    for k, name in enumerate(names):
        rows.append(compare(name, -(-demands // len(names)), by))
        if progress:
            progress((k + 1) / len(names), name)
    return rows
