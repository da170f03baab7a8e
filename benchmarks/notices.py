"""What is reported of vehicles that are built, loaded or set up badly, and of healthy ones: the notices that accuse no rotor.

    python benchmarks/notices.py [--flights 10] [--healthy 100] [--kind NAME]... [--jobs 1] [--list]

Simulated flights of each kind, and the healthy ones of plans/open.toml but for those whose rotors are at their limit by the plan. Each is
assessed by `diagnose` on the log that it writes. Printed: of each notice, in how many flights of its kind it is reported, and in how many
healthy ones. --list: each flight with what is reported of it. A flight follows from its kind and number alone.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import rotorwatch as rw
from rotorwatch.base.many import spread
from rotorwatch.flight import kinds
from rotorwatch_lab.campaign import batch
from rotorwatch_lab.campaign.plan import read
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.simulation import logbook, scenario
from rotorwatch_lab.simulation import plan as flight_plan
from rotorwatch_lab.simulation.loop import fly_each
from rotorwatch_lab.simulation.multirotor import MULTIROTOR
from rotorwatch_lab.simulation.scenario import Scenario

OPEN = Path(__file__).resolve().parents[1] / "plans" / "open.toml"
HEALTHY, BY_PLAN = "healthy: ", "healthy: all rotors at their limit"


def _any(rng: np.random.Generator, number: int, frames: tuple[str, ...] = ("quad-x", "hexa-x")) -> dict[str, Any]:
    """A flight of a usual vehicle."""
    return {
        "duration_s": 60.0, "seed": number, "autopilot": ("ardupilot", "px4")[number % 2],
        "airframe": {
            "frame": frames[number // 2 % len(frames)], "mass_kg": rng.uniform(1.0, 4.0), "arm_m": rng.uniform(0.2, 0.4),
            "thrust_to_weight": rng.uniform(1.9, 2.6), "expo": rng.uniform(0.4, 0.75), "rotor_spread": 0.02,
        },
        "trajectory": {"kind": "square", "altitude_m": 6.0, "speed_m_s": 2.5},
        "wind": {"speed_m_s": rng.uniform(0.0, 4.0), "from_deg": rng.uniform(0.0, 360.0)},
    }  # fmt: skip


def at_limit(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """Up and down as fast as a vehicle climbs that has a quarter or a third of its thrust left."""
    table = _any(rng, number)
    table["airframe"]["thrust_to_weight"] = rng.uniform(1.22, 1.32)
    table["trajectory"] = {"kind": "climb", "altitude_m": 6.0, "size_m": 15.0, "speed_m_s": 5.0}
    return table


def heavy(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """Hover at 82 to 88 % of full thrust."""
    table = _any(rng, number)
    air = table["airframe"]
    air["thrust_to_weight"] = 1.35
    air["payload_kg"] = air["mass_kg"] * (1.35 * rng.uniform(0.82, 0.88) - 1.0)
    table["trajectory"]["kind"] = "hover"
    return table


def twisted(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """Two mounts that are turned by 2 to 3.2 degrees, both the same way."""
    table = _any(rng, number)
    angle = float(rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 3.2))
    pair = rng.choice(4, 2, replace=False) + 1
    table["faults"] = [{"kind": "tilt", "rotor": int(r), "onset_s": 0.0, "angle_deg": angle} for r in pair]
    return table


def end_points(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """One ESC of a quadrotor begins 8 to 14 % of the range later than the others."""
    table = _any(rng, number, ("quad-x",))
    rotor, offset = int(rng.integers(1, 5)), float(rng.uniform(0.08, 0.14))
    table["faults"] = [{"kind": "bias", "rotor": rotor, "onset_s": 0.0, "strength": -offset}]
    return table


def exhausted(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """A hexarotor that lifts 1.35 to 1.48 times its weight, and loses a rotor high up."""
    table = _any(rng, number, ("hexa-x", "hexa-plus"))
    table["airframe"]["thrust_to_weight"] = rng.uniform(1.35, 1.48)
    table["trajectory"], table["duration_s"] = {"kind": "hover", "altitude_m": 15.0}, 75.0
    onset = float(rng.uniform(30.0, 40.0))
    table["faults"] = [{"kind": "complete loss", "rotor": int(rng.integers(1, 7)), "onset_s": onset}]
    return table


KINDS: Mapping[str, Callable[[np.random.Generator, int], dict[str, Any]]] = {
    kinds.AT_LIMIT: at_limit, kinds.HEAVY: heavy, kinds.UNEVEN: twisted, kinds.STANDS_APART: end_points, kinds.EXHAUSTED: exhausted,
}  # fmt: skip


def of_kind(name: str, number: int) -> Scenario:
    """Flight `number` of a kind."""
    rng = np.random.default_rng([list(KINDS).index(name), number])
    return scenario.from_table(KINDS[name](rng, number))


def reported(flown: Scenario) -> tuple[str, dict[str, str]]:
    """(verdict, reason of each notice) that `diagnose` gives of the log of a flight."""
    numbers = flight_plan(flown)
    (record,) = fly_each(MULTIROTOR, [numbers], flown.duration_s, flown.rate_hz, flown.record_hz, logbook.needed)
    answer = rw.diagnose(batch.logged(0, flown, numbers, record))
    return answer.verdict, {e.kind: e.reason for e in answer.events if e.kind in KINDS}


@functools.cache
def _plan():
    return read(OPEN)


def healthy(count: int) -> list[int]:
    """Numbers of the first healthy flights of the open world that are not at their limit by the plan."""
    plan, found = _plan(), []
    number = 0
    while len(found) < count:
        kind = plan.kind(number)
        if kind is not None and kind.name.startswith(HEALTHY) and kind.name != BY_PLAN:
            found.append(number)
        number += 1
    return found


def _one(work: tuple[str, int]) -> tuple[str, dict[str, str]]:
    name, number = work
    return reported(of_kind(name, number) if name else _plan().flight(number))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=10)
    parser.add_argument("--healthy", type=int, default=100)
    parser.add_argument("--kind", action="append", choices=tuple(KINDS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    work = [(name, k) for name in options.kind or KINDS for k in range(options.flights)]
    work += [("", number) for number in healthy(options.healthy)]
    done = sorted(spread.run(_one, work, options.jobs), key=lambda one: one.index)
    found = [one.result() for one in done]
    if options.list:
        for (name, number), (verdict, reasons) in zip(work, found, strict=True):
            print(name or "healthy", number, verdict, *(f"\n    {kind}: {why}" for kind, why in reasons.items()))
    rows = [
        [kinds.kind_of(name).noun, *(f"{sum(name in said for (own, _), (_, said) in zip(work, found) if own == of)}" for of in (name, ""))]
        for name in options.kind or KINDS
    ]
    heads = ("notice", f"reported in {options.flights} flights of its kind", f"reported in {options.healthy} healthy flights")
    print(tools.table(heads, rows))


if __name__ == "__main__":
    main()
