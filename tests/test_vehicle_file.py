"""Vehicle files: what is written is read back, bad ones are refused by field."""

import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch import airframes
from rotorwatch.errors import VehicleError
from rotorwatch.flight import vehicle_file
from rotorwatch.flight.vehicle import Rotor, ThrustCurve, Vehicle

numbers = st.floats(-1e6, 1e6)
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
values = st.one_of(st.booleans(), st.integers(-(10**9), 10**9), numbers, texts, st.lists(numbers, max_size=4))
trees = st.dictionaries(texts, st.one_of(values, st.dictionaries(texts, values, max_size=3)), max_size=4)
rotors = st.builds(Rotor, st.floats(0.01, 3), st.floats(-3, 3), st.sampled_from([1, -1, 0]), st.floats(0.1, 10), st.booleans())


@st.composite
def vehicles(draw):
    places = tuple(draw(st.lists(rotors, min_size=3, max_size=12)))
    low = draw(st.floats(0, 1500))
    mixer = draw(st.one_of(st.none(), st.lists(st.tuples(*[numbers] * 4), min_size=len(places), max_size=len(places))))
    return Vehicle(
        name=draw(texts),
        rotors=places,
        curve=ThrustCurve(low, low + draw(st.floats(0.5, 900)), draw(st.floats(0, 1)), draw(st.booleans())),
        mixer=None if mixer is None else np.array(mixer),
        lag_s=draw(st.floats(0, 1)),
        source=draw(texts),
        assumptions=tuple(draw(st.lists(texts, max_size=3))),
        identified=draw(st.one_of(st.none(), trees)),
        extra=draw(trees),
    )


def same(one: Vehicle, other: Vehicle) -> bool:
    plain = ("name", "rotors", "curve", "lag_s", "source", "assumptions", "identified", "extra")
    mixers = (one.mixer is None and other.mixer is None) or np.array_equal(one.mixer, other.mixer)
    return mixers and all(getattr(one, k) == getattr(other, k) for k in plain)


@settings(max_examples=trials(60), deadline=None)
@given(vehicles())
def test_what_is_written_is_read_back(tmp_path_factory, vehicle):
    path = tmp_path_factory.mktemp("vehicle") / "v.toml"
    vehicle_file.write(vehicle, path)
    assert same(vehicle_file.read(path), vehicle)


def test_arrays_are_written_as_lists(tmp_path):
    vehicle = airframes.named("ardupilot-quad-x")
    gains = {"torque": np.arange(6.0).reshape(2, 3), "rates": {"roll": np.float64(0.25), "count": np.int64(3)}}
    vehicle_file.write(Vehicle(vehicle.name, vehicle.rotors, vehicle.curve, identified=gains), tmp_path / "v.toml")
    back = vehicle_file.read(tmp_path / "v.toml").identified
    assert back == {"torque": [[0, 1, 2], [3, 4, 5]], "rates": {"roll": 0.25, "count": 3}}


def test_an_existing_file_is_replaced_whole(tmp_path):
    path = tmp_path / "v.toml"
    path.write_text("old")
    vehicle_file.write(airframes.named("ardupilot-octa-x"), path)
    assert vehicle_file.read(path).name == "ardupilot-octa-x"
    assert os.listdir(tmp_path) == ["v.toml"]


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(VehicleError, match="Cannot write"):
        vehicle_file.write(airframes.named("ardupilot-quad-x"), tmp_path / "no" / "v.toml")


GOOD = """
name = "x"
[curve]
u_min = 1000
u_max = 2000
expo = 0.5
[[rotors]]
x = 1
y = 0
spin = "ccw"
[[rotors]]
x = -1
y = 1
spin = "cw"
[[rotors]]
x = -1
y = -1
spin = -1
"""


def test_a_file_written_by_hand(tmp_path):
    path = tmp_path / "v.toml"
    path.write_text(GOOD)
    vehicle = vehicle_file.read(path)
    assert [r.spin for r in vehicle.rotors] == [1, -1, -1]
    assert vehicle.lag_s == 0.03 and vehicle.mixer is None and vehicle.identified is None


@pytest.mark.parametrize(
    "old, new, says",
    [
        ("expo = 0.5", "expo = 1.5", "curve.expo"),
        ("expo = 0.5", "", "curve.expo"),
        ("u_max = 2000", "u_max = 900", "u_max must be larger"),
        ("u_max = 2000", "u_max = nan", "curve.u_max"),
        ('spin = "cw"', 'spin = "left"', r"rotors\[2\].spin"),
        ('spin = "cw"', "spin = [1]", r"rotors\[2\].spin"),
        ("x = 1\n", "x = true\n", r"rotors\[1\].x"),
        ('name = "x"', "name = 3", "name must be a text"),
        ('name = "x"', 'name = "x"\nmixer = [[1, 2, 3, 4]]', "mixer must be 3 rows"),
        ('name = "x"', 'name = "x"\nmixer = [["a"]]', "mixer must be 3 rows"),
        ('name = "x"', 'name = "x"\nrotor = 4', "unknown field rotor"),
        ('name = "x"', 'name = "x"\nassumptions = [1]', "assumptions"),
        ('name = "x"', 'name = "x"\nidentified = 1', "identified"),
        ('name = "x"', 'name = "x', "not valid TOML"),
        ("[curve]", "[bend]", "unknown field bend"),
    ],
)
def test_the_wrong_field_is_named(tmp_path, old, new, says):
    path = tmp_path / "v.toml"
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(VehicleError, match=says):
        vehicle_file.read(path)


def test_two_rotors_are_too_few(tmp_path):
    path = tmp_path / "v.toml"
    path.write_text(GOOD[: GOOD.rindex("[[rotors]]")])
    with pytest.raises(VehicleError, match="3 to 32"):
        vehicle_file.read(path)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"", b"a = " + b"[" * 5000])
def test_rubbish_is_refused(tmp_path, content):
    path = tmp_path / "v.toml"
    path.write_bytes(content)
    with pytest.raises(VehicleError):
        vehicle_file.read(path)


def test_a_missing_file_is_a_clear_error(tmp_path):
    with pytest.raises(VehicleError, match="Cannot read"):
        vehicle_file.read(tmp_path / "none.toml")
