"""Frames: published motor positions, what logs say, contradictions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch import airframes, logs
from rotorwatch.airframes import ardupilot
from rotorwatch.engine.motion import allocation
from rotorwatch.errors import VehicleError
from rotorwatch.flight import Flight, Message, Signal, vehicle

FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"
needs_flights = pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the shared test flights are not beside the repository")


def flight(autopilot="ArduPilot", rotors=4, unit="us", source="RCOU", **about):
    """Two samples of motor commands and whatever else is said about the flight."""
    columns = tuple(f"r{k + 1}" for k in range(rotors))
    motors = Signal(np.array([0.0, 0.1]), np.full((2, rotors), 1500.0), columns, unit, source=source)
    return Flight("test", autopilot, {"motors": motors} if rotors else {}, 0.1, name="test.bin", **about)


def ring(vehicle):
    """{rotor: (angle clockwise from the nose in degrees, spin)}."""
    return {k + 1: (round(float(np.degrees(np.arctan2(r.y, r.x))), 1), r.spin) for k, r in enumerate(vehicle.rotors)}


PUBLISHED = {
    "ardupilot-quad-x": {1: (45, 1), 2: (-135, 1), 3: (-45, -1), 4: (135, -1)},
    "px4-quad-x": {1: (45, 1), 2: (-135, 1), 3: (-45, -1), 4: (135, -1)},
    "ardupilot-hexa-x": {1: (90, -1), 2: (-90, 1), 3: (-30, -1), 4: (150, 1), 5: (30, 1), 6: (-150, -1)},
    "px4-hexa-x": {1: (90, -1), 2: (-90, 1), 3: (-30, -1), 4: (150, 1), 5: (30, 1), 6: (-150, -1)},
    "ardupilot-hexa-plus": {1: (0, -1), 2: (180, 1), 3: (-120, -1), 4: (60, 1), 5: (-60, 1), 6: (120, -1)},
    "ardupilot-octa-plus": {
        **{1: (0, -1), 2: (180, -1), 3: (45, 1), 4: (135, 1)},
        **{5: (-45, 1), 6: (-135, 1), 7: (-90, -1), 8: (90, -1)},
    },
    "crazyflie": {1: (45, 1), 2: (135, -1), 3: (-135, 1), 4: (-45, -1)},
    "ardupilot-quad-bf-x": {1: (135, -1), 2: (45, 1), 3: (-135, 1), 4: (-45, -1)},
    "ardupilot-octaquad-x": {
        **{1: (45, 1), 2: (-45, -1), 3: (-135, 1), 4: (135, -1)},
        **{5: (-45, 1), 6: (45, -1), 7: (135, 1), 8: (-135, -1)},
    },
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_rotors_are_where_the_autopilot_documents_them(name):
    assert ring(airframes.named(name)) == PUBLISHED[name]


@pytest.mark.parametrize("name", airframes.names())
def test_every_frame_balances_and_can_steer(name):
    """Equal thrusts give no torque, and roll, pitch and thrust are independent; yaw too where rotors drag."""
    vehicle = airframes.named(name)
    effect = vehicle.effectiveness()
    share = np.array([r.share for r in vehicle.rotors])
    equal = effect * share.mean() / share  # as if lower rotors of coaxial pairs gave as much as upper ones
    unbalanced = {"ardupilot-octa-v"}  # its published factors are not symmetric
    tails = {"ardupilot-quad-vtail", "ardupilot-quad-atail"}  # factors of the mixer, not places of rotors
    if name not in unbalanced | tails:
        assert np.abs(equal[:3].sum(axis=1)).max() < 1e-9
    turning = np.abs(effect[2]).max() > 0
    assert np.linalg.matrix_rank(effect if turning else effect[[0, 1, 3]]) == 3 + turning


@pytest.mark.parametrize("name", [n for n in airframes.names() if n.startswith("ardupilot")])
def test_mixer_pushes_the_way_the_rotors_can(name):
    """A roll demand makes roll torque of the same sign and no thrust to speak of; same for pitch and yaw."""
    vehicle = airframes.named(name)
    made = vehicle.effectiveness() @ vehicle.mixer
    for axis in range(3):
        if np.abs(vehicle.mixer[:, axis]).max() > 0:
            assert made[axis, axis] > 0.4
    assert np.abs(vehicle.mixer[:, :3]).max() <= 0.5


def test_lower_rotors_of_coaxial_pairs_give_less():
    vehicle = airframes.named("ardupilot-octaquad-x")
    assert [r.share for r in vehicle.rotors] == [1.0] * 4 + [0.85] * 4
    assert vehicle.effectiveness()[3].mean() == pytest.approx(1.0)
    assert any("Lower rotors" in note for note in vehicle.assumptions)
    assert not any("Lower rotors" in note for note in airframes.named("ardupilot-octa-x").assumptions)


# ArduPilot: order of its motor test, which takes the upper motor of an arm first; Betaflight: "UNDER" in mixer_init.c; PX4: z in its files.
LOWER = {
    **{"ardupilot-y6": {1, 3, 4}, "ardupilot-y6-b": {2, 4, 6}, "ardupilot-y6-f": {4, 5, 6}, "ardupilot-quad-y4": {3}},
    **{f"ardupilot-octaquad-{t}": {5, 6, 7, 8} for t in ("plus", "x", "v", "h", "bf-x", "bf-x-rev", "x-cor")},
    **{f"ardupilot-octaquad-{t}": {2, 4, 6, 8} for t in ("cw-x", "cw-x-cor")},
    **{f"ardupilot-dodecahexa-{t}": {2, 4, 6, 8, 10, 12} for t in ("plus", "x")},
    **{f"betaflight-octa-x8{turned}": {5, 6, 7, 8} for turned in ("", "-reversed")},
    **{f"betaflight-y6{turned}": {4, 5, 6} for turned in ("", "-reversed")},
    **{"px4-hexa-coaxial": {2, 4, 6}, "px4-octa-coaxial": {5, 6, 7, 8}},
}


@pytest.mark.parametrize("name", airframes.names())
def test_the_lower_rotor_of_an_arm_is_the_one_the_autopilot_says(name):
    vehicle = airframes.named(name)
    assert {k + 1 for k, r in enumerate(vehicle.rotors) if r.lower} == LOWER.get(name, set())
    assert all((r.share < 1.0) == r.lower for r in vehicle.rotors)
    for rotor in (r for r in vehicle.rotors if r.lower):
        mates = [r for r in vehicle.rotors if (r.x, r.y) == pytest.approx((rotor.x, rotor.y), abs=1e-3)]
        assert [r.lower for r in mates].count(False) == 1


def test_co_rotating_frames_ask_less_of_the_upper_rotors():
    for name in ("ardupilot-octaquad-x-cor", "ardupilot-octaquad-cw-x-cor"):
        vehicle = airframes.named(name)
        assert [row[3] for row in vehicle.mixer] == [1.0 if r.lower else 0.9 for r in vehicle.rotors]


def test_v_frame_yaws_less_in_front():
    mixer = airframes.named("ardupilot-quad-v").mixer
    assert mixer[0, 2] == pytest.approx(0.5 * 0.7981)
    assert mixer[1, 2] == pytest.approx(0.5)


def test_parameters_give_the_thrust_curve():
    parameters = {"FRAME_CLASS": 2, "FRAME_TYPE": 1, "MOT_PWM_MIN": 1100, "MOT_PWM_MAX": 1900, "MOT_SPIN_MIN": 0.1}
    parameters |= {"MOT_SPIN_MAX": 0.9, "MOT_THST_EXPO": 0.5}
    vehicle = airframes.identify(flight(rotors=6, parameters=parameters))
    assert vehicle.name == "ardupilot-hexa-x"
    assert (vehicle.curve.u_min, vehicle.curve.u_max, vehicle.curve.expo) == pytest.approx((1180, 1820, 0.5))
    assert vehicle.curve.known and not vehicle.assumptions


def test_missing_curve_parameters_are_said_to_be_assumed():
    vehicle = airframes.identify(flight(parameters={"FRAME_CLASS": 1, "FRAME_TYPE": 1}))
    assert not vehicle.curve.known
    assert "MOT_THST_EXPO" in " ".join(vehicle.assumptions)


def test_pulse_range_of_the_throttle_channel_counts_when_no_other_is_set():
    parameters = {"FRAME_CLASS": 1, "MOT_PWM_MIN": 0, "MOT_PWM_MAX": 0, "RC3_MIN": 1094, "RC3_MAX": 1934}
    vehicle = airframes.identify(flight(parameters=parameters | {"MOT_SPIN_MIN": 0.0, "MOT_SPIN_MAX": 1.0}))
    assert (vehicle.curve.u_min, vehicle.curve.u_max) == (1094, 1934)


def test_old_firmware_names_its_class_in_a_message():
    old = {"FRAME": 1, "THR_MIN": 130, "MOT_THST_MAX": 0.94, "RC3_MIN": 1000, "RC3_MAX": 1900, "MOT_THST_EXPO": 0.8}
    texts = (Message(0.0, "text", "Frame: HEXA"),)
    vehicle = airframes.identify(flight(rotors=6, parameters=old, messages=texts))
    assert vehicle.name == "ardupilot-hexa-x"
    assert vehicle.curve.u_min == pytest.approx(1117)
    assert vehicle.curve.u_max == pytest.approx(1117 + 0.94 * (1900 - 1117))


def test_old_firmware_without_message_is_counted():
    vehicle = airframes.identify(flight(rotors=8, parameters={"FRAME": 0}))
    assert vehicle.name == "ardupilot-octa-plus"
    assert any("8 motor outputs" in a for a in vehicle.assumptions)


@pytest.mark.parametrize("frame", ["octa-x", "octaquad-x", "octa-plus", "octaquad-plus", "hexa-x", "y6", "y6-b"])
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_old_firmware_without_message_is_reported_by_how_its_outputs_move(frame, noise):
    """Eight outputs are an octa's or an octaquad's: each mixer moves them along four directions of its own."""
    rng = np.random.default_rng(2)
    control = rng.normal(size=(400, 4)) * [0.05, 0.05, 0.05, 0.02] + [0.02, -0.01, 0.03, 0.45]
    mixer = airframes.named(f"ardupilot-{frame}").mixer
    assert mixer is not None
    pulses = np.round(1000 + 1000 * (control @ mixer.T) + noise * rng.normal(size=(400, len(mixer))))
    motors = Signal(np.arange(400) / 10, pulses, tuple(f"r{k + 1}" for k in range(len(mixer))), "us", source="MOT")
    kind = {"plus": 0, "b": 10}.get(frame.rpartition("-")[2], 1)
    log = Flight("test", "ArduPilot", {"motors": motors}, 40.0, parameters={"FRAME": kind, "THR_MIN": 130})
    vehicle = airframes.identify(log)
    assert vehicle.name == f"ardupilot-{frame}"
    assert any("matches the mixing of" in a for a in vehicle.assumptions) or kind == 10  # only a Y6 has that type


@pytest.mark.parametrize(
    "parameters, rotors, says",
    [
        ({"FRAME_CLASS": 7, "FRAME_TYPE": 0}, 4, "commands 4 rotors"),
        ({"FRAME_CLASS": 10}, 4, "bicopter"),
        ({"FRAME_CLASS": 6}, 4, "helicopter"),
        ({"FRAME_CLASS": 99}, 4, "FRAME_CLASS 99"),
        ({"FRAME_CLASS": 2, "FRAME_TYPE": 15}, 6, "FRAME_TYPE 15"),
        ({"FRAME_CLASS": 2, "FRAME_TYPE": 1}, 4, "commands 4 rotors"),
        ({"FRAME": 9}, 4, "FRAME 9"),
        ({}, 4, "--vehicle"),
    ],
)
def test_what_cannot_be_flown_is_refused_in_a_sentence(parameters, rotors, says):
    with pytest.raises(VehicleError, match=says):
        airframes.identify(flight(rotors=rotors, parameters=parameters))


@pytest.mark.parametrize(
    "autopilot, about, says",
    [
        ("ArduPilot", {"vehicle_type": "ArduPlane"}, r"fixed-wing aircraft \(ArduPlane\).* multirotors"),
        ("ArduPilot", {"vehicle_type": "ArduPlane", "parameters": {"Q_ENABLE": 1}}, "VTOL aircraft .*--vehicle FILE"),
        ("ArduPilot", {"vehicle_type": "ArduRover", "parameters": {"FRAME_CLASS": 1}}, "ground rover"),
        ("ArduPilot", {"vehicle_type": "ArduRover", "parameters": {"FRAME_CLASS": 2}}, "boat"),
        ("ArduPilot", {"vehicle_type": "ArduSub", "parameters": {"FRAME_CONFIG": 1}}, "submarine"),
        ("ArduPilot", {"vehicle_type": "Blimp"}, "airship"),
        ("ArduPilot", {"vehicle_type": "AntennaTracker"}, "antenna tracker"),
        ("ArduPilot", {"vehicle_type": "ArduCopter", "parameters": {"FRAME": 0, "H_COL_MIN": 1250}}, "helicopter"),
        ("PX4", {"parameters": {"MAV_TYPE": 1}}, "fixed-wing"),
        ("PX4", {"parameters": {"MAV_TYPE": 22, "SYS_AUTOSTART": 13000}}, "VTOL"),
        ("PX4", {"parameters": {"CA_AIRFRAME": 6, "CA_ROTOR_COUNT": 2}}, r"ground rover \(CA_AIRFRAME 6\)"),
        ("PX4", {"facts": {"mav_type": 10}}, "ground rover"),
    ],
)
def test_other_vehicles_are_named_as_what_they_are(autopilot, about, says):
    with pytest.raises(VehicleError, match=says) as caught:
        airframes.identify(flight(autopilot, **about))
    assert str(caught.value).startswith("test.bin") and "\n" not in str(caught.value)


def test_tables_without_autopilot_are_not_guessed():
    with pytest.raises(VehicleError, match="--vehicle"):
        airframes.identify(flight(autopilot=""))


@pytest.mark.parametrize("kind, frame", [("quadrotor", "quad-x"), ("hexarotor", "hexa-x"), ("octorotor", "octa-x")])
@pytest.mark.parametrize("autopilot", ["ArduPilot", "PX4"])
def test_telemetry_with_a_vehicle_type_only_assumes_x(autopilot, kind, frame):
    rotors = {"quad-x": 4, "hexa-x": 6, "octa-x": 8}[frame]
    vehicle = airframes.identify(flight(autopilot=autopilot, rotors=rotors, vehicle_type=kind))
    assert vehicle.name == f"{autopilot.lower()}-{frame}"
    assert any("assumed" in a for a in vehicle.assumptions)


def test_px4_geometry_from_parameters():
    places = [(0.1, 0.2, 0.05), (-0.1, -0.2, 0.05), (0.1, -0.2, -0.05), (-0.1, 0.2, -0.05)]
    parameters = {"CA_ROTOR_COUNT": 4, "CA_AIRFRAME": 0, "THR_MDL_FAC": 0.3}
    for k, (x, y, moment) in enumerate(places):
        parameters |= {f"CA_ROTOR{k}_PX": x, f"CA_ROTOR{k}_PY": y, f"CA_ROTOR{k}_KM": moment, f"CA_ROTOR{k}_CT": 6.5}
    vehicle = airframes.identify(flight("PX4", parameters=parameters, facts={"pwm_min": 1100.0, "pwm_max": 1900.0}))
    assert [(r.x, r.y, r.spin) for r in vehicle.rotors] == [(x, y, int(np.sign(m))) for x, y, m in places]
    assert (vehicle.curve.u_min, vehicle.curve.u_max, vehicle.curve.expo) == (1100, 1900, 0.3)
    assert vehicle.curve.known
    shares = airframes.identify(flight("PX4", unit="1", source="actuator_motors", parameters=parameters))
    assert (shares.curve.u_min, shares.curve.u_max, shares.curve.expo) == (0, 1, 0)


def test_px4_rotors_of_different_strength_and_height():
    """CA_ROTOR*_CT scales what a rotor gives; of two on one arm the one whose z points further down is the lower."""
    parameters = {"CA_ROTOR_COUNT": 8, "CA_AIRFRAME": 0}
    for k in range(8):
        x, y = (0.2, 0.2, -0.2, -0.2)[k % 4], (0.2, -0.2, -0.2, 0.2)[k % 4]
        parameters |= {f"CA_ROTOR{k}_PX": x, f"CA_ROTOR{k}_PY": y, f"CA_ROTOR{k}_PZ": (0.05, -0.05)[k // 4]}
        parameters |= {f"CA_ROTOR{k}_KM": 0.05 * (-1) ** (k + k // 4), f"CA_ROTOR{k}_CT": 8.0 if k == 6 else 4.0}
    vehicle = airframes.identify(flight("PX4", rotors=8, parameters=parameters))
    assert any("Lower rotors" in note for note in vehicle.assumptions)
    shares = np.array([r.share for r in vehicle.rotors])
    assert shares / shares[4] == pytest.approx([0.85] * 4 + [1.0, 1.0, 2.0, 1.0])


@pytest.mark.parametrize("start, frame", [(4001, "quad-x"), (5001, "quad-plus"), (10016, "quad-x"), (3010, "quad-x")])
def test_px4_airframe_numbers(start, frame):
    vehicle = airframes.identify(flight("PX4", parameters={"SYS_AUTOSTART": start}))
    assert vehicle.name == f"px4-{frame}"
    assert not vehicle.curve.known


def test_the_curve_of_px4_s_mixer_is_a_parameter_of_its_own():
    """Not the one of a vehicle file that does not say it; a file's own word counts, and other autopilots mix by the vehicle's curve."""
    curve = vehicle.ThrustCurve(0.0, 1.0, 0.65)
    given = replace(airframes.named("px4-quad-x"), curve=curve, extra={})
    for parameters, expo in (({}, 0.0), ({"THR_MDL_FAC": 0.3}, 0.3)):
        log = flight("PX4", parameters=parameters)
        assert allocation.mixer_curve(airframes.of(log, given)).expo == pytest.approx(expo)
    assert allocation.mixer_curve(airframes.of(log, replace(given, extra={"mixer_expo": 0.5}))).expo == 0.5
    assert airframes.of(flight(parameters={"FRAME_CLASS": 1.0}), given) is given
    assert allocation.mixer_curve(airframes.named("px4-quad-x")).expo == 0.0 < allocation.mixer_curve(given).expo


def test_px4_vtol_is_refused():
    with pytest.raises(VehicleError, match="CA_AIRFRAME 2"):
        airframes.identify(flight("PX4", parameters={"CA_AIRFRAME": 2, "CA_ROTOR_COUNT": 4}))


def test_unknown_name_proposes_close_ones():
    with pytest.raises(VehicleError, match="ardupilot-hexa-x"):
        airframes.named("hexa")


def test_every_class_and_type_pair_of_ardupilot_is_named():
    for frame in ardupilot.FRAMES:
        assert f"ardupilot-{frame}" in airframes.names()
    assert len(ardupilot.FRAMES) >= 40


SETTINGS = ["FRAME_CLASS", "FRAME_TYPE", "FRAME", "MOT_PWM_MIN", "MOT_PWM_MAX", "RC3_MIN", "RC3_MAX", "MOT_SPIN_MIN"]
SETTINGS += ["MOT_SPIN_MAX", "MOT_THST_EXPO", "THR_MIN", "MOT_THST_MAX", "CA_ROTOR_COUNT", "CA_AIRFRAME", "THR_MDL_FAC"]
SETTINGS += ["SYS_AUTOSTART", "MAV_TYPE", "CA_ROTOR0_PX", "CA_ROTOR1_PY", "CA_ROTOR2_KM", "CA_ROTOR0_CT"]


@settings(max_examples=trials(200), deadline=None)
@given(
    st.dictionaries(st.sampled_from(SETTINGS), st.one_of(st.floats(), st.integers(-3, 20), st.integers(900, 13000))),
    st.sampled_from(["ArduPilot", "PX4"]),
    st.sampled_from([0, 3, 4, 6, 8]),
)
def test_damaged_parameters_give_a_vehicle_or_a_sentence(parameters, autopilot, rotors):
    try:
        vehicle = airframes.identify(flight(autopilot, rotors, parameters=parameters))
    except VehicleError as error:
        assert str(error).endswith(".")
        return
    assert vehicle.curve.u_min < vehicle.curve.u_max and 0 <= vehicle.curve.expo <= 1
    assert vehicle.mixer is None or np.isfinite(vehicle.mixer).all()  # a tricopter has none
    assert np.isfinite(vehicle.effectiveness()).all()


@needs_flights
@pytest.mark.parametrize(
    "path, name",
    [
        ("ardupilot-sitl/octa_healthy_circle_wind.bin.xz", "ardupilot-octa-plus"),
        ("ardupilot-sitl/quadx_m3_mul0.85_tlog.tlog.xz", "ardupilot-quad-x"),
        ("ardupilot-real-twoflights/sample.bin.xz", "ardupilot-quad-x"),
        ("px4-pyulog/sample_px4_events.ulg.xz", "px4-4-rotors"),
        ("px4-rflymad/TestCase_4_1000000003.ulg.xz", "px4-quad-x"),
        ("crazypad/normal_flight__E8_log01.usd.xz", "crazyflie"),
    ],
)
def test_real_logs_are_identified(path, name):
    assert airframes.identify(logs.read(FLIGHTS / path)).name == name


@needs_flights
def test_a_real_plane_is_called_one():
    path = FLIGHTS / "wild" / "plane-1.bin.xz"
    if not path.is_file():
        pytest.skip("this flight is missing")
    with pytest.raises(VehicleError, match="fixed-wing"):
        airframes.identify(logs.read(path))
