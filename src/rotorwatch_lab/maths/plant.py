"""Checks of a plant before a method is made for it (its parts, their shapes and its noise), its start, and the names of its losses."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.errors import ConfigError

SIZES, PARTS = ("n_x", "n_u", "n_theta", "n_y"), ("f", "h", "Q", "R", "x0", "P0")


def checked(method: str, system: Any, dt: Any) -> Any:
    """The plant, unchanged, after checks that `method` is defined for it with steps of dt seconds. Every estimator's constructor calls it.

    R (n_y,) has to be variances: of independent measurements, one after the other is taken in. Raises ConfigError for missing
    parts, wrong shapes, a Q or P0 that is no covariance and an R that is not n_y numbers of at least 0.
    """
    jax()  # before anything of the plant is traced: it switches float64 on
    checks.has(system, method, *PARTS, *SIZES)
    checks.positive("dt", dt)
    name = checks.plant_name(system)
    checks.finite(f"x0 of the plant {name}", checks.shape(f"x0 of the plant {name}", system.x0, system.n_x))
    checks.covariance(f"P0 of the plant {name}", system.P0, system.n_x)
    checks.covariance(f"Q of the plant {name}", system.Q(dt), system.n_x)
    variances, label = system.R(np.ones(system.n_u)), f"R of the plant {name}"
    if np.shape(variances) == (system.n_y, system.n_y):
        raise ConfigError(
            f"{label} is a matrix; it must be the variances ({system.n_y},) of independent measurements. Where noises belong together, "
            "multiply y and h by the inverse of the Cholesky factor of their covariance: R is ones then."
        )
    checks.finite(label, checks.shape(label, variances, system.n_y))
    if checks.concrete(variances) and (least := float(np.min(np.asarray(variances, float), initial=np.inf))) < 0:
        raise ConfigError(f"{label} holds {least:g}; it must be variances, which are not negative.")
    return system


def start(system: Any, theta_cov: Any) -> tuple[Any, Any]:
    """((n_x + n_theta,), its covariance): the plant's x0 and P0, then no losses, with the covariance theta_cov."""
    s = jnp.concatenate([jnp.asarray(system.x0, float), jnp.zeros(system.n_theta)])
    return s, jax.scipy.linalg.block_diag(jnp.asarray(system.P0, float), theta_cov)


class Rotors:
    """Base of plants with n rotors: as many inputs as losses, their names, and B_tau of an airframe file."""

    def name_rotors(self, n: int, command: str = "thrust", unit: str = "1") -> None:
        """Set n_u, n_theta and the names of inputs and losses. JAX computes in float64 from here on: before the plant is traced."""
        jax()
        self.n_u = self.n_theta = n
        self.u_names, self.u_units = tuple(f"{command}_{i + 1}" for i in range(n)), (unit,) * n
        self.theta_names = tuple(f"loss_{i + 1}" for i in range(n))

    @staticmethod
    def levers(airframe: dict) -> np.ndarray:
        """(3, n) roll, pitch and yaw moment of each rotor per unit of its thrust [m], of a file with `[rotors]` x, y [m], spin and
        `drag_ratio` [m]."""
        x, y, spin = (np.array(airframe["rotors"][k], float) for k in ("x", "y", "spin"))
        return np.stack([-y, x, float(airframe["drag_ratio"]) * spin])


def theta_names(system: Any) -> tuple[str, ...]:
    """(n_theta,) the plant's own names of its losses, else loss_1, loss_2 .. and, for what it adds to them, theta_5 .."""
    names = getattr(system, "theta_names", None)
    if names is not None:
        return tuple(names)
    return tuple(f"{'loss' if i < system.n_u else 'theta'}_{i + 1}" for i in range(system.n_theta))
