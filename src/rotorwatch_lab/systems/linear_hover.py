"""A multirotor near hover: attitude and height as double integrators that the rotors drive, all states measured.

    d(roll, pitch, yaw, down)/dt = (p, q, r, v_down)
             d(p, q, r, v_down)/dt = B diag(u) (1 - theta) + (0, 0, 0, g),        y = x

B (4, n): accelerations per unit of input; u (n,): commands, in the unit of B (pulse-width counts for the paper's quadrotor);
theta (n,): loss of effectiveness. World NED, body FRD, SI; angles and rates are taken for each other, as near hover.
Source: Nguyen, Huynh, Do, Mung and Hong, Robust fault estimation using the intermediate observer, Sensors 20 (2020) 4917,
eq. (6). The paper's height and thrust point up and its angles are the autopilot's; here only height and thrust turn over.
What couples the axes (gyroscopic torque, tilt) is the paper's disturbance xi, and is not in this plant.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.base.physics import G0
from rotorwatch_lab.maths.plant import Rotors


class LinearHover(Rotors):
    """x = (roll, pitch, yaw, down, p, q, r, v_down) (8,), u (n,) commands, theta (n,) losses, y = x."""

    name = "linear_hover"
    n_x = n_y = 8
    x_names = y_names = ("roll", "pitch", "yaw", "down", "p", "q", "r", "v_down")
    x_units = y_units = ("rad",) * 3 + ("m",) + ("rad/s",) * 3 + ("m/s",)
    x0 = np.zeros(8)
    P0 = np.eye(8)

    def __init__(self, B, *, gravity=G0, measured_sd=(2e-3,) * 3 + (0.02,) + (0.01,) * 3 + (0.05,), walk=(0.05,) * 4, u_unit="1"):
        """B (4, n): d(p, q, r, v_down)/dt per unit of u [rad/s^2, m/s^2; thrust lifts, so its row is negative].

        gravity [m/s^2]; measured_sd (8,): of one sample; walk (4,): disturbance accelerations as white noise [rad/s^2, m/s^2
        per square root of Hz]. u_unit: what u is in, for labels. Raises ConfigError for wrong shapes and values.
        """
        n = np.shape(B)[1] if np.ndim(B) == 2 else 0
        self.name_rotors(n, "command", u_unit)
        self.B = checks.finite("B", checks.shape("B", B, 4, n))
        self.gravity = checks.finite("gravity", gravity)
        self.measured_sd = checks.positive("measured_sd", checks.shape("measured_sd", measured_sd, 8))
        self.walk = checks.between("walk", checks.shape("walk", walk, 4), 0.0, np.inf)

    @classmethod
    def of(cls, airframe: dict) -> LinearHover:
        """The plant of an airframe file with `mass`, `inertia`, `[rotors]` x, y [m], spin, `thrust_max` [N], `drag_ratio` [m].

        With `counts_max` u is in counts, else 1 is full thrust. `gravity` and the sensors' `attitude_sd`, `height_sd`,
        `rate_sd` and `climb_sd` are taken where the file has them.
        """
        per_unit = float(airframe["thrust_max"]) / float(airframe.get("counts_max", 1.0))
        levers = cls.levers(airframe)
        M = per_unit * np.concatenate([levers, -np.ones((1, levers.shape[1]))])
        D = 1.0 / np.array([*airframe["inertia"], airframe["mass"]], float)
        usual = {"attitude_sd": 2e-3, "height_sd": 0.02, "rate_sd": 0.01, "climb_sd": 0.05}
        measured_sd = np.repeat([airframe.get(k, d) for k, d in usual.items()], (3, 1, 3, 1))
        unit = "counts" if "counts_max" in airframe else "1"
        return cls(D[:, None] * M, gravity=float(airframe.get("gravity", G0)), measured_sd=measured_sd, u_unit=unit)

    @property
    def hover(self):
        """(n,) equal commands that carry the weight."""
        return np.full(self.n_u, -self.gravity / np.sum(np.asarray(self.B)[3]))

    def f(self, x, u, theta, dt):
        """State after dt seconds of constant u, exactly."""
        acceleration = self.B @ (u * (1.0 - theta)) + jnp.array([0.0, 0.0, 0.0, 1.0]) * self.gravity
        v = x[4:] + dt * acceleration
        return jnp.concatenate([x[:4] + 0.5 * dt * (x[4:] + v), v])

    def h(self, x, u, theta):
        """All states."""
        return x

    def Q(self, dt):
        """(8, 8): white disturbance accelerations over dt."""
        W = jnp.diag(jnp.asarray(self.walk) ** 2)
        return jnp.block([[W * dt**3 / 3, W * dt**2 / 2], [W * dt**2 / 2, W * dt]])

    def R(self, u):
        """(8,) measurement noise variances."""
        return jnp.asarray(self.measured_sd) ** 2
