"""Is this what flew? Logs that contradict themselves are not assessed, and logs that do not are."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, diagnose
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion import inertial, trust
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.tick_table import READY_S
from rotorwatch.flight import Signal
from rotorwatch_lab.simulation import scenario, simulate

WILD = Path(__file__).resolve().parents[2] / "shared" / "flights" / "wild"


@cache
def flown(seed=1, kind="figure-eight", loss=0.0, rotor=2, duration=45.0, wind=3.0):
    """A quad that flies about in a light wind (m/s), and may lose thrust of a rotor."""
    faults = [{"kind": "loss", "rotor": rotor, "onset_s": 25.0, "strength": loss}] if loss else []
    return simulate(
        scenario.from_table(
            {
                "duration_s": duration,
                "seed": seed,
                "airframe": {"frame": "quad-x"},
                "trajectory": {"kind": kind, "land": False, "speed_m_s": 4.0},
                "wind": {"speed_m_s": wind},
                "faults": faults,
            }
        )
    ).flight


def doubts(flight):
    vehicle, air = airframes.identify(flight), airborne(flight)
    return trust.contradictions(flight, vehicle, air, observe(flight, vehicle, air, READY_S))


def with_signal(flight, name, **changes):
    return replace(flight, signals={**flight.signals, name: replace(flight[name], **changes)})


def frozen(flight, start=15.0, end=np.inf):
    """From `start` on the log shows the outputs of that moment."""
    motors = flight["motors"]
    values = motors.values.copy()
    still = (motors.time >= start) & (motors.time < end)
    values[still] = values[np.argmax(still)]
    return with_signal(flight, "motors", values=values)


@pytest.mark.parametrize("seed, kind, loss", [(1, "figure-eight", 0.0), (2, "hover", 0.0), (3, "square", 0.4), (4, "climb", 1.0)])
def test_what_flew_is_trusted(seed, kind, loss):
    assert doubts(flown(seed, kind, loss)) == ()


def test_outputs_that_stand_still_while_the_vehicle_turns():
    (first, *_) = doubts(frozen(flown()))
    assert "do not change from 15" in first and "deg" in first
    assert any("do not change from" in d for d in doubts(frozen(flown(), 20.0, 26.0)))


def test_motors_that_are_off_may_rest():
    """After a crash outputs rest at their minimum, whatever the wreck does."""
    flight = flown()
    motors = flight["motors"]
    values = motors.values.copy()
    values[motors.time > 41.0] = 1000.0
    assert not any("do not change from" in d for d in doubts(with_signal(flight, "motors", values=values)))


def test_outputs_of_another_flight_explain_nothing():
    flight, other = flown(1, duration=60.0), flown(7, "square", duration=60.0)
    count = min(len(flight["motors"]), len(other["motors"]))
    motors = other["motors"]
    strange = Signal(flight["motors"].time[:count], motors.values[:count], motors.columns, motors.unit, source="RCOU")
    signals = {k: v for k, v in flight.signals.items() if k != "control"}
    found = doubts(replace(flight, signals={**signals, "motors": strange}))
    assert any("do not explain" in d for d in found)


EXCHANGES = [(a, b) for a in range(4) for b in range(a)]


@pytest.mark.parametrize("seed, kind", [(1, "figure-eight"), (3, "square")])
def test_outputs_that_are_taken_for_those_of_other_rotors(seed, kind):
    """Two of four outputs exchanged in the log, in all six ways: some axis follows the command of another one. Some pass, as there
    is some of each axis in every command."""
    flight, found = flown(seed, kind), 0
    for a, b in EXCHANGES:
        order = np.arange(4)
        order[[a, b]] = b, a
        said = doubts(with_signal(flight, "motors", values=flight["motors"].values[:, order]))
        found += any("drive other rotors" in why for why in said)
    assert found >= 4


@pytest.mark.parametrize("calm", [False, True])
@pytest.mark.parametrize(
    "name, factor, says",
    [
        ("gyro", np.degrees(1.0), "seems to be in degrees/s"),
        ("gyro", 1e3, "seems to be in mrad/s"),
        ("gyro", np.radians(1.0), "as fast as the attitude"),
        ("gyro", 2.0, "as fast as the attitude"),
        ("gyro", 0.5, "as fast as the attitude"),
        ("accel", 1.0 / 9.80665, "the accelerometer shows"),
        ("accel", 0.5, "the accelerometer shows"),
        ("accel", 2.0, "the accelerometer shows"),
    ],
)
def test_units(name, factor, says, calm):
    """In the calmest hover, too, the attitude tells the gyro's unit, and the weight that of the accelerometer."""
    flight = flown(2, "hover", 0.2, wind=0.0) if calm else flown()
    found = doubts(with_signal(flight, name, values=flight[name].values * factor))
    assert any(says in d for d in found) or (factor == 1e3 and any("no vehicle survives" in d for d in found))


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_calm_hover_is_trusted(seed):
    """Where hardly anything moves, noise of two sensors is no contradiction."""
    assert doubts(flown(seed, "hover", 0.2 * (seed % 2), wind=0.0)) == ()


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("faster, later", [(1.02, 0.0), (0.98, 0.0), (1.0, 0.6), (1.0, -0.6)])
@pytest.mark.parametrize("kind", ["hover", "square"])
def test_a_gyro_of_another_clock(kind, faster, later):
    flight = flown(2, kind, duration=90.0)
    found = doubts(with_signal(flight, "gyro", time=flight["gyro"].time * faster + later))
    assert any("not on one clock" in d and " s apart" in d for d in found)


