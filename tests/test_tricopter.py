"""Tricopters: three rotors that make no yaw torque, and a servo that no rotor answers for."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import rotorwatch as rw
from rotorwatch import airframes
from rotorwatch.engine.motion import tick_table
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.flight import Flight, Signal
from rotorwatch_lab import simulation
from rotorwatch_lab.simulation import scenario

ONSET = 25.0


@cache
def flown(autopilot="ardupilot", rotor=0, strength=0.3, seed=7):
    """A simulated tricopter in a wind of 3 m/s; rotor 0: healthy."""
    table = {
        **{"name": "tri", "autopilot": autopilot, "duration_s": 45.0, "seed": seed},
        "airframe": {"frame": "tri", "mass_kg": 1.6, "arm_m": 0.25},
        "trajectory": {"kind": "square", "size_m": 8.0, "speed_m_s": 2.5},
        "wind": {"speed_m_s": 3.0, "from_deg": 300.0},
        "faults": [{"kind": "loss", "rotor": rotor, "onset_s": ONSET, "strength": strength}] if rotor else [],
    }
    return simulation.simulate(scenario.from_table(table))


@cache
def log(folder, **how):
    path = folder / ("tri.bin" if how.get("autopilot", "ardupilot") == "ardupilot" else "tri.ulg")
    flown(**how).write(path)
    return rw.read(path)


def with_servo(flight, seed=3):
    """The rear motor gives 1 / cos of the angle more that holds and changes yaw: 8 degrees, and 6 more or less within seconds."""
    rng = np.random.default_rng(seed)
    motors = flight["motors"]
    fade = np.exp(-float(np.median(np.diff(motors.time))) / 0.5)
    angle, values = 0.0, motors.values.copy()
    for k in range(len(motors)):
        angle = fade * angle + rng.normal() * 6.0 * np.sqrt(1 - fade * fade)
        values[k, 2] = 1000 + (values[k, 2] - 1000) / np.cos(np.radians(8 + angle)) ** 0.6
    return replace(flight, signals={**flight.signals, "motors": replace(motors, values=values)})


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_tricopters_log_is_identified(tmp_path, autopilot):
    vehicle = airframes.identify(log(tmp_path, autopilot=autopilot))
    assert vehicle.name == {"ardupilot": "ardupilot-tri", "px4": "px4-3-rotors"}[autopilot]
    places = [(np.degrees(np.arctan2(r.y, r.x)), r.spin) for r in vehicle.rotors]
    assert np.allclose([p for p, _ in places], [60, -60, 180]) and {s for _, s in places} == {0}
    assert vehicle.mixer is None and any("yaw is not assessed" in a for a in vehicle.assumptions)


@pytest.mark.parametrize(
    "autopilot, about",
    [
        ("ArduPilot", {"parameters": {"FRAME_CLASS": 7}}),
        ("ArduPilot", {"parameters": {"FRAME": 0}, "firmware": "Frame: TRI"}),
        ("ArduPilot", {"vehicle_type": "tricopter"}),
        ("PX4", {"parameters": {"SYS_AUTOSTART": 14001}}),
        ("PX4", {"parameters": {"MAV_TYPE": 15}}),
        (
            "PX4",
            {
                "parameters": {
                    **{"CA_AIRFRAME": 8, "CA_ROTOR_COUNT": 3, "CA_SV_TL_COUNT": 1, "CA_ROTOR0_KM": 0.05},
                    **{"CA_ROTOR0_PX": 0.25, "CA_ROTOR0_PY": 0.43, "CA_ROTOR1_PX": 0.25, "CA_ROTOR1_PY": -0.43},
                    "CA_ROTOR2_PX": -0.5,
                }
            },
        ),
    ],
)
def test_every_way_to_name_a_tricopter(autopilot, about):
    motors = Signal(np.array([0.0, 0.1]), np.full((2, 3), 1500.0), ("r1", "r2", "r3"), "us", source="RCOU")
    vehicle = airframes.identify(Flight("test", autopilot, {"motors": motors}, 0.1, **about))
    effect = vehicle.effectiveness()
    assert effect.shape == (4, 3) and not effect[2].any()
    assert np.linalg.matrix_rank(effect) == 3 and np.abs(effect[:2].sum(axis=1)).max() < 1e-6


def test_yaw_is_no_measurement_of_rotors_that_make_none():
    flight = flown().flight
    vehicle = replace(airframes.named("ardupilot-tri"), curve=airframes.identify(flight).curve)
    thrust = replace(flight["motors"], values=vehicle.curve(flight["motors"].values), unit="1")
    table = tick_table.cut_ticks(flight, thrust, vehicle.effectiveness(), airborne(flight), 8.0)
    assert not table.valid[:, 2].any() and table.valid[:, [0, 1, 3]].any(axis=0).all()


@pytest.mark.parametrize("servo", [False, True])
def test_a_healthy_tricopter_is_healthy(servo):
    flight = flown().flight
    diagnosis = rw.diagnose(with_servo(flight) if servo else flight)
    assert diagnosis.verdict == "healthy" and not diagnosis.events


@pytest.mark.parametrize("rotor, servo", [(1, False), (2, True), (3, False), (3, True)])
def test_a_weak_rotor_of_a_tricopter_is_found(tmp_path, rotor, servo):
    flight = log(tmp_path, rotor=rotor)
    diagnosis = rw.diagnose(with_servo(flight) if servo else flight)
    (event,) = [e for e in diagnosis.events if e.kind == "loss_of_effectiveness"]
    assert event.rotors == (rotor,) and not event.alternatives
    assert event.onset_s == pytest.approx(ONSET, abs=0.5) and event.detected_s < ONSET + 1.5
    assert event.interval[0][0] < 0.3 < event.interval[0][1] + 0.02
