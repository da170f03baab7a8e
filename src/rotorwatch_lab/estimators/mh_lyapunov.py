"""Moving-horizon Lyapunov estimator: the Lyapunov law with a pull towards the estimate of a window of recent blocks.

Niermeyer, Pak and Lohmann 2017, section 3 and abstract. Blocks of 50 ms sum up what the losses did to the states and to
the outputs that only they move: z = Phi theta + noise; a window of them gives A = sum Phi' W Phi, b = sum Phi' W z. Added to
the law of `maths/lyapunov_law.py` is one of

    gradient     -k_g (A theta_hat - b) / (1 + tr A)
    proximal     kappa (theta* - theta_hat),  theta* = argmin_box t' A t / 2 - b' t + r/2 |t - theta_hat|^2_{Gamma^-1}

The proximal pull adds at most -kappa |theta* - theta_hat|^2_{Gamma^-1} to dV/dt: see docs/methods/mh_lyapunov.md.
"""

from __future__ import annotations

import math
from collections import namedtuple
from dataclasses import KW_ONLY, dataclass
from typing import Any, NamedTuple

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Estimate
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import bounded
from rotorwatch_lab.maths.lyapunov_law import TINY, Adaptation, State, advance, estimate, start
from rotorwatch_lab.maths.small import definite_solve

PULLS = ("gradient", "proximal")
SURPRISED = 2  # blocks in a row that empty the window


class Block(namedtuple("Block", "elapsed predicted slope whole direct direct_slope count noise")):
    """Sums over the current block. elapsed [s]; predicted (n_x,): states predicted without losses; slope (n_x, n_theta); whole (n_x,):
    measured at both ends; direct (n_y,), direct_slope (n_y, n_theta), count (n_y,); noise (n_x,)."""


class Carry(NamedTuple):
    """state: of the law. block: being summed. A (N, n_theta, n_theta), b (N, n_theta): the window, oldest first. target: theta*,
    or what the gradient pulls towards; pull, spread (n_theta, n_theta): its linear map and the covariance of its noise.
    surprises: blocks in a row that contradict the estimate."""

    state: State
    block: Block
    A: Any
    b: Any
    target: Any
    pull: Any
    spread: Any
    surprises: Any


