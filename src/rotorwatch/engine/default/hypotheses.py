"""What may have happened: the explicit hypotheses of the default diagnoser, and how strongly a window of data speaks for each.

For a jump nu in directions d (rotor losses and axis biases) at a given time, the filter's innovations give the information
matrix C (q, q) and vector z (q,) of nu (Willsky & Jones 1976). A hypothesis allows a subset of directions; the log
Bayes factor against "no jump", with a Gaussian prior of width w on each direction and rotor losses confined to [lo, hi], is

    log BF = z.nu - nu.C.nu / 2  -  1/2 sum log(1 + C_dd|rest w^2)        at the most probable admissible nu
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rotorwatch.engine.estimator.hypotheses import (  # noqa: F401 - the method's constants stand in its definition
    AIR_SHARE,
    CLEAR,
    FAR,
    FAR_SHARE,
    LOSS_WIDTH,
    MORE,
    NONE,
    NOTHING,
    RECOVERY_SHARE,
    SLOP,
    SMALL_WIDTH,
    TOTAL_LOSS,
    TOTAL_SHARE,
)
from rotorwatch.engine.front import losses

# Prior weights: how often each kind of jump happens, relative to one particular rotor failing, or working again. Disturbances are common.
# A rotor that follows no command any more but gives one thrust, whatever that is, is rarer than one that gives less.
WEIGHT = {"pair": losses.PAIR_WEIGHT, "stuck": 0.1, "disturbance": 3.0}
# Disturbances: which of roll, pitch, yaw, thrust they touch.
DISTURBANCES = ((0,), (1,), (2,), (3,), (0, 3), (1, 3), (2, 3), (0, 1, 2), (0, 1, 2, 3))


@dataclass(frozen=True)
class Hypotheses:
    """All hypotheses of an n-rotor vehicle. names; kinds; rotors: 0-based sets; fault: bool; weight: prior weights.

    pairs (n_pairs, 2): rotors. blocks: directions of each disturbance. Of each hypothesis: pick (n_h, 2, n): its (at most two) rotors,
    one-hot; steps (n_h, 4): the axes it steps; well, stuck (n_h,): whether it is a rotor that is well again, or gives one thrust.
    """

    n: int
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    rotors: tuple[tuple[int, ...], ...]
    weight: np.ndarray
    fault: np.ndarray
    pairs: np.ndarray
    blocks: tuple[tuple[int, ...], ...]
    pick: np.ndarray
    steps: np.ndarray
    well: np.ndarray
    stuck: np.ndarray


def make(n: int) -> Hypotheses:
    """Singles, pairs, single with common mode, each axis' bias, torque bias, common mode, any wrench."""
    names, kinds, rotors = [], [], []

    def add(kind, label, who=()):
        names.append(label)
        kinds.append(kind)
        rotors.append(tuple(who))

    for i in range(n):
        add("single", f"rotor {i + 1}", (i,))
    pairs = list(combinations(range(n), 2))
    for i, j in pairs:
        add("pair", f"rotors {i + 1}+{j + 1}", (i, j))
    for i in range(n):
        add("recovery", f"rotor {i + 1} is well again", (i,))
    for i in range(n):
        add("stuck", f"rotor {i + 1} gives one thrust", (i,))
    axes = ("roll", "pitch", "yaw", "common mode")
    for block in DISTURBANCES:
        what = {3: "torque bias", 4: "any disturbance"}.get(len(block)) or " and ".join(axes[a] for a in block)
        add("disturbance", what if len(block) > 2 or block == (3,) else what + " bias" if 3 not in block else what)
    weight = np.array([WEIGHT.get(k, 1.0) for k in kinds])
    fault = np.array([k != "disturbance" for k in kinds])
    pick = np.zeros((len(names), 2, n))
    for h, who in enumerate(rotors):
        pick[h, np.arange(len(who)), list(who)] = 1.0
    steps = np.zeros((len(names), 4))
    steps[~fault] = [[float(a in block) for a in range(4)] for block in DISTURBANCES]
    return Hypotheses(
        n=n,
        names=tuple(names),
        kinds=tuple(kinds),
        rotors=tuple(rotors),
        weight=weight,
        fault=fault,
        pairs=np.array(pairs),
        blocks=tuple(tuple(n + a for a in block) for block in DISTURBANCES),
        pick=pick,
        steps=steps,
        well=np.array([k == "recovery" for k in kinds]),
        stuck=np.array([k == "stuck" for k in kinds]),
    )


