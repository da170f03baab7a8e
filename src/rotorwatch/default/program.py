"""The default estimator made runnable: built from arrays, and run over ticks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.compiling.run import Steps, chosen, run_built
from rotorwatch.core import Array
from rotorwatch.default.plant import AXIS_STATES, any_air, any_curve, any_multirotor
from rotorwatch.errors import ConfigError
from rotorwatch.motion.ticks import AGAIN, TICKS_S, Ticks


class TickOutput(NamedTuple):
    """Outputs stored for every tick; shapes as in estimator.Output."""

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
    onsets: Array
    active: Array
    each: Array
    share: Array
    gives: Array
    detectable: Array
    biases: Array
    opposite: Array
    opposite_onset: Array
    opposite_loss: Array


def tick_output(out) -> TickOutput:
    """The usual selection of a tick's output."""
    import jax.numpy as jnp

    e, d = out.estimate, out.decision
    same = {name: getattr(out, name) for name in TickOutput._fields if hasattr(out, name)}
    decided = {name: getattr(d, name) for name in ("log_odds", "statistic", "best", "onset")}
    own = dict(
        innovation=e.innovation,
        innovation_var=jnp.diagonal(e.innovation_cov),
        biases=e.x[:AXIS_STATES].reshape(4, -1)[:, :3].sum(axis=1) + out.built,
        opposite=out.opposite.pair,
        opposite_onset=out.opposite.onset,
        opposite_loss=out.opposite.loss,
    )
    return TickOutput(**{**same, **decided, **own})


def estimator(p):
    """The default estimator of `parameters`. A function of this module, so that its native code can be known: one program serves every
    vehicle with as many rotors, whatever the length of its ticks."""
    from rotorwatch.default.estimator import JumpBank
    from rotorwatch.default.plant import WrenchBalance

    system = WrenchBalance(p["B"], (p["x0"], p["P0"]), p.get("lower"), p.get("share"), p["curve"], p["air"])
    return JumpBank(system, p["dt"], (p["noise"], p["noise_weight"]))


def inputs(table: Ticks, B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u (T, n + 15), y (T, 4), valid (T, 4) of the estimator over ticks."""
    from rotorwatch.default.plant import WrenchBalance

    again = table.restart if table.contact is None else np.where(table.contact, AGAIN, table.restart)
    u = np.concatenate([WrenchBalance(B).pack(table), table.mode[:, None], again[:, None]], axis=1)
    return u, table.wrench, table.valid


def parameters(B: np.ndarray, dt: float, dynamics=None) -> dict:
    """The arrays the estimator is built from: geometry B (4, n), length of a tick dt [s], and what `learn` found or any multirotor is
    like; on coaxial frames which rotors are the lower ones, and what is known of their share. Raises ConfigError for other ticks."""
    from rotorwatch.default import noise
    from rotorwatch.default.plant import SHARE_SD, lower_rotors

    lower, coaxial = lower_rotors(B), {}
    if lower is not None:
        coaxial = {"lower": lower, "share": np.array((dynamics or {}).get("share", [0.0, SHARE_SD**2]), float)}
    if dt not in TICKS_S:
        known = ", ".join(f"{t:g}" for t in TICKS_S)
        raise ConfigError(f"The default estimator has no ticks of {dt:g} s; it has {known}.")
    curve = np.array((dynamics or {}).get("curve", any_curve()), float)
    air = np.array((dynamics or {}).get("air", any_air()), float)
    arrays = {"B": B, "dt": np.array(dt), "curve": curve, "air": air, **coaxial}
    if dynamics:
        return {**arrays, **{k: np.array(dynamics[k], float) for k in ("x0", "P0", "noise", "noise_weight")}}
    mean, P = any_multirotor(B.shape[1])
    return {
        **arrays,
        "x0": mean,
        "P0": P,
        "noise": noise.GENERIC,
        "noise_weight": np.array(noise.GENERIC_WEIGHT),
    }


def estimate(table: Ticks, B: np.ndarray, dynamics=None, progress=None, keep=tick_output):
    """Run the default estimator over ticks: (last carry, stacked outputs). Raises ConfigError when commands are too slow.

    As native code where there is a C compiler, which is several times as fast and needs no JAX once it is built; $ROTORWATCH_BACKEND
    says otherwise.
    """
    arrays, backend = parameters(B, table.dt, dynamics), chosen(None, "auto")
    return run_built(estimator, arrays, *inputs(table, B), keep, progress, backend=backend)


def steps(dt: float, B: np.ndarray, dynamics=None) -> Steps:
    """The default estimator for ticks of dt seconds, gone on with as ticks come; `inputs` makes its rows. Raises ConfigError."""
    return Steps(estimator, parameters(B, dt, dynamics), tick_output, (B.shape[1] + 15, 4))
