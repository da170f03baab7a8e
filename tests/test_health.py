"""Grades and trends of rotors: from an estimate to what is said of it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from conftest import hexa_diagnosis, hexa_event
from rotorwatch.answer import health
from rotorwatch.answer.conclusion import Evidence, conclude
from rotorwatch.engine.motion.tick_table import ASSESS
from rotorwatch.flight.diagnosis import Trend
from rotorwatch.report import html, terminal
from rotorwatch.report.sections import grades as health_section

# Roll, pitch, yaw, thrust of a quad X in the autopilot's order: front right, rear left, front left, rear right.
QUAD = np.array([[-0.7, 0.7, 0.7, -0.7], [0.7, -0.7, 0.7, -0.7], [1.0, 1.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])
HEXA = np.array([[-1.0, 1.0, 0.5, -0.5, -0.5, 0.5], [0, 0, 0.9, -0.9, 0.9, -0.9], [-1.0, 1.0, -1.0, 1.0, 1.0, -1.0], [1.0] * 6])
DT = 0.1


def flight(B=QUAD, growth=None, wind=None, step=None, seconds=120.0, seed=0, sag=0.0) -> Any:
    """(outputs, ticks) of a hover of `seconds` in which the loss of a rotor grows: growth {rotor: share a minute}.

    wind (3,): torques that change by so much a minute. step: (rotor, s, share): a loss that comes at once, and is estimated. sag:
    share by which all commands rise a minute.
    """
    rng = np.random.default_rng(seed)
    T, n = int(seconds / DT), B.shape[1]
    time, loss = DT * np.arange(T), np.zeros((T, n))
    for rotor, share in (growth or {}).items():
        loss[:, rotor - 1] = share * time / 60.0
    known = np.zeros((T, n))
    if step:
        known[time >= step[1], step[0] - 1] = step[2]
    both = loss + known
    thrust = (1.0 / (1.0 - both)) * (1.0 + sag * time / 60.0)[:, None]
    b = (thrust * loss) @ B.T + 0.003 * rng.standard_normal((T, 4))
    b[:, :3] += 0.05 * thrust.mean(axis=1)[:, None]  # a centre of mass that is off
    if wind is not None:
        b[:, :3] += np.asarray(wind) * time[:, None] / 60.0
    ticks = SimpleNamespace(time=time, thrust=thrust, mode=np.full(T, ASSESS), valid=np.ones((T, 4), bool), upset=np.zeros(T, bool), dt=DT)
    return SimpleNamespace(theta=known, biases=b), ticks


def trends(flown, B, found=()) -> Any:
    out, ticks = flown
    return health.trends(out, ticks, B, found)


def words(found):
    return [t.word if t else None for t in found]


# The grade


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (0.0, 0.049, "healthy"), (0.05, 0.19, "worn"), (0.2, 0.49, "weak"), (0.5, 0.79, "critical"), (0.8, 1.0, "failed"),
        (0.0, 0.06, "healthy to worn"), (0.19, 0.21, "worn to weak"), (0.7, 0.9, "critical to failed"),
        (0.0, 0.3, "not assessed"), (0.0, 1.0, "not assessed"), (-0.1, 0.01, "healthy"), (0.9, 1.4, "failed"),
    ],
)  # fmt: skip
def test_a_grade_is_of_the_whole_interval(low, high, said):
    assert health.grade(low, high) == said


def test_what_has_grown_unseen_counts_in_the_grade():
    slow = Trend(0.06, (0.05, 0.07), 0.0, 120.0, "growing", (0.10, 0.14))
    assert health.grade(0.0, 0.04, slow) == "worn" and health.grade(0.0, 0.04) == "healthy"


# The trend


@pytest.mark.parametrize("rotor", [1, 2, 3, 4])
def test_a_loss_that_grows_is_named_with_its_rate(rotor):
    found = trends(flight(growth={rotor: 0.04}), QUAD, ())
    assert words(found) == ["growing" if k == rotor else "no trend" for k in (1, 2, 3, 4)]
    assert found[rotor - 1].interval[0] < 0.04 < found[rotor - 1].interval[1]
    assert found[rotor - 1].beyond[0] > 0.04 and found[rotor - 1].end_s == pytest.approx(120.0, abs=0.2)


def test_nothing_grows_on_healthy_flights():
    for seed in range(10):
        assert words(trends(flight(seed=seed), QUAD, ())) == ["no trend"] * 4


def test_a_battery_that_sags_is_no_trend():
    """All commands rise, and with them the trim of a centre of mass that is off."""
    assert words(trends(flight(sag=0.05), QUAD, ())) == ["no trend"] * 4


def test_a_drift_that_is_no_rotor_is_unclear():
    found = trends(flight(wind=(0.06, 0.0, 0.0)), QUAD, ())
    assert words(found) == ["unclear"] * 4
    assert all(t.interval[0] <= 0.0 <= t.interval[1] for t in found)


def test_two_rotors_that_grow_together_are_not_one():
    assert "growing" not in words(trends(flight(growth={1: 0.04, 3: 0.04}), QUAD, ()))


def test_who_has_lost_nothing_cannot_win_it_back():
    """The drift of a loss that shrinks; only a rotor that was weak may show it."""
    out, ticks = flight(growth={2: -0.02})
    assert "shrinking" not in words(trends((out, ticks), QUAD, ()))
    out.theta = np.add(out.theta, [0.0, 0.2, 0.0, 0.0])
    found = trends((out, ticks), QUAD, ())
    assert found[1].word == "shrinking" and found[1].beyond[0] == 0.0


def test_a_step_is_no_trend():
    """Since the step nothing grew; without knowing of it, the same numbers would be a trend."""
    out, ticks = flight(step=(2, 50.0, 0.3))
    event = hexa_event(rotors=(2,), loss=(0.3,), interval=((0.27, 0.33),), onset_s=50.0, detected_s=50.4)
    found = trends((out, ticks), QUAD, (event,))
    assert words(found) == ["no trend"] * 4 and found[0].start_s > 50.4
    over = replace(event, end_s=70.0)
    assert trends((out, ticks), QUAD, (over,))[0].start_s > 70.0


def test_after_a_step_the_loss_may_grow():
    out, ticks = flight(step=(2, 40.0, 0.2), growth={2: 0.04})
    event = hexa_event(rotors=(2,), loss=(0.2,), interval=((0.17, 0.23),), onset_s=40.0, detected_s=40.4)
    found = trends((out, ticks), QUAD, (event,))
    assert found[1].word == "growing" and found[1].interval[0] < 0.04 < found[1].interval[1]


def test_opposite_rotors_of_a_hexarotor():
    """Their torques are the same but for the sign: what one loses says nothing of the other."""
    found = trends(flight(HEXA, growth={2: 0.05}), HEXA, ())
    assert found[0] is None and found[1].word == "growing" and words(found[2:]) == ["no trend"] * 4


@pytest.mark.parametrize("change", ["short", "blind", "late"])
def test_too_little_flight_is_not_assessed(change):
    out, ticks = flight(seconds=30.0 if change == "short" else 120.0)
    if change == "blind":
        ticks.valid[:, 2] = False
    event = hexa_event(rotors=(2,), onset_s=100.0, detected_s=100.4)
    assert trends((out, ticks), QUAD, (event,) if change == "late" else ()) == (None,) * 4


# What is said of it


SLOW = Trend(0.073, (0.055, 0.091), 18.0, 148.0, "growing", (0.12, 0.2))


def reported(trends, events=(), **more):
    return conclude(Evidence(events, 4, hidden=np.full(4, 0.02), assessed_s=130.0, trends=trends), **more)


def test_the_answer_names_the_rotor_whose_loss_grows():
    end = reported((None, SLOW, None, None))
    assert end.verdict == "ambiguous" and end.rotors[1].trend is SLOW
    assert [r.status for r in end.rotors] == ["healthy", "suspect", "healthy", "healthy"]
    assert end.rotors[1].grade == "worn to weak" and end.rotors[0].grade == "healthy"
    for text in (end.headline, end.reason):
        assert "otor 2 is losing thrust at 7.3 % (5.5 to 9.1 %) per minute" in text
    assert "No rotor lost thrust after take-off" not in end.headline
    assert any("rotor 2" in step and "grew" in step for step in end.advice)


def test_suspects_have_no_trend():
    event = hexa_event(rotors=(2,), alternatives=((1,),))
    end = reported((SLOW,) * 4, (event,))
    assert [r.trend for r in end.rotors] == [None, None, SLOW, SLOW]
    assert "rotor 2 loses" not in end.headline.lower()


def test_where_nothing_can_be_said_no_grade_is():
    end = conclude(Evidence((), 4))
    assert [(r.grade, r.trend) for r in end.rotors] == [("not assessed", None)] * 4


def text_of(diagnosis):
    screen = terminal.console()
    with screen.capture() as out:
        screen.print(terminal.diagnosis(diagnosis, verbose=True))
    return out.get()


def test_json_terminal_and_page_say_the_same():
    made = hexa_diagnosis()
    slow = replace(made.rotors[1], trend=SLOW, grade="worn to weak")
    made = replace(made, rotors=(made.rotors[0], slow, *made.rotors[2:]))
    given = made.to_dict()["rotors"]
    assert given[1]["grade"] == "worn to weak" and given[0]["trend"] is None
    assert given[1]["trend"] == {
        "per_minute": 0.073, "interval": [0.055, 0.091], "start_s": 18.0, "end_s": 148.0, "word": "growing", "beyond": [0.12, 0.2],
    }  # fmt: skip
    assert health_section.rows(made)[1][2:] == ("worn or weak", "growing: 7.3 % a minute (5.5 to 9.1 %)")
    for text in (text_of(made), html.page(replace(made, trace=None)).replace("\u00a0", " ").replace("\u2060", "")):
        assert "worn or weak" in text and "growing: 7.3 % a minute" in text
        assert "critical below 80 %" in " ".join(text.split())
    nothing = hexa_diagnosis(events=(), assessed_s=0.0)
    assert health_section.rows(nothing) == [] and "Health" not in text_of(nothing)


def test_a_rotor_that_rests_has_no_trend():
    """As beside an opposite one that stopped: where nothing is commanded of a rotor, nothing shows what it would give."""
    out, ticks = flight(growth={2: 0.1})
    ticks.thrust[:, 0] = 0.0
    out.theta[:] = 0.0
    with np.errstate(all="raise"):
        first, *others = trends((out, ticks), QUAD)
    assert first is None and all(t is None or np.isfinite(t.interval).all() for t in others)
