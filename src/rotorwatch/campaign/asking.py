"""Is a vehicle that is asked told apart? Flights with losses that are ambiguous, without and with an excitation of their commands.

    from rotorwatch.campaign import asking
    result = asking.run(flights=120)
    print(asking.markdown(result))

Every flight is flown and diagnosed as it is. Where the answer is `ambiguous` the log says what to ask (`default.asked.question`), the
excitation is designed from that (`control.excitation`), and the flight is flown again with it: up to its start it is the same to the
last bit. Healthy flights are excited as well, as if somebody wondered.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.backend import jax as load_jax
from rotorwatch.campaign import summary
from rotorwatch.control import excitation
from rotorwatch.default import asked, events, hypotheses, program
from rotorwatch.diagnose import diagnose
from rotorwatch.diagnosis import Event
from rotorwatch.errors import ConfigError
from rotorwatch.motion.airborne import airborne
from rotorwatch.motion.allocation import ambiguous_sets
from rotorwatch.motion.ticks import READY_S, observe
from rotorwatch.simulation import logbook, loop, one, prepare, rotation, scenario
from rotorwatch.simulation.excited import EXCITED
from rotorwatch.simulation.scenario import Scenario

FRAMES = ("hexa-x", "hexa-plus", "octa-x", "octa-plus")
ONSET_S, WAITS_S, ENDS_S = 16.0, 1.0, 14.0  # of the loss; from the answer to the excitation; from the loss to the end
WITHIN_S = 3.0
HEALTHY = 0.25  # share of flights


@dataclass(frozen=True)
class Row:
    """One flight. broken: its weak rotors, none of a healthy one; loss: of each. before, after: verdict without and with the excitation;
    named: the rotors named after it. right: these are the broken ones; wrong: others are named. asked: it was excited. length_s, amplitude
    (share of full thrust): of the excitation; turned_deg: by how much it moved the attitude; needed_s: how long the information bound asks
    for, None where WITHIN_S do not do."""

    flight: int
    frame: str
    mass_kg: float
    wind_m_s: float
    broken: tuple[int, ...]
    loss: float
    before: str
    after: str
    named: tuple[int, ...]
    asked: bool
    right: bool
    wrong: bool
    length_s: float | None
    amplitude: float | None
    turned_deg: float | None
    information: float | None
    needed: float | None


def families(B: np.ndarray) -> tuple[tuple[int, ...], ...]:
    """Sets of two rotors (1-based) that have the same effect as another set."""
    return tuple(sorted({s for both in ambiguous_sets(B) for s in both if len(s) == 2}))


def draw(flight: int, frame: str, seed: int) -> Scenario:
    """The scenario of a flight: vehicles from 0.8 to 8 kg, winds up to 5 m/s, losses from 15 to 45 % of two rotors alike."""
    rng = np.random.default_rng([seed, flight])
    mass = float(np.exp(rng.uniform(np.log(0.8), np.log(8.0))))
    pairs = families(airframes.named(f"px4-{frame}").effectiveness())
    who = pairs[rng.integers(len(pairs))] if rng.uniform() >= HEALTHY else ()
    loss = round(float(rng.uniform(0.15, 0.45)), 3)
    return scenario.from_table(
        {
            "name": f"asked {flight}", "duration_s": ONSET_S + ENDS_S, "seed": int(rng.integers(2**31 - 1)), "rate_hz": 200.0,
            "autopilot": "px4",
            "airframe": {
                "frame": frame, "mass_kg": mass, "arm_m": 0.3 * (mass / 2.0) ** (1.0 / 3.0),
                "thrust_to_weight": float(rng.uniform(1.9, 2.6)), "lag_s": float(rng.uniform(0.02, 0.05)),
            },
            "trajectory": {"altitude_m": 5.0, "land": False},
            "wind": {"speed_m_s": float(rng.uniform(0.0, 5.0)), "from_deg": float(rng.uniform(-180.0, 180.0))},
            "logging": {"profile": "fast"},
            "faults": [{"kind": "loss", "rotor": r, "onset_s": ONSET_S, "strength": loss} for r in who],
        }
    )  # fmt: skip


def fly(scenarios: Sequence[Scenario], signals: Sequence[excitation.Signal]) -> list[tuple[Any, Any]]:
    """(record, flight as logged) of each; equal numbers of rotors, rates and durations."""
    plans = [prepare.plan(s)._replace(schedule=signal) for s, signal in zip(scenarios, signals, strict=True)]
    first = scenarios[0]
    records = loop.fly_many(EXCITED, loop.stack(plans), first.duration_s, first.rate_hz, first.record_hz, _kept)
    records = load_jax().tree.map(np.asarray, records)
    flown = [one(records, k) for k in range(len(plans))]
    return [(r, logbook.flight(s, p, r)) for s, p, r in zip(scenarios, plans, flown, strict=True)]


def _kept(record):
    return record._replace(omega=(), rates_asked=(), q_asked=(), wind=())


def judged(flight: Any) -> tuple[Any, Any, np.ndarray, tuple[Event, ...]]:
    """(ticks, last carry, B, losses) of the default estimator, before excitations are looked at."""
    vehicle = airframes.identify(flight)
    air = airborne(flight)
    table, B = observe(flight, vehicle, air, READY_S), vehicle.effectiveness()
    carry, out = program.estimate(table, B)
    return table, carry, B, events.read(out, table, hypotheses.make(B.shape[1]), B)


def asking(question: asked.Question, within_s: float = WITHIN_S, limits: excitation.Limits | None = None, B=None):
    """The design that answers it soonest within that time; where that is too short, the one that tells most in it."""
    give = (B, list(question.candidates.values()), question.hover, question.noise, question.gain, question.dt, limits)
    try:
        return excitation.design(*give, longest_s=within_s)
    except ConfigError:
        return excitation.design(*give, length_s=within_s)


def wondering(carry, table, B: np.ndarray, limits: excitation.Limits | None = None) -> excitation.Design:
    """What somebody asks who suspects nothing: is it one of the pairs that nothing else shows, or none? For WITHIN_S."""
    pairs = families(B)
    event = Event("loss_of_effectiveness", pairs[0], 0.0, 0.0, None, (0.3, 0.3), ((0.0, 0.6),) * 2, 0.5)
    question = asked.question(event, carry, table, B)
    losses = [np.where(np.isin(np.arange(B.shape[1]) + 1, who), 0.3, 0.0) for who in pairs]
    given = (B, [*losses, np.zeros(B.shape[1])], question.hover, question.noise, question.gain, question.dt, limits)
    return excitation.design(*given, length_s=WITHIN_S)


def turned(one_: Any, other: Any) -> float:
    """Largest angle [degrees] between the attitudes of two records."""
    dot = np.abs((one_.q * other.q).sum(axis=1))
    return float(np.degrees(2.0 * np.arccos(np.clip(dot, 0.0, 1.0))).max())


def batch(frame: str, flights: Sequence[int], seed: int, limits: excitation.Limits | None = None) -> list[Row]:
    """The rows of flights of one frame."""
    scenarios = [draw(k, frame, seed) for k in flights]
    n = airframes.named(f"px4-{frame}").effectiveness().shape[1]
    before = fly(scenarios, [excitation.none(n)] * len(scenarios))
    answers, designs, signals = [], [], []
    for s, (_, flight) in zip(scenarios, before, strict=True):
        answers.append(diagnose(flight))
        made, start = None, ONSET_S + 4.0
        if answers[-1].verdict != "fault":
            table, carry, B, losses = judged(flight)
            unsure = [e for e in losses if e.alternatives and e.kind == "loss_of_effectiveness"]
            if unsure:
                start = max(e.detected_s for e in unsure) + WAITS_S
                made = asking(asked.question(unsure[0], carry, table, B), limits=limits, B=B)
            else:
                made = wondering(carry, table, B, limits)
        designs.append(made)
        signals.append(excitation.none(n) if made is None else made.signal._replace(start=np.array(start)))
    after = fly(scenarios, signals)
    rows = []
    for k, s, old, (was, _), (record, flight), made in zip(flights, scenarios, answers, before, after, designs, strict=True):
        new = old if made is None else diagnose(flight)
        broken = tuple(sorted(f["rotor"] for f in s.faults))
        sure = [e for e in new.events if e.kind in ("loss_of_effectiveness", "output_override") and not e.alternatives]
        named = tuple(sorted({r for e in sure for r in e.rotors}))
        rows.append(
            Row(
                k, frame, float(s.airframe["mass_kg"]), float(s.wind["speed_m_s"]), broken,
                float(s.faults[0]["strength"]) if broken else 0.0, old.verdict, new.verdict, named, made is not None,
                new.verdict == ("fault" if broken else "healthy") and named == broken, bool(named) and named != broken,
                None if made is None else float(made.signal.length),
                None if made is None else float((np.abs(made.signal.first) + np.abs(made.signal.second)).max()),
                None if made is None else turned(was, record),
                None if made is None else float(made.information.min()),
                None if made is None else made.needed,
            )
        )  # fmt: skip
    return rows
