"""The Kalman filter of one explanation: the plant's state x and the losses theta of the rotors that it says are weak.

    s = [x; theta],   s <- A s,   P <- A P A' + Q            Q: noise.py; theta walks while it is refined
    nu = y_a - h_a s,   S = h_a P h_a' + R_a,   s <- s + K nu          one axis a after the other: R is diagonal

K is the Kalman gain times the share that each state may learn (model_error.py); the covariance update holds for any gain (Joseph). A loss
is refined for USUAL_S, then taken as known, so that errors of the model cannot wear it away.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.engine.default import noise, plant, posterior
from rotorwatch.engine.default.plant import AIR, B1, B2, B3, CURVE, PER_AXIS
from rotorwatch.engine.default.posterior import Branches
from rotorwatch.engine.estimator.kalman import MOVING_S, OUTLIER, THETA_WALK

BIASES = np.array([a * PER_AXIS + b for a in range(4) for b in (B1, B2, B3)])


def restart(branches: Branches, P0, begins, hop) -> Branches:
    """Where `begins`, biases are open again, with P0 (n_x, n_x): after a contact a loss that was known stays; with a new `hop` the vehicle
    starts anew, and only what it is like stays known, of rotors that were not weak. Either ends the competition of explanations."""
    import jax.numpy as jnp

    n_s = branches.s.shape[1]
    weak = jnp.concatenate(
        [jnp.zeros((len(branches.active), n_s - branches.active.shape[1]), bool), branches.active], axis=1
    )
    keep = jnp.where(weak, 0.0, jnp.ones(n_s).at[BIASES].set(0.0))
    built = weak[:, :, None] * jnp.eye(n_s) * plant.BUILT_SD**2
    rows = np.ix_(BIASES, BIASES)
    opened = jnp.zeros((n_s, n_s)).at[rows].set(jnp.asarray(P0)[rows])
    alone = jnp.where(jnp.arange(posterior.PLACES) == 0, 0.0, posterior.NEVER)
    return branches._replace(
        s=jnp.where(hop, branches.s * keep, branches.s),
        P=jnp.where(hop, branches.P * keep[:, :, None] * keep[:, None, :] + built, branches.P)
        + jnp.where(begins, opened, 0.0),
        active=branches.active & ~hop,
        learning=jnp.where(hop, 0.0, branches.learning),
        theta_var=jnp.where(hop, 0.0, branches.theta_var),
        alike=branches.alike & ~hop,
        weight=jnp.where(begins, alone, branches.weight),
    )


def predict(branches: Branches, decay, variances, burst_factor, flying, dt) -> Branches:
    """One tick ahead. decay (n_x,): of the plant's states; variances (4, 4) of the noise model; burst_factor: by how much errors have been
    larger than that. A loss that has been refined long enough is taken as known, its variance is remembered; one that is none is over."""
    import jax
    import jax.numpy as jnp

    n_x = len(decay)
    A = plant.arrays(dt).concatenate([decay, np.ones(branches.s.shape[1] - n_x)])
    q_x = jnp.where(flying, noise.process_variance(variances, dt), 0.0)
    q_x = jnp.concatenate([q_x, jnp.zeros(n_x - q_x.size)])

    def one(s, P, active, learning, theta_var, theta_mean):
        theta = s[n_x:]
        mean = theta_mean + (theta - theta_mean) * (dt / MOVING_S)
        var = burst_factor * jnp.diagonal(P)[n_x:]
        finished = (learning > 0) & (learning <= dt)
        moving = finished & (jnp.abs(theta - mean) > jnp.sqrt(jnp.maximum(var, 0.0)))
        finished &= ~moving
        known = jnp.concatenate([jnp.ones(n_x), jnp.where(finished, 0.0, 1.0)])
        P = P * known[:, None] * known[None, :]
        learning = jnp.where(moving, MOVING_S, jnp.maximum(learning - dt, 0.0))
        Q = jnp.diag(jnp.concatenate([q_x, (learning > 0) * THETA_WALK * dt]))
        over = finished & (theta < plant.BUILT_SD)
        theta_var = jnp.where(over, 0.0, jnp.where(finished, var, theta_var))
        return A * s, A[:, None] * P * A[None, :] + Q, active & ~over, learning, theta_var, mean

    parts = ("s", "P", "active", "learning", "theta_var", "theta_mean")
    ahead = jax.vmap(one)(*(getattr(branches, name) for name in parts))
    return branches._replace(**dict(zip(parts, ahead)))


def update(s, P, rows, y, valid, R, gain_share, least=-np.inf, most=np.inf):
    """One tick's wrench y (4,) where valid (4,), of rows (4, n_s) and noise variances R (4,); gain_share (n_s,): share of the gain that
    each state gets; least, most (2,): bounds of the curve and of what air takes. Returns s, P, gains (4, n_s), innovations (4,),
    variances (4,)."""
    import jax.numpy as jnp

    gains, innovations, variances = [], [], []
    for a in range(4):
        h = rows[a]
        nu = y[a] - h @ s
        Ph = P @ h
        S = h @ Ph + R[a]
        S = jnp.maximum(S, nu * nu / OUTLIER**2)
        nu = jnp.where(valid[a], nu, 0.0)
        K = Ph * jnp.where(valid[a], 1.0 / S, 0.0) * gain_share
        # What no curve and no air explains is not learned; the bank knows that by the gain.
        some, both = jnp.where(jnp.abs(nu) > 1e-9, nu, jnp.inf), slice(CURVE, AIR + 1)
        K = K.at[both].set((jnp.clip(s[both] + K[both] * nu, least, most) - s[both]) / some)
        s = s + K * nu
        P = P - K[:, None] * Ph[None, :] - Ph[:, None] * K[None, :]
        P = P + jnp.where(valid[a], S, 0.0) * K[:, None] * K[None, :]
        gains.append(K)
        innovations.append(nu)
        variances.append(S)
    return s, 0.5 * (P + P.T), jnp.stack(gains), jnp.stack(innovations), jnp.stack(variances)
