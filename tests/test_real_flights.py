"""Recipes for real flights in public repositories, on checkouts made up for the purpose, and the page of real faults."""

import csv
import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tomllib

from rotorwatch import airframes, logs
from rotorwatch.flight import Flight, Signal, vehicle_file
from rotorwatch_lab.experiments import evaluate, real_flights
from rotorwatch_lab.experiments.labels import Fault
from rotorwatch_lab.experiments.real_flights import crazypad, degraded_control, neural_fly, openha, others, rrc, rules, tables

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / "src" / "rotorwatch" / "samples"


def put(path, text="x"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_the_vehicle_file_of_a_quad_is_px4s(tmp_path):
    tables.quad_x(tmp_path / "v.toml", "quad", 1.0, 0.0, 1.0)
    made, px4 = vehicle_file.read(tmp_path / "v.toml"), airframes.named("px4-quad-x")
    assert np.sign(made.effectiveness()) == pytest.approx(np.sign(px4.effectiveness()))
    tables.quad_x(tmp_path / "r.toml", "quad", 1.0, 0.0, 1.0, reverse=True)
    other = vehicle_file.read(tmp_path / "r.toml").effectiveness()
    assert np.sign(other[2]) == pytest.approx(-np.sign(made.effectiveness()[2])) and other[:2] == pytest.approx(made.effectiveness()[:2])


def test_neural_flys_frames_become_frd_and_ned(tmp_path):
    """A vehicle that rolls to its right, climbs and flies to the west."""
    head = ("t", "p", "v", "q", "w", "pwm")
    fixed = [0.1, 0.0, 0.0, 0.995], [0.3, 0.2, 0.1], [999.5, 1999.0, 0.0, 500.0]
    rows = [(0.02 * k, [0.0, 2.0, 1.0 + k], [0.0, 1.0, 0.5], *fixed) for k in range(60)]
    source = tmp_path / "data" / "experiment" / "custom_figure8_NF_35wind.csv"
    source.parent.mkdir(parents=True)
    with source.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(head)
        out.writerows([[row[0], *map(json.dumps, row[1:])] for row in rows])
    (tmp_path / "out").mkdir()
    (found,) = neural_fly.flights(tmp_path, tmp_path / "out")
    assert found["group"] == "experiment, 35wind" and "rotor" not in found
    flight = logs.read(found["path"])
    assert flight["motors"].values[0] == pytest.approx([0.5, 1.0, 0.0, 500 / 1999], abs=1e-6)
    assert flight["gyro"].values[0] == pytest.approx([0.3, -0.2, -0.1])
    assert flight["velocity"].values[0] == pytest.approx([0.0, -1.0, -0.5])
    assert flight["attitude"].values[0] == pytest.approx([0.995, 0.1, 0.0, 0.0], abs=1e-3)


def test_openhas_losses_count_from_the_first_row(tmp_path):
    head = "timestamp,euler_re_roll,euler_re_pitch,euler_re_yaw,omega_re_p,omega_re_q,omega_re_r,sigma_re,,,,z_re,vz_re"
    rows = [f"{26_000_000 + 50_000 * min(k, 58)},0.01,0.02,0.03,0.1,0.2,0.3,0.5,0.6,0.7,0.8,-1,0" for k in range(60)]
    put(tmp_path / openha.FOLDER / f"{openha.NAME}_lossfactor.csv", "\n".join([head, *rows]))
    place = ["timestamp,x,y,z,vx,vy,vz", *(f"{25_000_000 + 100_000 * k},1,2,-3,0.1,0.2,0.3" for k in range(60))]
    put(tmp_path / openha.FOLDER / f"{openha.NAME}_vehicle_local_position_0.csv", "\n".join(place))
    (tmp_path / "out").mkdir()
    first, second = openha.flights(tmp_path, tmp_path / "out")
    assert (first["rotor"], second["rotor"]) == ("1", "3") and first["onset_s"] == pytest.approx(82.3 - 26.0)
    flight = logs.read(first["path"])
    assert len(flight["motors"]) == 59 and flight["motors"].values[0] == pytest.approx([0.5, 0.6, 0.7, 0.8])
    assert flight["gyro"].values[0] == pytest.approx([0.1, 0.2, 0.3]) and flight["position"].values[0] == pytest.approx([1.0, 2.0, -3.0])


@pytest.mark.parametrize(
    "changed, loe, ch7, reported",
    [
        (False, [1.0, 0.48, 0.0, 0.0], [1094, 1094, 1094, 1514], [("1", 10.0, None), ("2", 30.0, None)]),
        (False, [1.0, 0.0, 0.0, 0.48], [1934, 1934, 1934, 1934], [("1+4", 10.0, None)]),
        (True, [1.0, 0.48, 0.0, 0.0], [1094, 1094, 1094, 1514], [("1", 10.0, None), ("4", 20.0, 30.0), ("2", 30.0, None)]),
        (True, [1.0, 0.48, 0.0, 1.0], [1934, 1934, 1934, 1934], [("1", 10.0, 30.0), ("4+2", 20.0, 30.0)]),
        (True, [1.0, 1.0, 1.0, 1.0], [1934, 1934, 1934, 1934], []),
    ],
)
def test_rotors_switched_off_follow_the_switches(changed, loe, ch7, reported):
    found = degraded_control.faults(np.arange(4) * 10.0, np.array(loe), np.array(ch7), changed)
    assert [(f["rotor"], f["onset_s"], f["end_s"]) for f in found] == reported


def test_labels_by_folder_names(tmp_path):
    good = put(tmp_path / rrc.FOLDER / "Hover" / "good prop hover" / "good prop_hover 1.BIN")
    put(tmp_path / rrc.FOLDER / "Hover" / "25 mm cut hover" / "25 mm cut_hover 1.BIN")
    rows = list(rrc.flights(tmp_path, tmp_path))
    assert [(r.get("rotor"), r.get("baseline")) for r in rows] == [("1", None), ("1", str(good)), (None, None), (None, "")]
    cases = {
        "cut_M2_0.5мм_0.5мм_46мм_M1_3.5мм_46.5мм": ("1+2", "3.5 or 4 mm"), "cut_propeller_M3_1mm": ("3", "up to 1 mm"),
        "tape_on_propeller_M1_M3": ("1+3", "tape"), "normal_flight": (None, "whole"), "add_weight_W1_near_M3": (None, "weights"),
    }  # fmt: skip
    for case in cases:
        put(tmp_path / "data" / "motor_data" / case / "E8_log00", "motor.m1(H)")
    put(tmp_path / "data" / "motor_data" / "cut_propeller_M3_2mm" / "E9_log01", "ctrl")  # of another kind
    found = {Path(r["path"]).parent.name: r for r in crazypad.flights(tmp_path, tmp_path)}
    assert found.keys() == cases.keys()
    for case, (rotors, group) in cases.items():
        assert found[case].get("rotor") == rotors and group in found[case]["group"]
    assert found["normal_flight"]["baseline"] == "" and "normal_flight" in found["cut_propeller_M3_1mm"]["baseline"]


def test_other_logs_count_once(tmp_path):
    for name in ("a.bin", "b.bin"):
        put(tmp_path / name, "the same")
    put(tmp_path / "c.bin", "another")
    put(tmp_path / "readme.md", "no log")
    rows = list(others.flights(tmp_path, tmp_path, seen={"c.bin": [4, 5.5]}))
    assert [(Path(r["path"]).name, r["group"]) for r in rows] == [("a.bin", "no known fault"), ("c.bin", others.SEEN)]
    assert rows[1]["rotor"] == "4" and rows[1]["onset_s"] == 5.5


def outputs(columns):
    time = np.arange(0.0, 40.0, 0.1)
    values = np.stack([np.interp(time, *column) if isinstance(column, tuple) else np.full(time.size, column) for column in columns], axis=1)
    return Flight("made", "PX4", {"motors": Signal(time, values, tuple(f"motor{k}" for k in range(1, 5)), "us")}, 40.0)


@pytest.mark.parametrize(
    ("columns", "found"),
    [
        ((1500.0,) * 4, []),
        ((1500.0, ([0, 20, 20.05, 40], [1500, 1500, 0, 0]), 1500.0, 1500.0), [(2, "output 0")]),
        ((1500.0, 1500.0, 1500.0, ([0, 20, 20.05, 40], [1500, 1500, 1950, 1950])), [(4, "50 samples")]),
        ((1500.0, 1500.0, 1500.0, ([0, 20, 20.05, 23, 23.05], [1500, 1500, 1950, 1950, 1500])), []),
        ((1500.0, ([0, 34.5, 34.6, 40], [1500, 1500, 0, 0]), 1500.0, 1500.0), []),  # at the landing
        ((1500.0, 0.0, 1500.0, 1500.0), []),  # an output that was never active
    ],
)
def test_flight_reviews_rule(monkeypatch, columns, found):
    monkeypatch.setattr(rules, "airborne", lambda flight: ((5.0, 35.0),))
    vehicle = SimpleNamespace(curve=SimpleNamespace(u_min=1000.0, u_max=2000.0))
    seen = rules.review(outputs(columns), vehicle)  # pyright: ignore[reportArgumentType]
    assert [(f["rotor"], f["reason"][: len(why)]) for f, (_, why) in zip(seen, found, strict=True)] == found


# ---------------------------------------------------------------- the page


@pytest.fixture
def maker(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module("make_real_faults")


def test_the_page_is_made_of_the_results(maker):
    sources = tomllib.loads(maker.LIST.read_text())["sources"]
    assert maker.PAGE.read_text() == maker.page(sources, maker.read())
    assert all(s["recipe"] in {"rrc", "crazypad", "openha", "degraded_control", "neural_fly", "others"} for s in sources)
    assert all(hasattr(real_flights.recipe(s["recipe"]), "flights") for s in sources)


def test_a_rule_is_assessed_on_each_fault_by_its_alarms_up_to_the_next(maker, monkeypatch):
    alarms = [{"detector": rules.REVIEW, "time_s": t, "rotor": r} for t, r in ((10.5, 1), (20.5, 4))]
    monkeypatch.setattr(maker.logs, "read", lambda path: None)
    monkeypatch.setattr(maker.rules, "findings", lambda log, vehicle: alarms)
    flight = SimpleNamespace(path="", vehicle=None, faults=(Fault((1,), 10.0), Fault((3,), 20.0), Fault((2,), 30.0)))
    assert [said[rules.REVIEW] for said in maker._others(flight)] == ["right", "wrong", "none"]
    healthy = SimpleNamespace(path="", vehicle=None, faults=())
    assert [said[rules.REVIEW] for said in maker._others(healthy)] == ["false"]


def test_a_checkout_becomes_rows_without_its_folder(maker, tmp_path, monkeypatch):
    checkout = tmp_path / "some+logs"
    put(checkout / "broken.bin", "nothing")
    (checkout / "healthy.bin.xz").write_bytes((SAMPLES / "quadx_healthy_hover.bin.xz").read_bytes())
    (checkout / "healthy.bin.xz").rename(checkout / "healthy.bin")  # compressed all the same
    source = {"repository": "some/logs", "commit": "0", "licence": "-", "recipe": "others", "about": "-", "label": "none"}
    rows = maker.assessed(source, checkout, tmp_path / "converted" / "some+logs", 1)
    assert [(r["path"], r["outcome"]) for r in rows] == [("broken.bin", evaluate.REFUSED), ("healthy.bin", "clean")]
    assert str(tmp_path) not in json.dumps(rows)
    monkeypatch.setattr(maker, "ROWS", tmp_path / "rows.csv")
    maker.write(rows)
    page = maker.page([source], maker.read())
    assert "| logs | no known fault | 1 | 0.03 | 1 | 0 | 0 | 0 | 0 | 0 |" in page and "0 alarms" in page
