"""The simulator's motors and ESCs: currents and speeds by the electrical model, faults that show in them, reports as ESCs make them."""

from functools import cache

import numpy as np
import pytest

from rotorwatch.errors import ConfigError
from rotorwatch.logs import esc_columns
from rotorwatch_lab.simulation import motor, scenario, simulate


def table(*faults, **more):
    rest = {"duration_s": 45.0, "seed": 4, "airframe": {"frame": "quad-x"}, "trajectory": {"altitude_m": 6.0}}
    return {**rest, "logging": {"esc": True}, "faults": list(faults), **more}


@cache
def made(kind=None, strength=None, autopilot="ardupilot"):
    fault = {"kind": kind, "rotor": 2, "onset_s": 25.0} | ({} if strength is None else {"strength": strength})
    return simulate(scenario.from_table(table(*([fault] if kind else []), autopilot=autopilot)))


def means(record, name, start, end):
    inside = (record.time > start) & (record.time < end)
    return getattr(record, name)[inside].mean(axis=0)


def test_full_load_is_full_current_and_nothing_at_rest():
    w, none = np.array([1.0, 0.0]), np.zeros(2)
    amps = np.asarray(motor.current(30.0, w, none, none, 1.0, np.ones(2)))
    assert amps == pytest.approx([30.0, 0.0])
    assert np.asarray(motor.current(30.0, w, none, none, 1.0, none)) == pytest.approx([0.0, 0.0])


def test_the_voltage_of_the_esc_is_the_same_with_and_without_friction():
    reported, theta = np.linspace(0.2, 1.0, 9), np.full(9, 0.2)
    for friction in (0.0, 0.1, 0.4):
        w = np.asarray(motor.slowed(reported, theta, np.full(9, friction)))
        volts = [
            motor.COPPER * ((1.0 - motor.IDLE) * v * v * 0.8 + motor.IDLE + rubs) + (1.0 - motor.COPPER) * v
            for v, rubs in ((reported, 0.0), (w, friction))
        ]
        assert volts[0] == pytest.approx(volts[1], abs=1e-12) and (w <= reported + 1e-12).all()


@pytest.mark.parametrize("kind, strength", [("loss", 0.3), ("weak motor", 0.3), ("bearing", 0.2)])
def test_what_a_fault_shows(kind, strength):
    record = made(kind, strength).record
    after = {quantity: means(record, quantity, 28, 34) for quantity in ("w", "drawn", "theta")}
    # In hover the faulty rotor and the one opposite pull the same: speeds say what is left of its thrust.
    share = (after["w"][1] / after["w"][0]) ** 2
    lost, load = after["theta"][1], after["drawn"][1] / after["drawn"][0]
    if kind == "loss":
        assert lost == pytest.approx(0.3) and share == pytest.approx(1 / 0.7, rel=0.01)
        assert 1.1 < load < 1.0 / 0.7  # the same torque, faster
    elif kind == "weak motor":
        assert lost == pytest.approx(0.3) and share == pytest.approx(1.0, rel=0.01) and load == pytest.approx(1.0, abs=0.01)
    else:
        assert 0.03 < lost < 0.1 and share == pytest.approx(1.0, rel=0.01) and 1.3 < load < 1.6
    assert np.delete(after["theta"], 1).max() == 0.0


def test_esc_reports_are_late_rounded_and_each_off_by_its_own():
    flown = made()
    esc = flown.flight["esc"]
    n, rpm = 4, esc.values[:, :4] / esc_columns.RPM
    assert esc.columns == esc_columns.names((1, 2, 3, 4)) and esc.unit == esc_columns.UNIT
    assert np.abs(rpm - np.round(np.round(rpm * 7 / 100) * 100 / 7)).max() < 1e-6
    assert np.abs(esc.values[:, n:] * 100 - np.round(esc.values[:, n:] * 100)).max() < 1e-6
    inside = (esc.time > 15) & (esc.time < 30)
    true = means(flown.record, "drawn", 15, 30)
    off = esc.values[inside, n : 2 * n].mean(axis=0) / true - 1.0
    assert 0.005 < np.abs(off).max() < 0.2 and np.ptp(off) > 0.005
    assert esc.values[inside, :n].mean(axis=0) * 1.0 == pytest.approx(
        means(flown.record, "w", 15, 30) * float(flown.plan.sensors.full_turns) * 2 * np.pi, rel=0.003
    )
    assert 12.0 < esc.values[inside, 2 * n : 3 * n].mean() < 16.8 and esc.values[inside, 3 * n :].min() >= 25.0


def test_without_esc_there_is_none_and_the_flight_is_the_same():
    bare = simulate(scenario.from_table(table(logging={"esc": False})))
    assert "esc" not in bare.flight.signals
    assert np.array_equal(bare.record.p, made().record.p)


@pytest.mark.parametrize("kind", ["weak motor", "bearing"])
def test_wrong_strengths_are_refused(kind):
    for strength, said in ((-0.1, "must be a share from 0 to 1"), (None, "needs one")):
        fault = {"kind": kind, "rotor": 1, "onset_s": 20.0} | ({} if strength is None else {"strength": strength})
        with pytest.raises(ConfigError, match=said):
            scenario.from_table(table(fault))
    with pytest.raises(ConfigError, match=f"a {kind} has none"):
        scenario.from_table(table({"kind": kind, "rotor": 1, "onset_s": 20.0, "strength": 0.1, "level": 0.5}))


def test_a_faults_ramp_counts():
    fault = {"kind": "weak motor", "rotor": 2, "onset_s": 20.0, "strength": 0.4, "ramp_s": 10.0}
    record = simulate(scenario.from_table(table(fault))).record
    at = np.searchsorted(record.time, [19.9, 25.0, 31.0])
    assert record.theta[at, 1] == pytest.approx([0.0, 0.2, 0.4], abs=0.005)