def _clip_pair(c11, c12, c22, z1, z2, lo1, hi1, lo2, hi2):
    """Most probable (nu1, nu2) inside a box: the interior solution, else the best point of the edges."""
    import jax.numpy as jnp

    det = c11 * c22 - c12 * c12
    det = jnp.where(det > 1e-12 * c11 * c22, det, 1e-12 * c11 * c22 + 1e-30)
    i1, i2 = (c22 * z1 - c12 * z2) / det, (c11 * z2 - c12 * z1) / det
    inside = (i1 >= lo1) & (i1 <= hi1) & (i2 >= lo2) & (i2 <= hi2)

    def score(a, b):
        return z1 * a + z2 * b - 0.5 * (c11 * a * a + 2 * c12 * a * b + c22 * b * b)

    best_a, best_b = jnp.clip(i1, lo1, hi1), jnp.clip(i2, lo2, hi2)
    best = jnp.where(inside, score(i1, i2), -jnp.inf)
    best_a, best_b = jnp.where(inside, i1, best_a), jnp.where(inside, i2, best_b)
    for fixed in (lo1, hi1):
        b = jnp.clip((z2 - c12 * fixed) / c22, lo2, hi2)
        s = score(fixed, b)
        best_a, best_b, best = jnp.where(s > best, fixed, best_a), jnp.where(s > best, b, best_b), jnp.maximum(s, best)
    for fixed in (lo2, hi2):
        a = jnp.clip((z1 - c12 * fixed) / c11, lo1, hi1)
        s = score(a, fixed)
        best_a, best_b, best = jnp.where(s > best, a, best_a), jnp.where(s > best, fixed, best_b), jnp.maximum(s, best)
    return best_a, best_b, best


def log_bayes_factors(hyp: Hypotheses, C, z, lo, hi, width, recovery, slop, air, B, full):
    """C (W, q, q), z (W, q) for W jump times; lo, hi (n,) bounds of rotor jumps; width (4,): how large disturbances of this
    aircraft are; recovery (W, n): the jump that would end each rotor's loss; slop (W, 4): of that name; air: variance of thrust that air
    from below or above may make; B (4, n): effectiveness; full: thrust of a rotor. -> log BF (W, n_h), nu (W, n_fault, 2), the variance
    (W, n) of a single rotor's jump, and of a rotor that gives one thrust that thrust and its variance (W, n)."""
    import jax.numpy as jnp

    n, w2 = hyp.n, LOSS_WIDTH**2
    # Two rotors explain more than one by chance: what they do has to be geometry's.
    free = C[:, :n, :n] + jnp.eye(n) / w2
    a, b = hyp.pairs.T
    pa, pb, pair = _clip_pair(free[:, a, a], free[:, a, b], free[:, b, b], z[:, a], z[:, b], lo[a], hi[a], lo[b], hi[b])
    det = jnp.maximum(free[:, a, a] * free[:, b, b] - free[:, a, b] ** 2, 1e-9)
    pair = pair - 0.5 * jnp.log(det * w2**2)
    others = disturbances(hyp, C, z, width)
    moving = with_slop(C, z, slop.at[:, 3].add(air))
    c, score, gain = still = with_slop(C, z, slop)

    def one(c, score, gain):
        factor, size, spread = loss(c, score, lo, hi)
        return factor + gain[:, None], size, spread

    single, size, spread = _mixed([(*one(*moving), AIR_SHARE), (*one(*still), 1.0 - AIR_SHARE)])
    over, recovered, _ = near(c, score, recovery, recovery_sd(recovery) ** 2, None, 0.0)  # it gives more, not less
    over = over + gain[:, None]
    nu = [
        jnp.stack([size, jnp.zeros_like(size)], -1),
        jnp.stack([pa, pb], -1),
        jnp.stack([recovered, jnp.zeros_like(size)], -1),
        jnp.stack([jnp.broadcast_to(hi, size.shape), jnp.zeros_like(size)], -1),
    ]
    nu = jnp.concatenate(nu, axis=1)
    stuck, gives = one_thrust(C, z, hi, B, full)
    return jnp.concatenate([single, pair, over, stuck, others], axis=1), nu, spread, gives


