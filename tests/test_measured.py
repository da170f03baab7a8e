"""What is measured is what ships: campaigns, injections and comparisons count the events that `diagnose` gives to the written log."""

from pathlib import Path

import pytest

from rotorwatch import diagnose, logs
from rotorwatch_lab import campaign
from rotorwatch_lab.campaign import batch, score
from rotorwatch_lab.experiments import counting, inject
from rotorwatch_lab.experiments.studies import compare, compare_flights
from rotorwatch_lab.simulation import logbook
from rotorwatch_lab.simulation import plan as flight_plan
from rotorwatch_lab.simulation.loop import fly_each
from rotorwatch_lab.simulation.multirotor import MULTIROTOR

PLANS = Path(__file__).parents[1] / "plans"
SUFFIX = {autopilot: suffix for suffix, autopilot in logbook.SUFFIXES.items()}


def numbered(plan, cells, each):
    """Flights of a plan, a list for each of some cells."""
    return [list(range(cell, cell + each * len(plan.cells), len(plan.cells))) for cell in cells]


@pytest.fixture(scope="module")
def flights(tmp_path_factory, amount):
    """(Flown, path of its log, what `diagnose` says of that) of 12 flights, of 30 with --thorough."""
    folder, found = tmp_path_factory.mktemp("logs"), []
    plan, least = campaign.read(PLANS / "default.toml"), amount(12, 30)
    cells = range(0, len(plan.cells), 2)
    for numbers in numbered(plan, cells, -(-least // len(cells))):
        scenarios = [plan.flight(k) for k in numbers]
        plans, first = [flight_plan(s) for s in scenarios], scenarios[0]
        records = fly_each(MULTIROTOR, plans, first.duration_s, first.rate_hz, first.record_hz, logbook.needed, len(numbers))
        for k, scenario, number, record in zip(numbers, scenarios, plans, records):
            path = folder / f"{k}{SUFFIX[scenario.autopilot]}"
            logbook.write(scenario, number, record, path)
            flown = batch.prepared(k, scenario, number, record)
            assert flown is not None
            found.append((flown, path, diagnose(path)))
    assert len(found) >= least
    return found


def counts(answer, scenario) -> dict:
    """What the scorer makes of an answer of `diagnose`."""
    broken = tuple(f["rotor"] for f in scenario.faults)
    onset = min((f["onset_s"] for f in scenario.faults), default=float("inf"))
    one = counting.count(counting.alarms(answer.events), broken, onset)
    found = {"false_alarms": len(one.false), "sure_false_alarms": sum(len(a.sets) == 1 for a in one.false), "wrong": len(one.wrong)}
    after = {"detected": one.found, "right": one.right, "named": one.named, "delay_s": one.delay_s} if broken else {}
    return found | after | score.answer(answer)


def test_a_campaign_counts_what_diagnose_says_of_the_written_log(flights):
    plan = campaign.read(PLANS / "default.toml")
    alarms = 0
    for flown, path, reported in flights:
        (row,) = [r for r in batch.rows(plan, [flown], 1) if r["method"] == "default"]
        wanted = counts(reported, flown.scenario)
        assert {name: row[name] for name in wanted} == pytest.approx(wanted, abs=1e-3), path.name
        alarms += len(counting.alarms(reported.events))
    assert alarms > 5


def test_injections_count_what_diagnose_says_of_the_flight(flights):
    """Into healthy written logs."""
    healthy = [(f, path) for f, path, _ in flights if not f.scenario.faults]
    assert len(healthy) >= 2
    for k, (flown, path) in enumerate(healthy):
        flight, (start, end) = logs.read(path), flown.ready.air[0]
        rotor, onset = 1 + k % len(flown.vehicle.rotors), 0.5 * (start + end)
        (trial,) = inject._trials((flight, [(rotor, 0.4, onset)]))
        answer = diagnose(inject.inject(flight, flown.vehicle, rotor, 0.4, onset))
        one = counting.count(counting.alarms(answer.events), (rotor,), onset)
        assert (trial["detected"], trial["false_alarms"]) == (one.found, len(one.false) + len(one.wrong)), path.name
        if one.found:
            assert (trial["right"], trial["delay_s"]) == (one.right, pytest.approx(one.delay_s)), path.name


def test_comparisons_count_what_diagnose_says_of_the_written_log(flights):
    for flown, path, reported in flights:
        faults = tuple((f["rotor"], f["onset_s"], f.get("strength") or 1.0) for f in flown.scenario.faults)
        scene = compare_flights._scene("one", logs.read(path), flown.vehicle, faults)
        assert scene is not None
        trial, wanted = compare._trial("default", scene), counts(reported, flown.scenario)
        assert trial["false_alarms"] == wanted["false_alarms"] + wanted["wrong"], path.name
        for name in ("right", "named", "delay_s"):
            if wanted.get("detected"):
                assert trial[name] == pytest.approx(wanted[name], abs=1e-3), path.name
