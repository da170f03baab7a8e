"""The types that every method is written in. Imports nothing of ours.

A *system* is one plant: how its state moves, what is measured, how uncertain both are. An *estimator* is one method
that can be run on systems; a *detector* turns its estimates into decisions. All three are pure: ``init() -> carry``
and ``step(carry, ...) -> (carry, out)`` with static shapes, so that one definition serves a single flight, a batch
under ``jax.vmap``, an accelerator and, through its jaxpr, exported C. Rules for step functions: docs/architecture.md.

theta is loss of effectiveness: 0 healthy, 1 dead.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

Array = Any
Carry = Any


class Estimate(NamedTuple):
    """Output of an estimator after one step. Arrays only; n_x states, n_theta losses, n_y measurements.

    x, x_cov: (n_x,), (n_x, n_x). theta, theta_cov: (n_theta,), (n_theta, n_theta). innovation, innovation_cov: (n_y,), (n_y, n_y): y minus
    its prediction, 0 where invalid. status: int32, 0 ok, 1 not ready, 2 no valid measurement."""

    x: Array
    x_cov: Array
    theta: Array
    theta_cov: Array
    innovation: Array
    innovation_cov: Array
    status: Array


class Decision(NamedTuple):
    """Output of a detector after one step.

    log_odds: (n_h,) natural log of each hypothesis' evidence against "nothing changed". statistic: log of the fault hypotheses' evidence
    over everything else's. alarm: bool. onset: estimated steps since the change. best: index of the most probable fault hypothesis."""

    log_odds: Array
    statistic: Array
    alarm: Array
    onset: Array
    best: Array


@runtime_checkable
class System(Protocol):
    """A plant. Shapes: x (n_x,), u (n_u,), theta (n_theta,), y (n_y,).

    theta is loss of effectiveness per actuator (0 healthy, 1 dead), then the plant's further parameters (bias). A plant whose state is no
    vector space offers `retract` and `local` too. x_names, x_units and so on: a tuple per variable, SI. x0, P0: an estimator's initial
    state and its covariance."""

    name: str
    n_x: int
    n_u: int
    n_theta: int
    n_y: int
    x0: Array
    P0: Array

    def f(self, x: Array, u: Array, theta: Array, dt: Array) -> Array:
        """State after dt seconds."""
        ...

    def h(self, x: Array, u: Array, theta: Array) -> Array:
        """Measurement."""
        ...

    def Q(self, dt: Array) -> Array:
        """(n_x, n_x) process noise covariance over dt."""
        ...

    def R(self, u: Array) -> Array:
        """(n_y,) measurement noise variances: measurements are independent."""
        ...


@runtime_checkable
class Estimator(Protocol):
    """A method on a system, made by `Method(system, dt, ...)` with the method's tuning as keywords.

    name: on the command line. not_kalman: why it is not the augmented Kalman filter on a linear Gaussian plant; empty when it is (a test
    then requires it). The constructor raises ConfigError for a plant that the method is not defined for, and for wrong shapes and
    values."""

    name: str
    not_kalman: str
    system: Any

    def init(self) -> Carry:
        """The carry before the first measurement."""
        ...

    def step(self, carry: Carry, u: Array, y: Array, valid: Array, dt: Array = None) -> tuple[Carry, Any]:
        """A time step with input u, measurement y (n_y,) and its validity mask; causal and pure.

        dt: s; None where the estimator was made for one step length. Returns the carry and an `Estimate`, or a named tuple of the method's
        own that contains one in its field ``estimate``."""
        ...
