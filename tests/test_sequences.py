"""Flights in which more than one thing happens: what is drawn, which states they have, and what an answer is worth."""

import json
from collections.abc import Mapping
from types import SimpleNamespace
from zlib import crc32

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Event
from rotorwatch_lab.campaign import sequences

DT, COUNT, N = 0.1, 600, 4
# What a flight draws, and the check sum of that for the flights with the default seed.
DRAWN = (
    "frame", "mass_kg", "arm_m", "thrust_to_weight", "lag_s", "kind", "ground_speed", "speed_m_s", "from_deg", "vibration", "seed",
    "duration_s",
)  # fmt: skip
FAULT = ("kind", "rotor", "onset_s", "strength", "end_s", "period_s", "duty")
DIGEST = 3391896267


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
    mode = np.where(time < learn_until, LEARN, ASSESS)
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


def test_what_is_too_short_not_assessed_or_lost_is_no_state():
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
            assert 0.1 <= f["strength"] <= 0.5 and 18.0 <= f["onset_s"] < sequences.SCENARIO["duration_s"] - sequences.SETTLE_S
        if kind == "arm" and s.airframe["frame"] in sequences.ARMS:
            assert tuple(sorted(rotors)) in [tuple(sorted(a)) for a in sequences.ARMS[s.airframe["frame"]]]
    assert len(kinds) == len(set(sequences.KINDS)) * len(sequences.FRAMES)


def test_two_flights_are_flown_assessed_and_scored(monkeypatch):
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


