"""How far commands and motion can be trusted: which states the filter may learn from them, and how wrong its model may be for a moment.

In closed loop the commands answer the noise. Four things follow, each learned the hard way: from small motion the filter would learn the
controller's gains instead of the vehicle's; a loss must not be regressed on a rotor's own jitter; and gains, damping,
thrust curve and lag are wrong by some share of what they multiply, which belongs in the measurement noise. Nor may an accelerometer's
noise count as a side force: a regressor that holds noise makes its coefficient too small (errors in variables).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.core import Array
from rotorwatch.engine.default import noise, plant
from rotorwatch.engine.default.plant import AXIS_STATES, DAMPING, GAIN, PER_AXIS
from rotorwatch.engine.estimator.model_error import (
    AIR_ERROR,
    AT_LIMIT,
    BELOW_LIMIT,
    DAMPING_ERROR,
    ERROR_TICKS,
    FAR,
    FAR_ERROR,
    GAIN_ERROR,
    GARROTE,
    GUST_SHARE,
    LAG_ERROR_S,
    LASTING_MEMORY_S,
    LEAST_GAIN,
    LEVEL_MEMORY_S,
    SIDE_FORCE,
    STILL,
    WASH,
    WASH_SINK,
)


class Memory(NamedTuple):
    """level (6,): calm variance of angular accelerations and rates; bent_level: the
    same of what the thrust curve makes of the commands. thrust, trim (n,): each rotor's thrust less the mean of all, in
    half a second and in six; thrust_level (n,): its calm variance. side (2,): last side force, push, usual_push (2,): its mean over half a
    second and over six, lately (2,): the largest square of push, fading as fast; side_level (2,): variance of what changes from tick to
    tick.
    collective: mean thrust. y (4,): last wrench."""

    level: Array
    thrust: Array
    thrust_level: Array
    side: Array
    push: Array
    usual_push: Array
    lately: Array
    side_level: Array
    trim: Array
    collective: Array
    y: Array
    burst: Array
    innovation_mean: Array
    lasting: Array
    bent_level: Array


class Look(NamedTuple):
    """How informative this tick's inputs are. u: with smoothed thrusts, side forces without noise. gain_share (n_s,): share of the
    Kalman gain each state gets.
    curve: by how much this tick's commands stand out, so that they show the thrust curve, 0 to 1.
    far: hover thrusts away from hover. part (n,): commanded thrust above the mean of all, trim (n,): lately."""

    u: Array
    gain_share: Array
    far: Array
    part: Array
    trim: Array
    curve: Array = np.float64(0.0)


def init(n: int) -> Memory:
    """Nothing known: motion counts as calm up to about 0.3 rad/s^2, side forces are known to about 0.3 m/s^2."""
    return Memory(
        np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.05]) ** 2,
        np.zeros(n),
        np.full(n, 0.05**2),
        np.zeros(2),
        np.zeros(2),
        np.zeros(2),
        np.zeros(2),
        np.full(2, 0.3**2),
        np.zeros(n),
        np.float64(1.0),
        np.zeros(4),
        np.ones(4),
        np.zeros(4),
        np.ones(4),
        np.float64(0.05**2),
    )


def look(memory: Memory, u, y, lost, valid, flying, restart, x, variances, n: int, dt, bent=0.0) -> tuple[Memory, Look]:
    """One tick's inputs u (n + 13,) as `WrenchBalance.pack` lays them out, judged against what was usual.

    y (4,): commanded wrench, lost (4,): what the known losses take of it; bent (4,): what a standard deviation of the thrust curve gives
    to it. x (n_x,): state; variances (4, 4) of the noise model.
    """
    import jax.numpy as jnp

    # Below the calm level, angular motion is gyro noise that the rate controller answers: it would teach the filter the
    # controller's gains instead of the vehicle's. Only motion that stands out teaches (nonnegative garrote).
    motion = u[jnp.array([n, n + 1, n + 2, n + 4, n + 5, n + 6])]
    shrink = jnp.maximum(0.0, 1.0 - GARROTE**2 * memory.level / jnp.maximum(motion**2, 1e-12))
    # Motion that gusts have made teaches what the gusts did, not what the vehicle is: it has to need more than they give.
    gain = jnp.maximum(x[:AXIS_STATES].reshape(4, PER_AXIS)[:3, GAIN], LEAST_GAIN * n * plant.GAIN_MEAN[:3])
    gusts = (variances[1] + variances[2] + variances[3] * plant.TAU[1])[:3]
    needs = jnp.concatenate([gain * motion[:3], plant.DAMPING_RATE * gain * motion[3:]])
    shrink = jnp.minimum(
        shrink, jnp.maximum(0.0, 1.0 - GUST_SHARE**2 * jnp.tile(gusts, 2) / jnp.maximum(needs**2, 1e-12))
    )
    # Motion that nobody commanded is a gust's or a fault's: motion teaches as far as the rotors have made it.
    need = needs[:3] + needs[3:]
    made = y[:3] - lost[:3] - x[:AXIS_STATES].reshape(4, PER_AXIS)[:3, :3].sum(axis=1)
    shrink = shrink * jnp.tile(jnp.clip(made * need / jnp.maximum(need**2, 1e-12), 0.0, 1.0), 2)
    # A tick without commands (a gap in the log, a link that was cut) says nothing of what is usual.
    past = jnp.where(valid[0], dt, 0.0)
    fade = jnp.where(flying, past / LEVEL_MEMORY_S, 0.0)
    level = memory.level + fade * (jnp.minimum(motion**2, 6.0 * memory.level) - memory.level)
    one = jnp.ones(1)
    gain_share = jnp.ones((4, PER_AXIS)).at[:, GAIN].set(jnp.concatenate([shrink[:3], one]))
    gain_share = gain_share.at[:, DAMPING].set(jnp.concatenate([shrink[3:], one]))

    # What a loss takes is in proportion to the rotor's thrust, but not to its jitter: a disturbance that the controller
    # answers through rotor i would correlate with that rotor's own command and look like its loss.
    # The collective part is common to all rotors and may pass; the torque part is smoothed unless it stands out.
    collective = u[:n].mean()
    part = u[:n] - collective
    before = jnp.where(restart, part, memory.thrust)
    away = part - before
    stands_out = jnp.maximum(0.0, 1.0 - GARROTE**2 * memory.thrust_level / jnp.maximum(away**2, 1e-12)) * away
    trim = jnp.where(restart, part, memory.trim)
    fade = jnp.where(restart, 0.0, fade)
    thrust_level = memory.thrust_level + fade * (jnp.minimum(away**2, 6.0 * memory.thrust_level) - memory.thrust_level)
    smooth = jnp.maximum(collective + before + stands_out, 0.0)

    # A side force counts while its mean stands out of what noise would leave there: as much as changes from tick to tick, were that white.
    # At first 0.2 m/s^2 have to be exceeded; as the flight's own changes become known, less.
    side = u[n + 7 : n + 9]
    share = jnp.minimum(past / plant.ANSWER_S, 1.0)
    push = jnp.where(restart, side, memory.push)
    push = push + (side - push) * share
    white = 0.5 * share * memory.side_level
    lately = jnp.maximum(push**2, memory.lately * (1.0 - share))  # also where it changes its sign
    felt = side * jnp.maximum(0.0, 1.0 - GARROTE**2 * white / jnp.maximum(lately, 1e-12))
    change = 0.5 * (side - memory.side) ** 2
    side_level = memory.side_level + fade * (jnp.minimum(change, 6.0 * memory.side_level) - memory.side_level)

    # What the thrust curve is shows where commands leave what they usually are.
    bend = (jnp.asarray(bent) ** 2).sum()
    # ... and the vehicle moves by them: what a controller answers to gusts moves nothing, and would teach that commands do nothing.
    moved = jnp.clip((made * need).sum() / jnp.maximum((made**2).sum(), 1e-12), 0.0, 1.0)
    curve = moved * jnp.maximum(0.0, 1.0 - GARROTE**2 * memory.bent_level / jnp.maximum(bend, 1e-12))

    # Punch-outs, drops and knocks: far from hover the thrust curve and the lag are no longer known well.
    usual = jnp.where(restart, collective, memory.collective)
    far = jnp.maximum(jnp.abs(collective - usual) - FAR, 0.0) + jnp.maximum(jnp.abs(u[n + 3] / n - 1.0) - FAR, 0.0)
    new = Memory(
        level,
        before + away * share,
        thrust_level,
        jnp.where(valid[0], side, memory.side),
        push,
        memory.usual_push + (push - memory.usual_push) * jnp.where(restart, 1.0, past / plant.USUAL_S),
        lately,
        side_level,
        trim + (part - trim) * (past / plant.USUAL_S),
        usual + (collective - usual) * (past / plant.USUAL_S),
        jnp.where(valid, y, memory.y),
        jnp.where(restart, 1.0, memory.burst),
        jnp.where(restart, 0.0, memory.innovation_mean),
        memory.lasting,
        memory.bent_level + fade * (jnp.minimum(bend, 6.0 * memory.bent_level) - memory.bent_level),
    )
    curve = curve * jnp.maximum(0.0, 1.0 - far / FAR)
    gain_share = jnp.concatenate([gain_share.reshape(-1), jnp.ones(x.size - AXIS_STATES + n)])
    return new, Look(
        jnp.concatenate([smooth, u[n : n + 7], felt, u[n + 9 :]]),
        gain_share,
        far,
        smooth - collective,
        memory.trim,
        curve,
    )


def shows_air(axial):
    """Share, 0 to 1, by which a speed along the thrust axis [m/s] teaches what air along that axis takes."""
    import jax.numpy as jnp

    return jnp.maximum(0.0, 1.0 - STILL**2 / jnp.maximum(axial**2, 1e-12))


def calm(memory: Memory):
    """(4,) weight of this tick's evidence: below 1 while innovations are larger than the noise model expects (gusts come in bursts)."""
    import jax.numpy as jnp

    return 1.0 / jnp.maximum(jnp.maximum(memory.burst, memory.lasting), 1.0)


