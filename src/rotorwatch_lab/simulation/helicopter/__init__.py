"""The helicopter in closed loop: `simulate` of a scenario whose frame is a helicopter's flies it. See docs/simulation.md."""

from rotorwatch_lab.simulation.helicopter import table
from rotorwatch_lab.simulation.helicopter.aircraft import HelicopterAircraft, Plan, Record, plan

__all__ = ["HelicopterAircraft", "Plan", "Record", "plan", "table"]
