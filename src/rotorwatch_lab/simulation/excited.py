"""A multirotor with an excitation on top of its mixer's output: small commands in the null space of its geometry.

The excitation (`control.excitation`) is added after the mixer, where an autopilot would add it, and cut at the commands' limits; the
log holds what the rotors get. A plan's `schedule` is the `control.excitation.Signal`.
"""

from __future__ import annotations

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.control import excitation
from rotorwatch_lab.simulation.multirotor import Drives, Multirotor, Plan


class Excited(Multirotor):
    """The `loop.Aircraft` of every frame whose plan has an excitation in its schedule; one that never begins changes nothing."""

    def mixed(self, plan: Plan, now, t, body, gyro, turning, drives: Drives) -> tuple:
        """The mixer's demands with the excitation at time t added to them."""
        demand, free = super().mixed(plan, now, t, body, gyro, turning, drives)
        return load_jax().numpy.clip(demand + excitation.value_at(plan.schedule, t), 0.0, 1.0), free


EXCITED = Excited()
