"""Rows of a campaign's table, of made-up flights whose answer is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.engine.estimator.announcement import TICKS
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN
from rotorwatch.flight.diagnosis import Event
from rotorwatch_lab.campaign import score
from rotorwatch_lab.experiments import counting, limits
from rotorwatch_lab.simulation import scenario as scenarios

DT, ONSET = 0.1, 30.0
PLAN = SimpleNamespace(false_alarm_period_h=10.0)
QUAD = airframes.named("ardupilot-quad-x")


def fault(rotor=3, **more):
    return {"kind": "loss", "rotor": rotor, "onset_s": ONSET, "ramp_s": 0.0, "period_s": None, "end_s": None, **more}


def flown(*faults, learn_until=8.0, upset_from=np.inf, duration=60.0, loss=0.2):
    """A quad's minute, assessed from 8 s on; every fault takes `loss`, times its place in the list."""
    time = DT * np.arange(round(duration / DT))
    theta = np.zeros((time.size, 4))
    for k, one in enumerate(faults, start=1):
        theta[time >= one["onset_s"], one["rotor"] - 1] = k * loss
    scenario = replace(scenarios.from_table({
        "airframe": {"frame": "quad-x"}, "autopilot": "px4", "logging": {"profile": "fast"}, "trajectory": {"kind": "hover"},
        "wind": {"speed_m_s": 2.5},
    }), faults=faults)  # fmt: skip
    ticks = SimpleNamespace(
        time=time, dt=DT, mode=np.where(time < learn_until, LEARN, ASSESS), upset=time >= upset_from
    )  # fmt: skip
    return SimpleNamespace(scenario=scenario, ticks=ticks, theta=theta, number=7, lost_s=None, vehicle=QUAD)


def event(rotors, detected, alternatives=()):
    size = len(rotors)
    return Event(
        "loss_of_effectiveness", rotors, detected - 0.3, detected, None, (0.2,) * size, ((0.1, 0.3),) * size, 0.95,
        alternatives, "made up",
    )  # fmt: skip


def row(f, *seen, bound=None, theta=None, sd=0.01):
    """The row of the estimator `default` that has announced these events, and holds `theta` for its losses."""
    theta = f.theta if theta is None else theta
    kept = SimpleNamespace(theta=theta, theta_sd=np.full(theta.shape, sd))
    return score.estimator("default", f, kept, np.full(f.ticks.time.size, -3.0), counting.alarms(seen), bound, PLAN)


def test_a_healthy_flight_has_healthy_time_and_no_fault():
    found = row(flown(), event((1,), 20.0), event((2,), 40.0, ((3,),)))
    assert found["assessed_s"] == found["healthy_s"] == pytest.approx(52.0)
    assert (found["false_alarms"], found["sure_false_alarms"], found["wrong"]) == (2, 1, 0)
    assert (found["fault"], found["broken"], found["clear"], found["onset_s"]) == ("", "", False, None)
    assert found["detected"] is None and found["delay_s"] is None and found["estimate"] is None
    assert (found["flight"], found["method"], found["rotors"], found["wind_m_s"]) == (7, "default", 4, 2.5)
    assert 2.0 < found["induced_m_s"] < 20.0
    assert (found["frame"], found["autopilot"], found["profile"], found["trajectory"]) == (
        "quad-x", "px4", "fast", "hover",
    )  # fmt: skip
    assert set(found) == set(score.COLUMNS)


def test_what_is_announced_without_a_statistic_counts_at_any_threshold():
    """A loss of control that accuses a rotor: found after the onset, a false alarm before it."""
    f = flown(fault())
    kept = SimpleNamespace(theta=f.theta, theta_sd=np.full(f.theta.shape, 0.01))
    low = np.full(f.ticks.time.size, -3.0)
    found = score.estimator("default", f, kept, low, counting.alarms([event((3,), 31.2)]), None, PLAN, certain=[31.2])
    assert (found["peak"], found["peak_1s"], found["peak_2s"]) == (-3.0, -3.0, score.CERTAIN)
    found = score.estimator("default", f, kept, low, counting.alarms([event((3,), 20.0)]), None, PLAN, certain=[20.0])
    assert (found["peak"], found["peak_2s"]) == (score.CERTAIN, -3.0)