def outside(memory: Memory, n: int):
    """Hover thrusts by which a force from the side may turn n rotors' vehicle: an obstacle, a tether, a hand or the ground push at an arm
    like that of the rotors."""
    import jax.numpy as jnp

    change = jnp.sqrt(((memory.push - memory.usual_push) ** 2).sum()) / G0
    return n * jnp.maximum(change - SIDE_FORCE, 0.0)


def unknown_damping(x, score, n: int):
    """(W,) variance of how much more roll and pitch are damped than the state x (n_x,) says, where score (W,) speaks for more: up to what
    two standard deviations above the usual are. Next to none where it speaks for less: damping has a least, which is 0."""
    import jax.numpy as jnp

    gain = jnp.maximum(x[np.arange(2) * PER_AXIS + GAIN].mean(), LEAST_GAIN * n * plant.GAIN_MEAN[0])
    most = plant.DAMPING_RATE + 2.0 * plant.DAMPING_RATE_SD  # light vehicles with long arms
    return jnp.where(score > 0.0, (most * gain) ** 2, 1e-12)


def remember(memory: Memory, innovation, variance, ok, dt) -> Memory:
    """One tick's innovations (4,) of given variance (4,) where ok (4,), for `calm`."""
    import jax.numpy as jnp

    size = innovation / jnp.sqrt(variance)
    burst = jnp.minimum(size**2, noise.CLIP)
    fade = jnp.where(ok, dt, 0.0)
    innovation_mean = memory.innovation_mean + fade / plant.TAU[1] * (size - memory.innovation_mean)
    # White innovations would give a mean over plant.TAU[1] this variance.
    lasting = jnp.minimum(innovation_mean**2 * (2.0 * plant.TAU[1] / dt - 1.0), noise.CLIP)
    return memory._replace(
        burst=memory.burst + fade / plant.BURST_S * (burst - memory.burst),
        innovation_mean=innovation_mean,
        lasting=memory.lasting + fade / LASTING_MEMORY_S * (lasting - memory.lasting),
    )


