"""An airframe: the place of its rotors, the conversion of commands to thrust, and parameters identified from flights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Rotor:
    """A rotor.

    x: forward; y: to the right [both in arm lengths, or m]; spin: +1 counter-clockwise seen from above, -1 clockwise; share: its thrust
    relative to the vehicle's other rotors at the same command; lower: it works in the wash of a rotor above it.

    A counter-clockwise propeller turns the body clockwise: positive yaw torque in FRD."""

    x: float
    y: float
    spin: int
    share: float = 1.0
    lower: bool = False


# In the wash of an upper rotor one or two tenths of the lower one's thrust are lost (Leishman, Principles of Helicopter
# Aerodynamics, coaxial rotors).
LOWER_SHARE = 0.85
SAME_ARM = 0.02


def coaxial(rotors: tuple[Rotor, ...], lower: Sequence[bool] | np.ndarray) -> tuple[Rotor, ...]:
    """The same rotors, those of the mask `lower` (n,) marked as such and with LOWER_SHARE of thrust."""
    return tuple(replace(r, share=LOWER_SHARE, lower=True) if under else r for r, under in zip(rotors, lower))


def lower_of_pairs(rotors: tuple[Rotor, ...], depth: Sequence[float] | np.ndarray | None = None) -> np.ndarray:
    """(n,) bool: rotors with another above them on the same arm.

    depth (n,): how far down each rotor sits, in any unit; of equal ones the later is the lower, as autopilots number them."""
    place = np.array([(r.x, r.y) for r in rotors])
    together = np.linalg.norm(place[:, None] - place[None], axis=2) < SAME_ARM * np.abs(place).max()
    rank = np.argsort(np.argsort(np.zeros(len(rotors)) if depth is None else depth, kind="stable"))
    return (together & (rank[None] < rank[:, None])).any(axis=1)


def note_on_coaxial(rotors: tuple[Rotor, ...]) -> tuple[str, ...]:
    """The assumption of `coaxial`, as a sentence, if any."""
    lower = [str(k + 1) for k, r in enumerate(rotors) if r.lower]
    if not lower:
        return ()
    given = f"are taken to give about {LOWER_SHARE:.0%} of the upper ones' thrust, and more or less as the flight shows"
    return (f"Lower rotors of coaxial pairs ({', '.join(lower)}) {given}.",)


@dataclass(frozen=True)
class ThrustCurve:
    """Command -> share of full thrust: with a = (u - u_min) / (u_max - u_min) clipped to [0, 1], times the battery ratio V,

        f(a) = (1 - expo) a V + expo (a V)^2

    u_min, u_max: commands of no and of full thrust, in the unit of the ``motors`` signal (us, or 1); ArduPilot's PWM of
    MOT_SPIN_MIN and MOT_SPIN_MAX. expo: 0 for a straight line to 1 for a parabola; ArduPilot's MOT_THST_EXPO, PX4's THR_MDL_FAC.
    known: False when expo is an assumption."""

    u_min: float
    u_max: float
    expo: float
    known: bool = True

    @property
    def believed(self) -> tuple[float, float]:
        """expo and its standard deviation: an assumed one may be any from 0 to 1; a logged one is taken as it is, and its error counts in
        the interval of a loss (engine/events/losses.py)."""
        return self.expo, 0.0 if self.known else 0.35

    def __call__(self, u: np.ndarray, battery: np.ndarray | float = 1.0) -> np.ndarray:
        a = np.minimum(np.maximum((u - self.u_min) / (self.u_max - self.u_min), 0.0), 1.0) * battery
        return (1.0 - self.expo) * a + self.expo * a * a


@dataclass(frozen=True)
class Vehicle:
    """Geometry, mixer and thrust curve of one airframe.

    name: of the airframe. rotors: in the autopilot's order. curve: command to thrust. lag_s: time constant of a motor [s]. source: where
    this is from. extra: what only some vehicles need (docs/simulation.md).
    mixer: (n, 4) factors (roll, pitch, yaw, throttle) with which the autopilot turns its rate controller's output
    into rotor thrusts, or None when unknown. identified: gains learned from healthy flights (see calibrate), or None.
    assumptions: sentences on what was not in the log and had to be assumed."""

    name: str
    rotors: tuple[Rotor, ...]
    curve: ThrustCurve
    mixer: np.ndarray | None = None
    lag_s: float = 0.03
    source: str = ""
    assumptions: tuple[str, ...] = ()
    identified: Mapping | None = None
    extra: Mapping = field(default_factory=dict)

    def effectiveness(self) -> np.ndarray:
        """B (4, n): roll, pitch, yaw torque and thrust per unit of commanded thrust of each rotor, rows scaled to a largest
        entry of 1 and then by the rotors' shares, whose mean counts as 1.

        FRD: thrust T at (x, y) pointing up gives roll -y T, pitch +x T; yaw is spin times a common drag ratio."""
        return self._effectiveness.copy()

    @cached_property
    def _effectiveness(self) -> np.ndarray:
        x, y, spin, share = (np.array([getattr(r, k) for r in self.rotors], float) for k in ("x", "y", "spin", "share"))
        scale = max(np.abs(x).max(), np.abs(y).max())
        return np.stack([-y / scale, x / scale, spin, np.ones_like(x)]) * (share / share.mean())
