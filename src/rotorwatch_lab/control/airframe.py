"""The numbers of a vehicle that its control is designed from."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch_lab.control.allocation import effectiveness


class Airframe(NamedTuple):
    """n rotors, SI, body FRD, about the centre of mass. mass; J (3, 3); x, y (n,) and z of the hubs; spin (n,) +1 counter-clockwise from
    above; thrust_max (n,); drag_ratio [m]; lag [s] of a rotor; rotor_momentum: angular momentum of one rotor at full speed; k_d, k_z
    [N s/m]: rotor drag, and thrust lost to climbing, of one rotor at full speed; drag (3,) [N s^2/m^2] of the body."""

    mass: float
    J: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: float
    spin: np.ndarray
    thrust_max: np.ndarray
    drag_ratio: float
    lag: float
    rotor_momentum: float
    k_d: float
    k_z: float
    drag: np.ndarray

    @classmethod
    def of(cls, craft: Any) -> Airframe:
        """The same of anything that has these numbers as attributes, such as `rotorwatch_lab.simulation.dynamics.Craft`."""
        values: dict[str, Any] = {}
        for name in cls._fields:
            value = np.asarray(getattr(craft, name), float)
            values[name] = value if value.ndim else float(value)
        return cls(**values)

    @property
    def B(self) -> np.ndarray:
        """(4, n) thrust, roll, pitch and yaw moment of each rotor at full command, healthy [N, N m]."""
        return effectiveness(self.x, self.y, self.spin, self.thrust_max, self.drag_ratio)
