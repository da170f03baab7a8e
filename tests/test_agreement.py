"""A hundred answers and more, and in none of them does one view contradict another. See tests/agreement.py."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import rotorwatch as rw
from agreement import walk
from conftest import hexa_diagnosis, hexa_event, hexa_trace
from rotorwatch.engine.bindings import unexplained_evidence
from test_conclusion import whole

FLIGHTS = Path(__file__).parents[2] / "shared" / "flights"
WILD = sorted((FLIGHTS / "wild").glob("*-1.*.xz"))[::2]
SEQUENTIAL = FLIGHTS / "px4-ulogassessment"


def loss(rotor, onset_s, strength, **more):
    return {"kind": "loss", "rotor": rotor, "onset_s": onset_s, "strength": strength, **more}


FAULTS = [
    [],
    *[[loss(k, 16.0 + k, 0.1 + 0.1 * k)] for k in range(1, 5)],
    [loss(1, 18.0, 0.4), loss(3, 25.0, 0.3)],  # one after the other
    [loss(2, 18.0, 0.3), loss(2, 25.0, 0.3)],
    [loss(1, 20.0, 0.35), loss(2, 20.0, 0.35)],  # opposite on the hexa
    [loss(3, 20.0, 0.3), loss(4, 20.0, 0.3)],
    [loss(1, 20.0, 0.3), loss(4, 20.0, 0.3)],
    [loss(3, 17.0, 0.3, end_s=23.0)],  # comes and goes
    [loss(4, 17.0, 0.4, period_s=8.0, duty=0.5)],
    [{"kind": "complete loss", "rotor": 1, "onset_s": 20.0}],
    [{"kind": "float", "rotor": 2, "onset_s": 20.0}],
    [{"kind": "stuck", "rotor": 2, "onset_s": 20.0, "level": 0.7}],
    [{"kind": "saturated", "rotor": 3, "onset_s": 20.0}],
]


@cache
def simulated(frame, k):
    """A flight with one of FAULTS."""
    from rotorwatch_lab.simulation import scenario, simulate

    rest = {"duration_s": 30.0, "airframe": {"frame": frame}, "trajectory": {"altitude_m": 5.0, "land": False}, "wind": {"speed_m_s": 1.0}}
    return simulate(scenario.from_table({**rest, "seed": k, "faults": FAULTS[k]})).flight


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("frame", ["hexa-x", "quad-x"])
def test_simulated_flights(frame, amount):
    answers = [rw.diagnose(simulated(frame, k)) for k in range(0, len(FAULTS), amount(3, 1))]
    answers += [rw.diagnose(simulated(frame, k), baseline=[simulated(frame, 0)]) for k in range(1, amount(3, 6))]
    answers.append(rw.diagnose(simulated(frame, 1).until(7.0)))  # hardly assessed
    assert {a.verdict for a in answers} >= {"healthy", "fault", "inconclusive"}
    plotted = [a if k in (1, 5) else replace(a, trace=None) for k, a in enumerate(answers)]  # pages without plots are made faster
    assert {f"{k}: {fault}" for k, a in enumerate(plotted) for fault in walk(a)} == set()


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("path", WILD or ["missing"], ids=lambda p: getattr(p, "name", p))
def test_logs_as_people_leave_them_lying_about(path):
    if not WILD:
        pytest.skip("no ../shared/flights/wild")
    try:
        answer = rw.diagnose(path)
    except rw.errors.RotorwatchError:
        return
    assert walk(answer) == []


def test_a_rotor_whose_second_loss_was_never_announced_is_not_called_healthy():
    if not SEQUENTIAL.exists():
        pytest.skip("no ../shared/flights/px4-ulogassessment")
    answer = rw.diagnose(SEQUENTIAL)
    status = {r.rotor: r.status for r in answer.rotors}
    assert status[3] in ("unobservable", "suspect") and status[2] != "suspect" and "rotor" in answer.reason
    assert walk(answer) == []


def random_answer(seed):
    """Any set of events a hexa can have, as the estimator, the allocation and the comparison might write them."""
    rng = np.random.default_rng(seed)
    events = []
    for _ in range(rng.integers(0, 5)):
        kind = rng.choice(["loss_of_effectiveness", "loss_of_effectiveness", "output_override", "contact", "loss_of_control"])
        onset = float(rng.uniform(9, 55))
        detected = onset + float(rng.uniform(0, 2))
        end = detected + float(rng.uniform(0, 20)) if rng.random() < 0.4 else None
        count = int(rng.integers(1, 3))
        picked = rng.permutation(np.arange(1, 7))
        who = tuple(sorted(int(k) for k in picked[:count]))
        size = rng.uniform(0.02, 1.0, count)
        sd = rng.uniform(0.0, 0.2, count)
        bounds = tuple((max(0.0, float(v - s)), min(1.0, float(v + s))) for v, s in zip(size, sd, strict=True))
        common = dict(onset_s=onset, detected_s=detected, end_s=end, probability=float(rng.uniform(0.3, 1.0)))
        if kind == "output_override":
            events.append(
                hexa_event(
                    kind=kind,
                    rotors=who[:1],
                    loss=(0.0,),
                    interval=((0.0, 1.0),),
                    reason=f"output {who[0]} was off",
                    extra={"override": "off"},
                    **common,
                )
            )
        elif kind == "loss_of_effectiveness":
            others = []
            if rng.random() < 0.4:
                for _ in range(rng.integers(1, 4)):
                    other = tuple(sorted(int(k) for k in rng.permutation(np.arange(1, 7))[: rng.integers(1, 3)]))
                    others += [other] if other != who and other not in others else []
            names = " and ".join(map(str, who))
            events.append(
                hexa_event(
                    rotors=who,
                    loss=tuple(map(float, size)),
                    interval=bounds,
                    alternatives=tuple(others),
                    reason=f"the missing part has the direction of rotor {names}",
                    extra={"loss_2s": [float(v) for v in size]},
                    **common,
                )
            )
        else:
            extra = {"size": round(float(rng.uniform(1, 9)), 1), "unit": "g"} if kind == "contact" else {}
            events.append(hexa_event(kind=kind, rotors=(), loss=(), interval=(), reason="nothing commanded it", extra=extra, **common))
    events.sort(key=lambda e: e.detected_s)
    doubts = ("The outputs stand still while the vehicle turns.", "Two vehicles are in this log.")[: rng.integers(0, 3)]
    compared = None
    if rng.random() < 0.5:
        suspects = tuple(sorted(int(k) for k in rng.permutation(np.arange(1, 7))[:2]))
        verdict = str(rng.choice(["healthy", "fault", "ambiguous", "inconclusive"]))
        named = suspects[:1] if verdict in ("fault", "ambiguous") else ()
        causes = {"fault": (named,), "ambiguous": (named, suspects, ())}.get(verdict, ())
        compared = whole(verdict, named, float(rng.uniform(0.1, 0.6)), causes) | {"flights": 2, "common": 0.05}
    spells = (unexplained_evidence.claim((int(rng.integers(1, 7)),), 40.0, 44.0),) if events and rng.random() < 0.2 else ()
    return hexa_diagnosis(
        events=tuple(events),
        whole_flight=compared,
        doubts=doubts if rng.random() < 0.2 else (),
        evidence=spells,
        assessed_s=1.0 if rng.random() < 0.1 else 46.0,
    )


TRACE = hexa_trace(rate=5.0)


def small(diagnosis, plotted=True):
    facts = {**diagnosis.flight, "boot_s": 12.5, "utc_start": "2026-11-21T07:40:36.350Z"}
    return replace(diagnosis, trace=TRACE if plotted else None, flight=facts)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("part", range(4))
def test_any_events(part):
    seeds = range(25 * part, 25 * part + 25)
    assert {f"{seed}: {fault}" for seed in seeds for fault in walk(small(random_answer(seed), seed % 25 == 0), flown=False)} == set()


def spoilt(field):
    """An answer with one field that contradicts the rest: each must be found."""
    good, unassessed = small(hexa_diagnosis(), plotted=False), small(hexa_diagnosis(events=()), plotted=False)
    third = good.rotors[2]
    others = lambda **c: (*good.rotors[:2], replace(third, **c), *good.rotors[3:])  # noqa: E731
    return {
        "status": replace(good, rotors=others(status="healthy")),
        "loss": replace(good, rotors=others(loss=0.2)),
        "interval": replace(good, rotors=others(interval=(0.36, 0.38))),
        "small interval": replace(good, rotors=(replace(good.rotors[0], interval=(0.0, 0.001)), *good.rotors[1:])),
        "verdict": replace(good, verdict="healthy"),
        "headline": replace(good, headline=good.headline.replace("otor 3", "otor 4")),
        "take-off": replace(unassessed, headline=unassessed.headline.replace("Damage present at take-off was not assessed.", "")),
        "reason": replace(good, reason="rotor 1 lost much."),
        "main": replace(good, main=None),
        "advice": replace(good, advice=()),
        "event": replace(good, events=(replace(good.events[0], alternatives=((4,),)),)),
    }[field]


@pytest.mark.parametrize(
    "field", ["status", "loss", "interval", "small interval", "verdict", "headline", "take-off", "reason", "main", "advice", "event"]
)
def test_a_contradiction_is_found(field):
    assert walk(spoilt(field), flown=False) != []
