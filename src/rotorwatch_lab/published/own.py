"""The raw output of a published method at each step, and as series over a flight."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from typing import Any

import numpy as np

from rotorwatch.flight.method_series import INTERVAL, SET, MethodSeries
from rotorwatch_lab.maths import plant


class Own(namedtuple("Own", "theta theta_cov x x_var innovation innovation_var status")):
    """theta (n,), theta_cov (n, n), x, x_var (n_x,), innovation, innovation_var (n_y,), status of one step."""


def own(out: Any) -> Own:
    """The raw estimate in a method's output: an `Estimate`, or a named tuple that holds one."""
    import jax.numpy as jnp

    e = getattr(out, "estimate", out)
    return Own(e.theta, e.theta_cov, e.x, jnp.diagonal(e.x_cov), e.innovation, jnp.diagonal(e.innovation_cov), e.status)


def says(estimator: Any) -> str:
    """Describes the covariances of that estimator: interval, or shape of a set."""
    from rotorwatch_lab.maths.set_membership import SetMembership

    return SET if isinstance(estimator, SetMembership) else INTERVAL


def series(name: str, estimator: Any, outputs: Own, time: np.ndarray, hop: int, dt: float, notes: Sequence[str] = ()) -> MethodSeries:
    """The stacked outputs of an estimator as series. time (T,): ends of the steps [s]; hop: which flight of the log, from 1."""
    system = estimator.system

    def named(what: str, count: int) -> tuple[str, ...]:
        return tuple(getattr(system, what, None) or (f"{what[0]}_{k + 1}" for k in range(count)))

    def units(what: str, count: int) -> tuple[str, ...]:
        return tuple(getattr(system, what, None) or ("",) * count)

    return MethodSeries(
        method=name, plant=str(getattr(system, "name", "own plant")), says=says(estimator), time=np.asarray(time),
        hop=np.full(len(time), hop), theta=np.asarray(outputs.theta), theta_cov=np.asarray(outputs.theta_cov),
        x=np.asarray(outputs.x), x_var=np.asarray(outputs.x_var), innovation=np.asarray(outputs.innovation),
        innovation_var=np.asarray(outputs.innovation_var), status=np.asarray(outputs.status),
        theta_names=plant.theta_names(system),
        x_names=named("x_names", system.n_x), x_units=units("x_units", system.n_x),
        y_names=named("y_names", system.n_y), y_units=units("y_units", system.n_y), dt=dt, notes=tuple(notes),
    )  # fmt: skip
