"""What a push does to the side force: the only force of a rotor on the frame is along its axis, so a loss does not move it at once.

A force F from outside that starts to push sideways is a step of the specific force across the thrust axis. As the vehicle leans into it,
it also pulls down along the thrust axis, by F^2 / (m g): rotors have to give that much more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.base.physics import G0
from rotorwatch.engine.bindings.explaining import Span

MEAN_S = 0.5  # of the side force in ticks: a step is the difference of two means
NEAR_S = 0.15  # by which an onset may be wrong
WIDTH = 1.2  # m/s^2: standard deviation of each component of a push
# Steps of the side force without a push, as a multiple of this flight's: a vehicle that leans gathers speed. Scale and freedom of
# Student's t, fitted to 351 losses in the open world.
SCALE, TAILS = 2.0, 4.0
LEAST = 0.01  # m/s^2: standard deviation of steps in still air
LATER_S = 1.0  # after the onset, from which on a push may end


class Shove(NamedTuple):
    """A step of the side force. size: its length; usual: standard deviation of each component of this flight's steps; both in m/s^2."""

    size: float = 0.0
    usual: float = 0.0

    @property
    def log_odds(self) -> float:
        """Log-likelihood of the step with a push, less that without."""
        if not self.usual:
            return 0.0
        width, wide = SCALE * self.usual, math.hypot(WIDTH, self.usual)
        without = 2.0 * math.log(width) + 0.5 * (TAILS + 2.0) * math.log1p((self.size / width) ** 2 / TAILS)
        return without - 2.0 * math.log(wide) - 0.5 * (self.size / wide) ** 2

    @property
    def lift(self) -> float:
        """Thrust that the push takes, as a share of the weight."""
        return (self.size / G0) ** 2


@dataclass(frozen=True, eq=False)
class SideForce:
    """The side force about a change."""

    where: Span

    @property
    def apart(self) -> int:
        """Ticks from one mean to the next."""
        return max(round(MEAN_S / self.where.ticks.dt), 1)

    @cached_property
    def steps(self) -> np.ndarray:
        """(T, 2) its steps in axes that do not turn with the vehicle [m/s^2]; none where it is not measured."""
        ticks, apart = self.where.ticks, self.apart
        if ticks.side is None or len(ticks.time) <= apart:
            return np.zeros((0, 2))
        turn = np.cumsum(np.where(np.isfinite(ticks.rate[:, 2]), ticks.rate[:, 2], 0.0))[:-apart] * ticks.dt
        ahead, right = (ticks.side[apart:] - ticks.side[:-apart]).T
        return np.stack([ahead * np.cos(turn) - right * np.sin(turn), ahead * np.sin(turn) + right * np.cos(turn)], axis=1)

    @cached_property
    def sizes(self) -> np.ndarray:
        """(T,) their lengths [m/s^2]."""
        return np.hypot(*self.steps.T)

    def _near(self, at: int) -> slice:
        near = round(NEAR_S / self.where.ticks.dt)
        return slice(max(at - near, 0), at + near + 1)

    def shove(self, at_s: float) -> Shove:
        """The step at a time."""
        close = self.sizes[self._near(int(np.searchsorted(self.where.ticks.command_time, at_s)))]
        usual = self.sizes[: max(self.where.onset - self.apart, 0)]
        if not usual.size or not close.size:
            return Shove()
        return Shove(float(close.max()), math.hypot(np.sqrt(median(usual**2) / (2.0 * math.log(2.0))), LEAST))

    def end_s(self) -> float:
        """Time from which on a push may have ended: that of the largest step back after the onset, less NEAR_S [s]."""
        first, near = self.where.onset + round(LATER_S / self.where.ticks.dt), self._near(self.where.onset)
        if len(self.steps) <= first:
            return np.inf
        back = self.steps[first:] @ self.steps[near][np.argmax(self.sizes[near])]
        return float(self.where.ticks.command_time[first + int(np.argmin(back))]) - NEAR_S
