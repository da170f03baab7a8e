"""The default estimator made runnable: built from arrays, run over ticks, and taught by healthy flights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rotorwatch.compiling.run import chosen, run_built
from rotorwatch.core import Array
from rotorwatch.errors import ConfigError
from rotorwatch.motion.ticks import AGAIN, JUDGE, Ticks
from rotorwatch.systems.wrench_balance import AXIS_STATES

FLIGHTS_DIFFER = 0.25
LEARNED_WEIGHT = 2.0  # samples a lag that the noise of healthy flights counts for
# Variances grow by factors: one learned as nothing could never be anything in a rougher flight.
LEAST_SHARE = 0.05


class Kept(NamedTuple):
    """What is kept of every tick; shapes as in jump_bank.Output."""

    theta: Array
    theta_sd: Array
    innovation: Array
    innovation_var: Array
    log_odds: Array
    statistic: Array
    best: Array
    onset: Array
    probability: Array
    announced: Array
    since: Array
    active: Array
    share: Array
    detectable: Array
    biases: Array
    opposite: Array
    opposite_onset: Array
    opposite_loss: Array


def kept(out) -> Kept:
    """The usual selection of a tick's output."""
    import jax.numpy as jnp

    e, d = out.estimate, out.decision
    return Kept(
        out.theta, out.theta_sd, e.innovation, jnp.diagonal(e.innovation_cov), d.log_odds, d.statistic, d.best, d.onset,
        out.probability, out.announced, out.since, out.active, out.share, out.detectable,
        e.x[:AXIS_STATES].reshape(4, -1)[:, :3].sum(axis=1), *out.opposite,
    )  # fmt: skip


# One for each length of ticks that `ticks.tick_length` gives; functions of this module, so that their native code can be kept.
def _every_50_ms(p):
    return _estimator(p, 0.05)


def _every_100_ms(p):
    return _estimator(p, 0.1)


def _every_200_ms(p):
    return _estimator(p, 0.2)


def _every_500_ms(p):
    return _estimator(p, 0.5)


def _every_second(p):
    return _estimator(p, 1.0)


def _estimator(p, dt):
    from rotorwatch.estimators.jump_bank import JumpBank
    from rotorwatch.systems.wrench_balance import WrenchBalance

    system = WrenchBalance(p["B"], (p["x0"], p["P0"]), p.get("lower"), p.get("share"))
    return JumpBank(system, dt, (p["noise"], p["noise_weight"]))


BUILDERS: dict[float, Callable] = {
    0.05: _every_50_ms,
    0.1: _every_100_ms,
    0.2: _every_200_ms,
    0.5: _every_500_ms,
    1.0: _every_second,
}


def builder(dt: float) -> Callable:
    """build(parameters) of the estimator for ticks of dt seconds, the same function every time. Raises ConfigError for other ticks."""
    if dt not in BUILDERS:
        raise ConfigError(
            f"the default estimator has no ticks of {dt:g} s; it has {', '.join(f'{t:g}' for t in BUILDERS)}."
        )
    return BUILDERS[dt]


def inputs(table: Ticks, B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u (T, n + 12), y (T, 4), valid (T, 4) of the estimator over ticks."""
    from rotorwatch.systems.wrench_balance import WrenchBalance

    again = table.restart if table.contact is None else np.where(table.contact, AGAIN, table.restart)
    return np.column_stack([WrenchBalance(B).pack(table), table.mode, again]), table.wrench, table.valid


def parameters(B: np.ndarray, dynamics=None) -> dict:
    """The arrays the estimator is built from: geometry B (4, n), and what `learn` found or any multirotor is like; on coaxial frames
    which rotors are the lower ones, and what is known of their share."""
    from rotorwatch.evidence import noise
    from rotorwatch.systems.wrench_balance import SHARE_SD, WrenchBalance, lower_rotors

    lower, coaxial = lower_rotors(B), {}
    if lower is not None:
        coaxial = {"lower": lower, "share": np.array((dynamics or {}).get("share", [0.0, SHARE_SD**2]), float)}
    if dynamics:
        return {"B": B, **coaxial, **{k: np.array(dynamics[k], float) for k in ("x0", "P0", "noise", "noise_weight")}}
    system = WrenchBalance(B)
    return {
        "B": B,
        **coaxial,
        "x0": system.x0,
        "P0": system.P0,
        "noise": noise.GENERIC,
        "noise_weight": np.array(noise.GENERIC_WEIGHT),
    }


def estimate(table: Ticks, B: np.ndarray, dynamics=None, progress=None, keep=kept):
    """Run the default estimator over ticks: (last carry, stacked outputs). Raises ConfigError when commands are too slow.

    As native code where there is a C compiler, which is several times as fast and needs no JAX once it is built; $ROTORWATCH_BACKEND
    says otherwise.
    """
    build, backend = builder(table.dt), chosen(None, "auto")
    return run_built(build, parameters(B, dynamics), *inputs(table, B), keep, progress, backend=backend)


def learn(tables: Sequence[Ticks], B: np.ndarray) -> dict | None:
    """What healthy flights teach: x0 (20), P0 (20, 20), noise (4, 4), noise_weight; None when none of them is long enough.

    Gains and damping: precision-weighted mean over the flights, with their spread added. Biases are left open: they are
    each flight's own. Noise: the largest of the flights', per component and axis.
    """
    from rotorwatch.systems.wrench_balance import DAMPING, GAIN, PER_AXIS, WrenchBalance, lower_rotors

    system = WrenchBalance(B)
    rows = (np.arange(4)[:, None] * PER_AXIS + np.array([GAIN, DAMPING])).reshape(-1)
    means, precisions, noises, shares = [], [], [], []
    for table in tables:
        if (table.mode == JUDGE).sum() * table.dt < 10.0 or table.dt not in BUILDERS:
            continue
        carry, _ = estimate(table, B)
        means.append(np.asarray(carry.s)[rows])
        precisions.append(1.0 / np.maximum(np.diag(np.asarray(carry.P))[rows], 1e-12))
        noises.append(np.asarray(carry.noise.variances))
        shares.append(
            (float(carry.s[AXIS_STATES]), float(carry.P[AXIS_STATES, AXIS_STATES]))
        )  # the share, on coaxial frames
    if not means:
        return None
    loudest = np.max(noises, axis=0)
    loudest = np.maximum(loudest, LEAST_SHARE * loudest.max(axis=0))
    mean = np.average(means, axis=0, weights=precisions)
    spread = np.average((np.array(means) - mean) ** 2, axis=0, weights=precisions)
    x0, P0 = system.x0.copy(), system.P0.copy()
    x0[rows] = mean
    # Few flights do not show how much flights differ: until many do, part of what vehicles differ by is left open.
    open_ = FLIGHTS_DIFFER * np.diag(P0)[rows] / len(means)
    variance = np.minimum(np.diag(P0)[rows], 1.0 / np.sum(precisions, axis=0) + spread + open_)
    P0[rows[:, None], rows] = np.diag(variance)
    # ... nor how much the lower rotors' share does.
    share, spread_share = np.average(shares, axis=0), np.var([s for s, _ in shares])
    known = {"share": [float(share[0]), float(share[1] + spread_share)]} if lower_rotors(B) is not None else {}
    return {
        "x0": x0.tolist(), "P0": P0.tolist(), "noise": loudest.tolist(), "noise_weight": LEARNED_WEIGHT,
        "dt": tables[0].dt, **known,
    }  # fmt: skip