def test_a_scale_has_an_error_that_noise_makes():
    """Two noisy measurements of one motion: the interval holds the truth, and is no narrower than what the noise allows."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(50):
        motion = np.convolve(rng.normal(size=600), np.ones(10), "same")
        noise = rng.uniform(0.0, 3.0, 2) * motion.std()
        low, high = inertial.scale(1.5 * motion + noise[0] * rng.normal(size=600), motion + noise[1] * rng.normal(size=600))
        held += low < 1.5 < high
    assert held >= 48
    low, high = inertial.scale(rng.normal(size=600), rng.normal(size=600))
    assert low < 0.1 and high > 10.0


@pytest.mark.parametrize("greatest, wrong", [(1500.0, True), (1950.0, False)])
def test_outputs_beyond_what_is_said_to_be_full_thrust(greatest, wrong):
    flight = flown()
    found = doubts(replace(flight, parameters={**flight.parameters, "MOT_PWM_MAX": greatest}))
    assert any("given as full thrust" in d for d in found) == wrong


def test_a_gyro_of_another_vehicle():
    flight, other = flown(1), flown(8, "square")
    gyro = other["gyro"]
    found = doubts(replace(flight, signals={**flight.signals, "gyro": gyro}))
    assert any("different rotations" in d for d in found)


@pytest.mark.parametrize("block", [7, 100, 1 << 16])
def test_rates_that_nothing_survives(monkeypatch, block):
    """However many samples are looked at at a time."""
    monkeypatch.setattr(trust, "BLOCK", block)
    flight = flown()
    gyro = flight["gyro"]
    values = gyro.values + np.where((gyro.time > 30.0) & (gyro.time < 31.0), 80.0, 0.0)[:, None]
    (said,) = (d for d in doubts(with_signal(flight, "gyro", values=values)) if "no vehicle survives" in d)
    assert "139 rad/s at 30." in said


@pytest.mark.parametrize("block", [7, 1000])
def test_gravity_is_looked_at_over_the_whole_flight(monkeypatch, block):
    """However many samples at a time: an accelerometer that turns over half way shows half of what it should."""
    flight = flown()
    accel, air = flight["accel"], airborne(flight)
    turned = accel.values * np.where(accel.time > np.mean(air), -1.0, 1.0)[:, None]
    for values in (accel.values, turned):
        signal = replace(accel, values=values)
        whole = trust._upwards(signal, flight["attitude"], air)
        with monkeypatch.context() as patch:
            patch.setattr(trust, "BLOCK", block)
            assert trust._upwards(signal, flight["attitude"], air) == pytest.approx(whole, abs=1e-9)
    assert abs(whole) < 0.1


def test_clock_frame_and_publishers():
    flight = flown()
    assert any("clock jumps at 20.0 s" in d for d in doubts(replace(flight, facts={**flight.facts, "clock_jumps": [20.0]})))
    assert doubts(replace(flight, facts={**flight.facts, "clock_jumps": [0.5]})) == ()
    assert any("two publishers" in d for d in doubts(replace(flight, facts={**flight.facts, "publishers": 2})))
    changed = replace(flight, parameter_changes=((20.0, "FRAME_CLASS", 2.0),))
    assert any("FRAME_CLASS becomes 2" in d for d in doubts(changed))


def test_a_doubt_ends_the_answer():
    """Whatever the outputs seem to show - here one falls to its minimum - nothing is concluded from them."""
    flight = frozen(flown())
    values = flight["motors"].values.copy()
    values[flight["motors"].time > 35.0, 1] = 1000.0
    answer = diagnose(with_signal(flight, "motors", values=values))
    assert answer.verdict == "inconclusive" and "do not change" in answer.reason
    assert not [e for e in answer.events if e.rotors]
    assert {r.status for r in answer.rotors} == {"unobservable"}


@pytest.mark.thorough(keep=2)
@pytest.mark.skipif(not WILD.is_dir(), reason="the shared test flights are not beside the repository")
@pytest.mark.parametrize("name", ["frozen-healthy-1", "frozen-healthy-2", "frozen-fault-1", "frozen-fault-2"])
def test_frozen_logs_of_real_vehicles(name):
    answer = diagnose(WILD / f"{name}.ulg.xz")
    assert answer.verdict == "inconclusive" and "do not change" in answer.reason