def one_thrust(C, z, hi, B, full):
    """Log Bayes factor (W, n) of rotors that give one thrust between MORE and `full`, whatever they are commanded; and that thrust and
    its variance (2, W, n). The command's part is gone, a jump of hi (n,), and a step of the axes along B (4, n) has come instead."""
    import jax.numpy as jnp

    n = B.shape[1]
    along = -(C[:, n:, n:] @ B)  # what a unit of that thrust does to the axes' vector
    c, own = -jnp.einsum("an,wan->wn", B, along), jnp.diagonal(C, axis1=1, axis2=2)[:, :n]
    cross = -jnp.einsum("wna,an->wn", C[:, :n, n:], B)
    left = -(z[:, n:] @ B) - cross * hi
    factor, thrust, variance = near(c, left, 0.5 * (1.0 + full), (0.5 * (full - 1.0)) ** 2 + 1e-6, 0.0, full)
    factor = factor + z[:, :n] * hi - 0.5 * own * hi**2
    return jnp.where(thrust > MORE, factor, NOTHING), jnp.stack([thrust, variance])


def loss(c, z, lo, hi):
    """Of one loss in [lo, hi] with information c and vector z: log Bayes factor, most probable size, and the variance of that. Losses are
    small as often as large, and now and then total."""
    partly = 0.5 * (1.0 - TOTAL_SHARE)
    kinds = ((0.0, SMALL_WIDTH, partly), (0.0, LOSS_WIDTH, partly), (hi, NONE, TOTAL_SHARE))
    return _mixed([(*near(c, z, mean, width**2, lo, hi), share) for mean, width, share in kinds])


def _mixed(kinds):
    """Log Bayes factor, size and its variance of what is of one of these kinds: of each the same three, and how likely it is before."""
    import jax.numpy as jnp

    factors = jnp.stack([factor + np.log(share) for factor, _, _, share in kinds])
    likely = jnp.exp(factors - factors.max(axis=0))
    factor = factors.max(axis=0) + jnp.log(likely.sum(axis=0))
    likely, sizes = likely / likely.sum(axis=0), jnp.stack([size for _, size, _, _ in kinds])
    size = (likely * sizes).sum(axis=0)
    return factor, size, (likely * (jnp.stack([own for _, _, own, _ in kinds]) + (sizes - size) ** 2)).sum(axis=0)


def near(c, z, mean, variance, lo, hi):
    """Log Bayes factor of a jump of prior N(mean, variance) against none, its most probable size in [lo, hi], and the variance of that."""
    import jax.numpy as jnp

    left = c + 1.0 / variance
    size = jnp.clip((z + mean / variance) / left, lo, hi)
    fit = z * size - 0.5 * c * size**2 - 0.5 * (size - mean) ** 2 / variance
    return fit - 0.5 * jnp.log(left * variance), size, 1.0 / left


def recovery_sd(recovery):
    """Standard deviation of the jump `recovery` that ends a loss."""
    import jax.numpy as jnp

    return jnp.hypot(NONE, RECOVERY_SHARE * recovery)