def test_before_the_onset_an_event_is_a_false_alarm_and_after_it_a_detection_or_wrong():
    found = row(flown(fault()), event((3,), 12.0), event((1,), 31.0), event((3,), 31.5), event((2,), 40.0))
    assert (found["false_alarms"], found["wrong"], found["detected"]) == (1, 2, True)
    assert found["delay_s"] == pytest.approx(1.5) and found["healthy_s"] == pytest.approx(22.0)
    assert not found["right"] and found["named"]  # another was announced first
    assert (found["fault"], found["broken"], found["clear"], found["onset_s"]) == ("loss", "3", True, ONSET)


@pytest.mark.parametrize("before, false_alarms", [(0.2, 0), (0.4, 1)])
def test_ticks_are_windows_so_an_event_just_before_the_onset_is_the_faults(before, false_alarms):
    found = row(flown(fault()), event((3,), ONSET - before))
    assert (found["false_alarms"], found["detected"]) == (false_alarms, not false_alarms)
    assert found["delay_s"] == (None if false_alarms else 0.0)


@pytest.mark.parametrize(
    "seen, detected, right, named",
    [
        ((), False, False, False),
        ((event((3,), 31.0),), True, True, True),
        ((event((3,), 31.0, ((1,),)),), True, False, True),
        ((event((1,), 31.0, ((3,),)),), True, False, True),
        ((event((1, 3), 31.0),), True, False, False),
        ((event((1,), 31.0),), False, False, False),
    ],
)
def test_what_an_announcement_is_worth(seen, detected, right, named):
    found = row(flown(fault()), *seen)
    assert (found["detected"], found["right"], found["named"]) == (detected, right, named)


def test_two_broken_rotors_are_right_together_only():
    f = flown(fault(4), fault(2))
    assert row(f)["broken"] == "2+4" and not row(f)["clear"]
    assert row(f, event((4, 2), 31.0))["right"] and row(f, event((2, 4), 31.0))["named"]
    one = row(f, event((2,), 31.0))
    assert one["detected"] and not one["right"] and not one["named"]
    assert one["loss"] == pytest.approx(0.2)  # of the first


@pytest.mark.parametrize(
    "changes, clear",
    [({}, True), ({"kind": "chipped"}, True), ({"kind": "complete loss"}, True), ({"kind": "stuck"}, False),
     ({"ramp_s": 2.0}, False), ({"period_s": 5.0}, False), ({"end_s": 50.0}, False)],
)  # fmt: skip
def test_bounds_are_for_one_rotor_that_loses_thrust_at_once_and_for_good(changes, clear):
    found = score.clear_fault(flown(fault(**changes)).scenario)
    assert (found is not None) == clear and (not clear or found["rotor"] == 3)


@pytest.mark.parametrize("upset_from, ramp, at", [(np.inf, 0.0, 40.0), (np.inf, 5.0, 45.0), (36.0, 0.0, 35.9), (np.inf, 40.0, 59.9)])
def test_losses_are_compared_ten_seconds_after_the_fault_is_all_there_or_when_last_assessed(upset_from, ramp, at):
    f = flown(fault(ramp_s=ramp), upset_from=upset_from)
    assert f.ticks.time[score._compared(f)] == pytest.approx(at)
    assert score._compared(flown(fault(), learn_until=99.0)) == 0


