"""Flights in which more than one thing happens: what is drawn, which states they have, and what an answer is worth."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch.campaign import sequences
from rotorwatch.diagnosis import Event
from rotorwatch.motion.ticks import JUDGE, LEARN

DT, COUNT, N = 0.1, 600, 4


def event(rotors, onset, end=None, alternatives=()):
    """A loss of 20 % of each rotor (1-based)."""
    return Event(
        "loss_of_effectiveness", rotors, onset, onset + 0.5, end, (0.2,) * len(rotors), ((0.1, 0.3),) * len(rotors),
        0.95, alternatives, "made up",
    )  # fmt: skip


def flown(losses=(), lost_s=None, learn_until=0, upset=()):
    """A minute whose rotors (1-based) have lost a share from one time to another."""
    time = DT * np.arange(COUNT)
    theta = np.zeros((COUNT, N))
    for rotor, start, end, share in losses:
        theta[(time >= start) & (time < end), rotor - 1] += share
    upset_ = np.zeros(COUNT, bool)
    for start, end in upset:
        upset_[(time >= start) & (time < end)] = True
    mode = np.where(time < learn_until, LEARN, JUDGE)
    return SimpleNamespace(ticks=SimpleNamespace(time=time, mode=mode, upset=upset_, dt=DT), theta=theta, lost_s=lost_s)


@pytest.mark.parametrize(
    "truth, named, worth",
    [
        ((), [()], "right"),
        ((1,), [(1,)], "right"),
        ((1, 3), [(3, 1)], "right"),
        ((1,), [(2,), (1,)], "ambiguous"),
        ((), [(2,), ()], "ambiguous"),
        ((1,), [()], "missed"),
        ((1, 3), [(1,)], "missed"),
        ((1, 3), [(1,), (3,)], "missed"),
        ((1,), [(2,)], "wrong"),
        ((1,), [(1, 2)], "wrong"),
        ((), [(2,)], "wrong"),
        ((1,), [(2,), (3,)], "other"),
        ((1, 3), [(1,), (1, 2)], "other"),
    ],
)
def test_what_an_answer_is_worth(truth, named, worth):
    assert sequences.outcome(truth, named) == worth and worth in sequences.OUTCOMES


def test_what_is_named_at_a_time():
    found = [event((1,), 10.0, 30.0), event((3,), 20.0, alternatives=((4,),))]
    assert sequences.named_at(found, 5.0) == ((),)
    assert sequences.named_at(found, 15.0) == ((1,),)
    assert sequences.named_at(found, 25.0) == ((1, 3), (1, 4))
    assert sequences.named_at(found, 30.0) == ((3,), (4,))


def test_one_explanation_of_each_event_holds():
    found = [event((1,), 10.0, alternatives=((2,),)), event((2,), 20.0, alternatives=((1,),))]
    assert set(sequences.named_at(found, 25.0)) == {(1, 2), (1,), (2,)} and sequences.named_at(found, 25.0)[0] == (1, 2)


def test_every_stretch_between_changes_is_a_state():
    f = flown([(2, 20.0, 40.0, 0.3), (3, 30.0, 60.0, 0.2)])
    answers = sequences.states(f, [event((2,), 20.5, 40.2), event((4,), 30.5)])
    assert [(round(s.at), s.truth, s.named, s.outcome) for s in answers] == [
        (19, (), ((),), "right"),
        (29, (2,), ((2,),), "right"),
        (39, (2, 3), ((2, 4),), "wrong"),
        (59, (3,), ((4,),), "wrong"),
    ]


def test_a_change_of_size_is_a_change_of_state():
    f = flown([(2, 20.0, 60.0, 0.2), (2, 40.0, 60.0, 0.2)])
    assert [s.truth for s in sequences.states(f, [])] == [(), (2,), (2,)]


def test_what_is_too_short_not_judged_or_lost_is_no_state():
    faults = [(2, 20.0, 23.0, 0.3), (1, 40.0, 60.0, 0.3)]
    assert [s.truth for s in sequences.states(flown(faults), [])] == [(), (), (1,)]
    assert [s.truth for s in sequences.states(flown(faults, learn_until=18.0), [])] == [(), (1,)]
    assert [s.truth for s in sequences.states(flown(faults, upset=[(41.0, 60.0)]), [])] == [(), ()]
    _, after = sequences.states(flown(faults, lost_s=35.0), [])
    assert after.at < 35.0 - sequences.MARGIN_S


def test_a_loss_too_small_to_matter_is_none():
    assert [s.truth for s in sequences.states(flown([(1, 20.0, 60.0, 0.01)]), [])] == [()]


def numbers():
    """Flights enough for every kind on every cell."""
    return range(len(sequences.KINDS) * len(sequences.Sequences().cells))


def test_flights_depend_on_seed_and_number_alone():
    for k in (0, 7, 41):
        assert sequences.Sequences(5).flight(k) == sequences.Sequences(5).flight(k)
    assert sequences.Sequences(5).flight(0) != sequences.Sequences(6).flight(0)


def test_every_flight_is_a_valid_scenario_with_what_its_kind_says():
    plan, kinds = sequences.Sequences(), set()
    for k in numbers():
        s, kind = plan.flight(k), plan.kind(k)
        kinds.add((kind, s.airframe["frame"]))
        assert s.airframe["frame"] == plan.cells[k % len(plan.cells)].frame
        rotors = [f["rotor"] for f in s.faults]
        assert rotors and all(1 <= r <= sequences.FRAMES[s.airframe["frame"]] for r in rotors)
        assert len(set(rotors)) == (1 if kind in ("recovery", "change", "intermittent") else 2), (kind, rotors)
        for f in s.faults:
            assert 0.1 <= f["strength"] <= 0.5 and 18.0 <= f["onset_s"] < sequences.DURATION_S - sequences.SETTLE_S
        if kind == "arm" and s.airframe["frame"] in sequences.ARMS:
            assert tuple(sorted(rotors)) in [tuple(sorted(a)) for a in sequences.ARMS[s.airframe["frame"]]]
    assert len(kinds) == len(set(sequences.KINDS)) * len(sequences.FRAMES)


def test_two_flights_are_flown_judged_and_scored(monkeypatch):
    monkeypatch.setattr(sequences, "WIDTH", 1)
    result = sequences.run(2, jobs=1)
    rows = result["states"]
    assert {r["flight"] for r in rows} == {0, 1} and all(r["frame"] == "quad-x" for r in rows)
    plan = sequences.Sequences()
    for k in (0, 1):
        weak = {f["rotor"] for f in plan.flight(k).faults}
        mine = [r for r in rows if r["flight"] == k]
        assert mine[0]["truth"] == () and set(mine[-1]["truth"]) == weak
    assert all(r["outcome"] == sequences.outcome(r["truth"], r["named"]) for r in rows)
    first = result["table"][0]
    assert (first["by"], first["states"]) == ("all", len(rows))