def disturbances(hyp: Hypotheses, C, z, width):
    """Log Bayes factors (W, n_blocks) of steps of the axes' biases, of any sign and about `width` (4,) large."""
    import jax.numpy as jnp

    prior, factors = 1.0 / width**2, []
    for block in hyp.blocks:
        idx = np.array(block)
        own = prior[idx - hyp.n]
        L = cholesky(C[:, idx][:, :, idx] + jnp.diag(own))
        y = forward(L, z[:, idx])
        size = jnp.log(jnp.diagonal(L, axis1=1, axis2=2)).sum(1) - 0.5 * jnp.log(own).sum()
        factors.append(0.5 * (y * y).sum(1) - size)
    return jnp.stack(factors, axis=1)


def slop(C, z, lo, hi, reach, drag):
    """(W, 4) variance by which each axis may differ from what a rotor's loss does to it: SLOP of what the likeliest rotor would lack, and
    in yaw all of its drag. reach (n,): the most that a whole loss of each does to any axis by geometry; drag (n,): `WrenchBalance.drag`."""
    import jax.numpy as jnp

    n = z.shape[1] - 4
    c = jnp.diagonal(C, axis1=1, axis2=2)[:, :n] + 1.0 / LOSS_WIDTH**2
    nu = jnp.clip(z[:, :n] / c, lo, hi)
    fit = z[:, :n] * nu - 0.5 * c * nu**2
    best = fit == fit.max(axis=1, keepdims=True)
    lacks, dragged = (jnp.where(best, jnp.abs(nu * whole), 0.0).max(axis=1)[:, None] for whole in (reach, drag))
    return (jnp.asarray(SLOP) * lacks) ** 2 + (jnp.arange(4) == 2) * dragged**2 + 1e-12


def with_slop(C, z, prior):
    """Information (W, n) and vector (W, n) of each rotor's jump alone when the axes may differ by `prior` (W, 4), and what that freedom
    gains (W,): Gaussian steps of the four axes integrated out, one after the other."""
    import jax.numpy as jnp

    n = z.shape[1] - 4
    own, score, gain = jnp.diagonal(C, axis1=1, axis2=2)[:, :n], z[:, :n], jnp.zeros(z.shape[0])
    cross, among, step = C[:, :n, n:], C[:, n:, n:], z[:, n:]
    for a in range(4):
        d = among[:, 0, 0] + 1.0 / prior[:, a]
        gain = gain + 0.5 * step[:, 0] ** 2 / d - 0.5 * jnp.log(d * prior[:, a])
        share, row = cross[:, :, 0] / d[:, None], among[:, 0, 1:]
        own, score = own - cross[:, :, 0] * share, score - share * step[:, :1]
        cross = cross[:, :, 1:] - share[:, :, None] * row[:, None, :]
        step = step[:, 1:] - (step[:, 0] / d)[:, None] * row
        among = among[:, 1:, 1:] - row[:, :, None] * (row / d[:, None])[:, None, :]
    return own, score, gain


def cholesky(A):
    """Lower factors of A (..., k, k), k <= 4, unrolled.

    LAPACK would be exact as well, but calling it 48 times a tick costs more than the work, and JAX loads SciPy for it.
    """
    import jax.numpy as jnp

    k = A.shape[-1]
    L = [[jnp.zeros(A.shape[:-2])] * k for _ in range(k)]
    for i in range(k):
        for j in range(i + 1):
            rest = A[..., i, j] - sum(L[i][m] * L[j][m] for m in range(j))
            L[i][j] = jnp.sqrt(rest) if i == j else rest / L[j][j]
    return jnp.stack([jnp.stack(row, axis=-1) for row in L], axis=-2)


def forward(L, b):
    """Solve L y = b for lower-triangular L (W, k, k), k <= 4, unrolled."""
    import jax.numpy as jnp

    y = []
    for i in range(L.shape[-1]):
        s = b[:, i]
        for j in range(i):
            s = s - L[:, i, j] * y[j]
        y.append(s / L[:, i, i])
    return jnp.stack(y, axis=1)
