"""The default estimator made runnable: built from arrays, and run over ticks."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rotorwatch.compiling.run import Steps, chosen, run_built
from rotorwatch.core import Array
from rotorwatch.default.plant import AXIS_STATES
from rotorwatch.errors import ConfigError
from rotorwatch.motion.ticks import AGAIN, Ticks


class Kept(NamedTuple):
    """What is kept of every tick; shapes as in estimator.Output."""

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
    each: Array
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
    same = {name: getattr(out, name) for name in Kept._fields if hasattr(out, name)}
    told = {name: getattr(d, name) for name in ("log_odds", "statistic", "best", "onset")}
    own = dict(
        innovation=e.innovation,
        innovation_var=jnp.diagonal(e.innovation_cov),
        biases=e.x[:AXIS_STATES].reshape(4, -1)[:, :3].sum(axis=1),
        opposite=out.opposite.pair,
        opposite_onset=out.opposite.onset,
        opposite_loss=out.opposite.loss,
    )
    return Kept(**{**same, **told, **own})


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
    from rotorwatch.default.estimator import JumpBank
    from rotorwatch.default.plant import WrenchBalance

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
    from rotorwatch.default.plant import WrenchBalance

    again = table.restart if table.contact is None else np.where(table.contact, AGAIN, table.restart)
    return np.column_stack([WrenchBalance(B).pack(table), table.mode, again]), table.wrench, table.valid


def parameters(B: np.ndarray, dynamics=None) -> dict:
    """The arrays the estimator is built from: geometry B (4, n), and what `learn` found or any multirotor is like; on coaxial frames
    which rotors are the lower ones, and what is known of their share."""
    from rotorwatch.default import noise
    from rotorwatch.default.plant import SHARE_SD, WrenchBalance, lower_rotors

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


def steps(dt: float, B: np.ndarray, dynamics=None) -> Steps:
    """The default estimator for ticks of dt seconds, gone on with as ticks come; `inputs` makes its rows. Raises ConfigError."""
    return Steps(builder(dt), parameters(B, dynamics), kept, (B.shape[1] + 12, 4))