def test_an_estimate_has_its_95_percent_interval_within_nothing_and_all():
    """The model's own uncertainty in it: a thrust curve that is 12 % steeper in hover."""
    f = flown(fault())
    held = f.theta + 0.01
    found = row(f, theta=held, sd=0.03)
    steeper = 0.12 * 0.21 * 0.79 / (0.79 + 0.12 * 0.21)
    sd = np.hypot(0.03, steeper)
    assert found["loss"] == pytest.approx(0.2) and found["estimate"] == pytest.approx(0.21)
    assert (found["lower"], found["upper"]) == pytest.approx((0.21 - 1.96 * sd, 0.21 + 1.96 * sd))
    wide = row(f, theta=held, sd=9.0)
    assert (wide["lower"], wide["upper"]) == (0.0, 1.0)


def test_bounds_of_a_loss_and_of_its_delay(monkeypatch):
    """Information grows from the onset on: the bound is that of the tick at which losses are compared."""
    f = flown(fault())
    information = np.where(f.ticks.time > ONSET, 4000.0 * (f.ticks.time - ONSET), 0.0)
    found = row(f, bound=information)
    assert found["bound_sd"] == pytest.approx(1.0 / np.sqrt(4000.0 * score.EVALUATE_S))
    hours = limits.delay(f.ticks.time, information, 0.2, ONSET, 10.0 * 3600.0)
    assert found["bound_delay_s"] == pytest.approx(hours) and 0.0 < hours < 2.0
    asked = []
    monkeypatch.setattr(limits, "delay", lambda *arguments: asked.append(arguments[2:]) or 0.5)
    assert row(f, bound=information)["bound_delay_s"] == 0.5
    # Ten hours, in seconds; from a delay in whole ticks a slightly wrong period would not show.
    assert asked == [(pytest.approx(0.2), ONSET, 36_000.0)]
    monkeypatch.undo()
    blind = row(f, bound=np.zeros(f.ticks.time.size))
    assert blind["bound_sd"] is None and blind["bound_delay_s"] is None


def test_a_rule_counts_the_first_finding_of_each_rotor():
    found = score.rule(
        "rule", flown(fault()),
        [{"rotor": 3, "time_s": 35.0}, {"rotor": 3, "time_s": 33.0}, {"rotor": 1, "time_s": 20.0}, {"rotor": 1, "time_s": 50.0}],
        None, PLAN,
    )  # fmt: skip
    assert (found["delay_s"], found["false_alarms"], found["wrong"], found["right"]) == (3.0, 1, 0, True)
    assert found["estimate"] is None and found["peak"] is None


def test_peaks_have_to_last_as_long_as_an_announcement_needs():
    """In healthy time, and within each window after the onset; what is not assessed does not count."""
    f = flown(fault())
    time = f.ticks.time
    assert TICKS == 2

    def statistic(*spells):
        out = np.full(time.size, -9.0)
        for start, ticks, value in spells:
            k = round(start / DT)
            out[k : k + ticks] = value
        return out

    found = score._peaks(f, statistic((15.0, 2, 4.0), (20.0, 1, 8.0), (5.0, 9, 9.0), (31.5, 2, 6.0), (33.0, 2, 7.0)), ONSET)
    assert set(found) == {"peak", *(f"peak_{s:g}s" for s in score.RISE_S)}
    shown = {key: found[key] for key in ("peak", "peak_1s", "peak_2s", "peak_5s", "peak_10s")}
    assert shown == {"peak": 4.0, "peak_1s": -9.0, "peak_2s": 6.0, "peak_5s": 7.0, "peak_10s": 7.0}
    assert next(s for s in score.RISE_S if found[f"peak_{s:g}s"] >= 6.0) == 1.6  # where the first of them had lasted
    assert score._peaks(f, statistic((7.9, 2, 5.0)), None) == {"peak": -9.0}  # half of it was not assessed
    assert score._peaks(f, np.full(time.size, -99.0), None) == {"peak": score.NOTHING}
    early = statistic((ONSET - score.EARLY_S - 0.1, 2, 2.0), (ONSET - score.EARLY_S + 0.1, 2, 5.0))
    assert score._peaks(f, early, ONSET)["peak"] == -9.0 and score._peaks(f, early, ONSET)["peak_1s"] == 5.0