def rounded(value):
    """The same with numbers of six digits, for a digest that no last bit changes."""
    if isinstance(value, Mapping):
        return {str(k): rounded(v) for k, v in sorted(value.items())}
    if isinstance(value, list | tuple):
        return [rounded(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def test_the_flights_are_those_of_the_published_figures():
    """docs/results.md gives shares of outcomes for seed 31: a change of what is drawn makes them figures of other flights."""
    drawn = []
    for s in map(sequences.Sequences().flight, numbers()):
        about = {
            **s.airframe,
            **s.trajectory,
            **s.wind,
            "ground_speed": s.trajectory["speed_m_s"],
            **s.sensors,
            "seed": s.seed,
            "duration_s": s.duration_s,
        }
        faults = [{name: f[name] for name in FAULT} for f in s.faults]
        drawn.append(rounded([{name: about[name] for name in DRAWN}, faults]))
    assert crc32(json.dumps(drawn).encode()) == DIGEST


def test_frames_and_arms_are_those_of_the_airframes():
    for name, count in sequences.FRAMES.items():
        B = airframes.named(f"ardupilot-{name}").effectiveness()
        assert B.shape[1] == count
        for one, other in sequences.ARMS.get(name, ()):
            place = B[:2] / B[3]
            assert place[:, one - 1] == pytest.approx(place[:, other - 1], abs=1e-6)
        assert len(sequences.ARMS.get(name, ())) in (0, count // 2)


def test_what_is_drawn_stays_within_what_is_said():
    """10 to 50 % each, in winds to 6 m/s; a loss that ends, or changes, has six seconds to be seen first."""
    plan = sequences.Sequences(7)
    for k in range(3 * len(numbers())):
        s, kind = plan.flight(k), plan.kind(k)
        assert 0.0 <= s.wind["speed_m_s"] <= 6.0 and 0.8 <= s.airframe["mass_kg"] <= 8.0
        onsets = [f["onset_s"] for f in s.faults]
        assert 18.0 <= onsets[0] <= 24.0 and all(0.1 <= f["strength"] <= 0.5 for f in s.faults)
        if kind == "second":
            assert 3.0 <= onsets[1] - onsets[0] <= 30.0
        if kind in ("equal pair", "pair"):
            assert onsets[0] == onsets[1]
            assert (s.faults[0]["strength"] == s.faults[1]["strength"]) == (kind == "equal pair")
        if kind == "recovery":
            assert 6.0 <= s.faults[0]["end_s"] - onsets[0] <= 30.0
        if kind == "change":
            ends = [f["end_s"] for f in s.faults if f["end_s"] is not None]
            assert 6.0 <= (onsets[1] if not ends else ends[0]) - onsets[0] <= 30.0
        if kind == "intermittent":
            assert 12.0 <= s.faults[0]["period_s"] <= 24.0 and s.faults[0]["duty"] == 0.5


def test_every_flight_is_flown_once_in_batches_of_one_cell(monkeypatch):
    asked, reported = [], []
    monkeypatch.setattr(sequences, "WIDTH", 2)

    def part(work):
        asked.append(work)
        return [{"flight": k, "at": 50.0 - k, "kind": "pair", "frame": "y6", "induced_m_s": 6.0, "outcome": "right"} for k in work[1]]

    monkeypatch.setattr(sequences, "_part", part)
    result = sequences.run(53, seed=4, jobs=1, progress=lambda *what: reported.append(what))
    cells = len(sequences.Sequences().cells)
    assert all(seed == 4 and 1 <= len(batch) <= 2 and len({k % cells for k in batch}) == 1 for seed, batch in asked)
    assert sorted(k for _, batch in asked for k in batch) == list(range(53))
    assert [row["flight"] for row in result["states"]] == list(range(53))
    assert [share for share, _ in reported] == pytest.approx(np.arange(1, len(asked) + 1) / len(asked))
    assert (result["flights"], result["seed"]) == (53, 4)
    assert len(sequences.run(1, jobs=1)["states"]) == 1
    with pytest.raises(ConfigError, match="flights must be at least 1, not 0"):
        sequences.run(0)


def test_shares_of_outcomes_by_kind_frame_and_velocity_in_hover():
    rows = [{"kind": "second", "frame": "y6", "induced_m_s": 4.0, "outcome": "right"}] * 3
    rows += [
        {"kind": "second", "frame": "quad-x", "induced_m_s": 1.0, "outcome": "missed"},
        {"kind": "arm", "frame": "y6", "induced_m_s": 7.0, "outcome": "wrong"},
    ]
    lines = sequences.table(rows)
    assert [(line["by"], line["name"], line["states"]) for line in lines] == [
        ("all", "", 5), ("kind", "second", 4), ("kind", "arm", 1), ("frame", "quad-x", 1), ("frame", "y6", 4),
        ("induced", "0 to 2 m/s", 1), ("induced", "3.5 to 5 m/s", 3), ("induced", "over 5 m/s", 1),
    ]  # fmt: skip
    assert [lines[0][o]["value"] for o in sequences.OUTCOMES] == pytest.approx([0.6, 0.0, 0.2, 0.2, 0.0])
    assert lines[1]["right"]["value"] == 0.75 and lines[4]["wrong"]["value"] == 0.25
    text = sequences.describe({"flights": 2, "seed": 9, "table": lines}).splitlines()
    assert text[0].startswith("2 flights, seed 9:") and text[2].split() == ["states", *sequences.OUTCOMES]
    assert text[3].split()[:6] == ["all", "5", "60.0", "%", "(23-88)", "0.0"] and len(text) == 3 + len(lines)


def test_nothing_flown_is_nothing_assessed():
    assert sequences.assessed(sequences.Sequences(), []) == []


def test_a_state_ends_a_second_before_a_crash_and_lasts_five():
    """A stretch of 5 s is a state, a shorter one is none; what is read is a second before its end."""
    faults = [(2, 20.0, 60.0, 0.3)]
    (_, last) = sequences.states(flown(faults, lost_s=26.2), [])
    assert last.at == pytest.approx(26.2 - 1.0 - DT - sequences.MARGIN_S, abs=DT)
    assert len(sequences.states(flown(faults, lost_s=26.01), [])) == 2 > len(sequences.states(flown(faults, lost_s=25.9), []))


def test_a_change_of_two_percent_is_no_change_of_state():
    f = flown([(2, 20.0, 60.0, 0.2), (2, 40.0, 60.0, 0.015)])
    assert [s.truth for s in sequences.states(f, [])] == [(), (2,)]