@dataclass(eq=False, repr=False)
class MHLyapunov(Adaptation):
    """The Lyapunov law with a moving horizon: almost as cheap, and it uses information that single samples do not show.

    pull: "gradient" or "proximal". flush: empty the window after two blocks whose chi^2 is above `surprise`. block_s, window_s: lengths
    [s]. gradient_rate: k_g [1/s]. proximal_rate: kappa [1/s]. anchor_sd: how far theta* may stray from the estimate, sqrt(Gamma / r).
    The other keywords are those of `Lyapunov`. Raises ConfigError for plants with unmeasured states.
    """

    _: KW_ONLY
    pull: str = "proximal"
    flush: bool = True
    block_s: Any = 0.05
    window_s: Any = 1.0
    gradient_rate: Any = 70.0
    proximal_rate: Any = 2.0
    anchor_sd: Any = 0.07
    surprise: Any = 50.0

    name = "mh_lyapunov"
    not_kalman = "Its gains are fixed by a Lyapunov function and a window of equal weights; they do not follow the covariance."

    def __post_init__(self):
        checks.one_of("pull", self.pull, PULLS)
        super().__post_init__()
        dt = self.dt
        checks.positive("block_s", self.block_s)
        if not self.window_s >= self.block_s:
            raise ConfigError(f"window_s must be at least one block of {self.block_s:g} s, not {self.window_s:g}.")
        self.blocks = max(1, round(self.window_s / max(self.block_s, dt)))
        # Over a step as the exponential decays, so that a coarse step is stable too.
        self.gradient_gain = -math.expm1(-checks.positive("gradient_rate", self.gradient_rate) * dt) / dt
        checks.between("proximal_rate", self.proximal_rate, 0.0, 1.0 / dt)
        self.anchor = checks.positive("anchor_sd", self.anchor_sd) ** -2
        checks.positive("surprise", self.surprise)

    def init(self) -> Carry:
        """Nothing lost, an empty window."""
        state, k = start(self.system, self.theta_sd), self.system.n_theta
        empty = jnp.zeros((k, k))
        window = (jnp.zeros((self.blocks, k, k)), jnp.zeros((self.blocks, k)))
        block = self.new_block(state.measured, jnp.zeros(self.system.n_x))
        return Carry(state, block, *window, state.theta, empty, empty, jnp.zeros((), jnp.int32))

    def new_block(self, measured, seen) -> Block:
        """A block that begins at the measured state; seen (n_x,): which states were measured there."""
        n, k, m = self.system.n_x, self.system.n_theta, self.system.n_y
        zero = jnp.zeros(())
        return Block(zero, measured, jnp.zeros((n, k)), seen, jnp.zeros(m), jnp.zeros((m, k)), jnp.zeros(m), jnp.zeros(n))

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Advance by dt seconds (None: the constructor's dt) with input u held over the step and y at its end."""
        dt = self.dt if dt is None else dt
        before, n = carry.state, self.system.n_x
        state, e, S, at = advance(self.law, before, u, y, valid, dt, self.walk)

        weight = (dt * valid.any() * self.law.moving(u))[:, None]  # nothing is pulled where nothing is measured
        theta = self.law.project(state.theta + weight[:, 0] * (carry.target - carry.pull @ state.theta))
        keep = jnp.eye(n + self.system.n_theta).at[n:, n:].add(-weight * carry.pull)
        P = keep @ state.P @ keep.T
        # The noise of a window is the same for as long as it lasts: its effect adds up, not its square.
        P = P.at[n:, n:].add(weight * carry.spread * weight.T * self.window_s / dt)
        state = state._replace(theta=theta, P=0.5 * (P + P.T))

        block, seen = self.gather(carry.block, before, at, u, y, valid, dt)
        carry = carry._replace(state=state, block=block)
        complete = block.elapsed >= max(self.block_s, self.dt) - 0.5 * dt
        carry = jax.lax.cond(complete, lambda c: self.close(c, u, seen, at.C_left), lambda c: c, carry)
        return carry, estimate(state, e, S, valid)

    def gather(self, block: Block, before: State, at, u, y, valid, dt) -> tuple[Block, Any]:
        """The block extended by one step, and which states (n_x,) are measured at its end."""
        needed = jnp.abs(at.C_left) > TINY
        seen = jnp.all(~needed | valid[None, :], axis=1).astype(float)
        direct = jnp.where(valid & at.direct, 1.0, 0.0)
        direct_output = jnp.where(valid & at.direct, y - at.y, 0.0) + direct * (at.D @ before.theta)
        step = at.x - before.measured - dt * at.G @ before.theta
        noise = jnp.diagonal(self.system.Q(dt)) + TINY
        added = Block(
            block.elapsed + dt,
            block.predicted + step,
            block.slope + dt * at.G,
            block.whole,
            block.direct + direct_output,
            block.direct_slope + direct[:, None] * at.D,
            block.count + direct,
            block.noise + noise,
        )
        return added, seen

    def close(self, carry: Carry, u, seen, C_left) -> Carry:
        """Move the block into the window and recompute the window's pull."""
        theta, block = carry.state.theta, carry.block
        A_new, b_new, chi2 = self.summary(block, carry.state.measured, u, seen, C_left, theta)
        surprises = jnp.where(chi2 > self.surprise, carry.surprises + 1, 0).astype(jnp.int32)
        old = jnp.where(self.flush & (surprises == SURPRISED), 0.0, 1.0)
        A = jnp.concatenate([old * carry.A[1:], A_new[None]])
        b = jnp.concatenate([old * carry.b[1:], b_new[None]])
        target, pull, spread = self.pull_of(A.sum(axis=0), b.sum(axis=0), theta)
        return Carry(carry.state, self.new_block(carry.state.measured, seen), A, b, target, pull, spread, surprises)

    def summary(self, block: Block, measured, u, seen, C_left, theta):
        """Phi' W Phi, Phi' W z and chi^2 of z - Phi theta for a block that is complete."""
        R = self.system.R(u)
        average = jnp.maximum(block.count, 1.0)
        z = jnp.concatenate([measured - block.predicted, block.direct / average])
        Phi = jnp.concatenate([block.slope, block.direct_slope / average[:, None]])
        Dn = block.direct_slope / average[:, None]
        gyro = jnp.sum(C_left**2 * R[None, :], axis=1)  # variance of a measured state
        w_x = block.whole * seen / (2.0 * gyro + block.noise)
        w_y = jnp.where(block.count > 0, average / R, 0.0)
        # A step that serves all directions needs A well conditioned more than it needs W right.
        if self.pull == "gradient":
            w_x = block.whole * seen * self.law.M / self.block_s**2
            w_y = jnp.where(block.count > 0, 1.0, 0.0) / jnp.maximum(jnp.sum(Dn**2, axis=1), TINY)
        W = jnp.concatenate([w_x, w_y])
        residual = z - Phi @ theta
        A = Phi.T @ (W[:, None] * Phi)
        return 0.5 * (A + A.T), Phi.T @ (W * z), jnp.sum(W * residual**2)

    def pull_of(self, A, b, theta):
        """(target, pull, spread): the losses are moved by target - pull theta [1/s], whose noise has the covariance spread."""
        if self.pull == "gradient":
            gain = self.gradient_gain / (1.0 + jnp.trace(A))
            return gain * b, gain * A, gain**2 * A
        k = len(b)
        H = A + self.anchor * jnp.eye(k)
        low, high = self.law.bounds
        wanted = bounded.quadratic(H, b + self.anchor * theta, low, high)
        solve = lambda right: definite_solve(H, right)  # noqa: E731
        share = solve(A)
        spread = solve(share.T)
        # The box is in `wanted`; the pull's derivative is that of the free minimum: theta* = share theta_true + (I - share) theta.
        target = self.proximal_rate * (wanted - theta + share @ theta)
        return target, self.proximal_rate * share, self.proximal_rate**2 * 0.5 * (spread + spread.T)