def variance(memory: Memory, seen: Look, x, y, white, B, n: int, dt):
    """(4,) variance by which the plant's model may be wrong at this tick; x (n_x,) state, white (4,) noise variance, B (4, n)."""
    import jax.numpy as jnp

    u, x = seen.u, x[:AXIS_STATES].reshape(4, PER_AXIS)
    motion = jnp.concatenate([u[n : n + 3], u[n + 3 : n + 4] - n])
    rates = jnp.concatenate([u[n + 4 : n + 7], jnp.zeros(1)])
    missing = jnp.where(u[:n] > AT_LIMIT * u[n + 9], u[:n] - BELOW_LIMIT * u[n + 9], 0.0)
    axial = jnp.where(jnp.isnan(u[n + 12]), 0.0, u[n + 12])
    wash = WASH * jnp.clip(-axial / WASH_SINK - 1.0, 0.0, 1.0) * u[:n]
    step = jnp.maximum(jnp.abs(y - memory.y) - 4.0 * jnp.sqrt(white), 0.0)
    return ERROR_TICKS * (
        (jnp.asarray(GAIN_ERROR) * x[:, GAIN] * motion) ** 2
        + (DAMPING_ERROR * x[:, DAMPING] * rates) ** 2
        + (FAR_ERROR * n * seen.far) ** 2
        + B**2 @ (missing**2 + wash**2)
        + (jnp.arange(4) == 3) * (AIR_ERROR * n * axial) ** 2
        + (LAG_ERROR_S / dt * step) ** 2
    )
