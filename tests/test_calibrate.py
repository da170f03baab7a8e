"""Calibration: what is learned, that it survives the vehicle file, and what is refused."""

from dataclasses import replace
from zlib import crc32

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.calibrate import calibrate
from rotorwatch.errors import ConfigError, LogError, VehicleError
from rotorwatch.flight import Flight, Signal, vehicle_file
from rotorwatch.witnesses.healthy import whole_flight as wf

QUAD = airframes.named("ardupilot-quad-x")


def flown(name="one.bin", hover=0.4, offset=(0.1, 0.0, -0.1, 0.0), frame=1, rotors=4):
    """An ArduPilot log of a minute: 5 s on the ground, 45 s hover, 10 s on the ground."""
    time = np.arange(0.0, 60.0, 0.1)
    rng = np.random.default_rng(crc32(name.encode()))
    share = hover * (1.0 + np.resize(offset, rotors) + 0.01 * rng.standard_normal((len(time), rotors)))
    curve = QUAD.curve
    a = (np.sqrt((1 - curve.expo) ** 2 + 4 * curve.expo * share) - (1 - curve.expo)) / (2 * curve.expo)
    pwm = curve.u_min + a * (curve.u_max - curve.u_min)
    ground = (time < 5.0) | (time > 50.0)
    pwm[ground] = curve.u_min
    still = np.zeros((len(time), 3))
    climb = np.where((time > 5.0) & (time < 7.0), -1.0, np.where((time > 48.0) & (time < 50.0), 1.0, 0.0))
    signals = {
        "motors": Signal(time, pwm, tuple(f"r{k + 1}" for k in range(rotors)), "us"),
        "gyro": Signal(time, still, ("x", "y", "z"), "rad/s"),
        "accel": Signal(time, np.add(still, [0.0, 0.0, -wf.G0]), ("x", "y", "z"), "m/s^2"),
        "velocity": Signal(time, still + np.outer(climb, [0.0, 0.0, 1.0]), ("n", "e", "d"), "m/s"),
    }
    parameters = {"FRAME_CLASS": frame, "FRAME_TYPE": 1, "MOT_THST_EXPO": 0.65, "MOT_SPIN_MIN": 0.15, "MOT_SPIN_MAX": 0.95}
    parameters |= {"MOT_PWM_MIN": 1000, "MOT_PWM_MAX": 2000}
    return Flight("ArduPilot DataFlash", "ArduPilot", signals, 60.0, parameters=parameters, name=name)


def test_what_is_learned():
    shares = []
    learned = calibrate([flown(), flown("two.bin", hover=0.44)], progress=shares.append)
    known = learned.identified
    assert known["flights"] == 2 and shares[-1] == 1.0
    assert 80.0 < known["airborne_s"] < 92.0 and 60.0 < known["steady_s"] < known["airborne_s"]
    assert known["hover"] == pytest.approx(0.42, abs=0.01)
    assert known["thrust_offset"] == pytest.approx([0.1, 0.0, -0.1, 0.0], abs=0.005)
    assert learned.rotors == QUAD.rotors and "one.bin, two.bin" in learned.source
    assert any("mostly assumed" in a for a in learned.assumptions)
    assert len(set(learned.assumptions)) == len(learned.assumptions)


def test_it_survives_the_vehicle_file_and_assesses_from_there(tmp_path):
    learned = calibrate([flown(), flown("two.bin")], dynamics=lambda rows, B: {"x0": [0.5] * 20, "noise_weight": 3.0})
    vehicle_file.write(learned, tmp_path / "quad.toml")
    again = vehicle_file.read(tmp_path / "quad.toml")
    assert again.identified == learned.identified
    baseline = [wf.Features.from_dict(t) for t in again.identified["whole_flight"]]
    worse = wf.features(flown(offset=(0.6, 0.0, -0.1, 0.0)), again, ((6.0, 48.0),))
    assert wf.assess(baseline[0], baseline[1:], again).verdict == "healthy"
    result = wf.assess(worse, baseline, again)
    assert result.verdict == "fault" and result.rotors == (1,)
    low, high = result.interval[0]
    assert low < 1.0 - 1.1 / 1.6 < high


def test_dynamics_gets_the_ticks_of_every_flight():
    seen = []

    def learn(rows, B):
        seen.extend((len(row.time), row.thrust.shape[1], B.shape) for row in rows)
        return {"x0": [0.0]}

    assert calibrate([flown(), flown("two.bin")], dynamics=learn).identified["dynamics"] == {"x0": [0.0]}
    assert len(seen) == 2 and all(count > 300 and n == 4 and shape == (4, 4) for count, n, shape in seen)
    # Without a callable of the caller's the default estimator learns from the flights.
    learned = calibrate([flown()]).identified["dynamics"]
    # A calm flight says of no time scale that it is silent: variances that start at nothing could never grow in a rough one.
    noise = np.array(learned["noise"])
    assert noise.shape == (4, 4) and (noise >= 0.049 * noise.max(axis=0)).all() and noise.max() > 0.0
    assert len(learned["x0"]) == 20 and np.linalg.eigvalsh(np.array(learned["P0"])).min() > -1e-12


def test_what_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="at least one"):
        calibrate([])
    with pytest.raises(VehicleError, match="one build only"):
        calibrate([flown(), flown("hexa.bin", frame=2, rotors=6)])
    with pytest.raises(VehicleError, match=r"ground.bin: it has no flight"):
        calibrate([on_the_ground()])
    with pytest.raises(LogError):
        calibrate([tmp_path / "missing.bin"])


def on_the_ground():
    ground = flown("ground.bin")
    motors = ground["motors"]
    still = replace(motors, values=np.full_like(motors.values, QUAD.curve.u_min))
    return replace(ground, signals={**ground.signals, "motors": still})


def test_what_is_set_aside_is_said_and_teaches_nothing():
    learned = calibrate([flown(), on_the_ground(), flown("two.bin")])
    assert learned.identified["flights"] == 2 and "ground.bin" not in learned.source
    assert any("ground.bin was set aside: it has no flight" in a for a in learned.assumptions)


def test_an_airframe_can_be_given():
    nameless = replace(flown(), autopilot="", parameters={})
    with pytest.raises(VehicleError):
        calibrate([nameless])
    assert calibrate([nameless], vehicle=QUAD).name == QUAD.name


def test_too_little_hover_is_said_and_left_out():
    short = flown("short.bin")
    cut = short.until(9.0)
    learned = calibrate([flown(), cut])
    assert any("short.bin has too little steady hover" in a for a in learned.assumptions)
    tables = [wf.Features.from_dict(t) for t in learned.identified["whole_flight"]]
    assert [t.usable for t in tables] == [True, False]
