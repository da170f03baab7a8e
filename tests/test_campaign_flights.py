"""Campaign flights for real: the batch assesses as `diagnose` does, however it is split, and what is written down is true."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rotorwatch
from rotorwatch.base import backend
from rotorwatch.base.compiling import toolchain
from rotorwatch.engine.motion.tick_table import LEARN
from rotorwatch_lab import campaign
from rotorwatch_lab.campaign import batch, methods, score, work
from rotorwatch_lab.compiling import run
from rotorwatch_lab.published import log_plant, published
from rotorwatch_lab.simulation import scenario, simulate

pytest.importorskip("pyarrow")
WIDTH = 4
PLAN = {
    "name": "small",
    "seed": 3,
    "healthy": 0.4,
    "estimators": ["default", "ekf"],
    "detectors": ["ardupilot-thrust-loss"],
    "decisions": [{"name": "usual"}, {"name": "strict", "sigmas": 40.0}],
    "scenario": {
        "duration_s": 35.0,
        "airframe": {"frame": "quad-x"},
        "trajectory": {"land": False},
        "wind": {"speed_m_s": {"uniform": [0.0, 2.0]}},
    },
    "faults": [{"kind": "loss", "onset_s": 22.0, "strength": {"uniform": [0.15, 0.4]}}],
}


@pytest.fixture(scope="module")
def plan():
    return campaign.from_table(PLAN)


@pytest.fixture(scope="module")
def rows(plan):
    return batch.assess(plan, range(WIDTH), WIDTH)


def of(rows, method):
    return [row for row in rows if row["method"] == method]


def test_a_row_per_flight_and_method(plan, rows):
    assert plan.methods == ("default", "ekf/usual", "ekf/strict", "ardupilot-thrust-loss")
    assert len(rows) == WIDTH * 4
    for method in plan.methods:
        assert [row["flight"] for row in of(rows, method)] == list(range(WIDTH))
    assert all(set(row) == set(score.COLUMNS) for row in rows)


def test_however_it_is_split(plan, rows):
    """Bit for bit: flights do not depend on who they fly with, nor on their place in the batch."""
    apart = [*batch.assess(plan, [2, 0], WIDTH), *batch.assess(plan, [3], WIDTH), *batch.assess(plan, [1], WIDTH)]

    def key(row):
        return row["method"], row["flight"]

    assert sorted(apart, key=key) == sorted(rows, key=key)


def test_as_diagnose_assesses_the_log(plan, rows):
    """The first event, its delay and the assessed time are those of `diagnose` on the flight's log."""
    some = 0
    for row in of(rows, "default"):
        made = simulate(plan.flight(row["flight"]))
        found = rotorwatch.diagnose(made.flight)
        assert row["answer"] == found.verdict
        open_ = {r.rotor for r in found.rotors if r.status not in ("healthy", "unobservable")}
        assert set(map(int, filter(None, row["accused"].split("+")))) == open_
        events = [e for e in found.events if e.kind == "loss_of_effectiveness"]
        assert len(events) == row["false_alarms"] + row["wrong"] + bool(row["detected"])
        if row["fault"]:
            some += 1
            assert "+".join(map(str, sorted(events[0].rotors))) == row["broken"]
            assert events[0].detected_s - row["onset_s"] == pytest.approx(row["delay_s"], abs=1e-6)
            assert events[0].loss[0] == pytest.approx(row["estimate"], abs=0.03)  # at the end of the flight, here 10 s on
    assert 0 < some < WIDTH


def test_a_dead_rotor_in_wind_is_not_taken_for_the_other_on_its_arm():
    """Only yaw distinguishes the two, and there the drag that a dead rotor no longer has is larger than its torque: both of these flights
    accused the other one. Light vehicles: 2 to 3 m/s of air through their rotors in hover."""
    for frame, seed, mass, arm, power, lag, shake, kind, speed, wind, rotor, onset, profile in (
        ("y6", 914589413, 1.579, 0.582, 2.469, 0.041, 1.208, "climb", 4.521, (7.852, 41.213), 3, 22.91, "default"),
        ("octaquad-x", 1371858336, 1.352, 0.276, 2.315, 0.021, 0.349, "figure-eight", 4.136, (5.297, 225.989), 7, 31.038, "fast"),
    ):
        table = {
            "name": "one arm", "seed": seed, "duration_s": onset + 8.0, "logging": {"profile": profile}, "sensors": {"vibration": shake},
            "airframe": {"frame": frame, "mass_kg": mass, "arm_m": arm, "thrust_to_weight": power, "lag_s": lag},
            "trajectory": {"kind": kind, "speed_m_s": speed, "land": False}, "wind": {"speed_m_s": wind[0], "from_deg": wind[1]},
            "faults": [{"kind": "complete loss", "rotor": rotor, "onset_s": onset}],
        }  # fmt: skip
        found = rotorwatch.diagnose(simulate(scenario.from_table(table)).flight)
        reported = [(e.rotors, *e.alternatives) for e in found.events if e.kind == "loss_of_effectiveness"]
        assert reported and all((rotor,) in names for names in reported), (frame, reported)


def test_what_wind_hides_is_in_the_answer():
    """An octa that turns in 7 m/s of wind: the answer to the whole flight names the rotor and no other."""
    plan = campaign.read(Path(__file__).parents[1] / "plans" / "default.toml")
    (row,) = of(batch.assess(plan, [4996], 1), "default")
    assert row["loss"] > 0.25 and row["answer"] in ("ambiguous", "fault") and row["accused"] == row["broken"]


@pytest.mark.thorough
def test_native_code_and_jax_assess_alike(plan, rows, monkeypatch):
    """One flight after the other as C, or all side by side in JAX: the same events, numbers to rounding."""
    if methods.engine() != "native":
        pytest.skip("no C compiler, or $ROTORWATCH_BACKEND is not native: the rows are not of native code")
    monkeypatch.setenv("ROTORWATCH_BACKEND", "jax")
    assert methods.engine() == "jax"
    for one, other in zip(rows, batch.assess(plan, range(WIDTH), WIDTH), strict=True):
        for key, value in one.items():
            same = value == other[key] or value == pytest.approx(other[key], rel=1e-5, abs=1e-5)
            assert same, (one["method"], key, value, other[key])


def test_no_compiler_no_native_code(monkeypatch):
    def missing():
        raise toolchain.Unavailable("none")

    monkeypatch.setattr(toolchain, "compiler", missing)
    monkeypatch.delenv("ROTORWATCH_BACKEND", raising=False)
    assert methods.engine() == "jax"


def test_published_methods_are_assessed_as_alone(plan, rows):
    """Side by side, with several thresholds: as `published.assess` does it for each flight."""
    flown = batch.fly(plan, range(WIDTH), WIDTH)
    B, tables = flown[0].vehicle.effectiveness(), [f.ticks for f in flown]
    hops = [log_plant.hops(table, B) for table in tables]
    for name in ("ekf", "lyapunov"):
        usual, strict = methods.assess(name, tables, hops, B, WIDTH, ((), (("sigmas", 40.0),)))
        for kept, table, found in zip(usual, tables, hops, strict=True):
            alone, _ = published.assess(name, table, B, hops=found)
            for a, b in zip(kept, alone, strict=True):
                assert np.allclose(a, b, rtol=0, atol=1e-6)
        assert all(k.statistic.max() < u.statistic.max() for k, u in zip(strict, usual, strict=True))
        assert not any(k.announced.any() for k in strict) and any(u.announced.any() for u in usual)
    found = {row["flight"]: row["detected"] for row in of(rows, "ekf/usual") if row["fault"]}
    assert any(found.values()) and not any(row["detected"] for row in of(rows, "ekf/strict"))


def test_flights_of_several_hops_learn_alone(plan):
    """A table that restarts half-way has two hops; each is written down where it belongs."""
    f = batch.fly(plan, [0], WIDTH)[0]
    table = f.ticks
    again = table.restart.copy()
    again[len(again) // 2] = True
    mode = table.mode.copy()
    mode[len(mode) // 2 : len(mode) // 2 + np.count_nonzero(mode == LEARN)] = LEARN
    table = replace(table, restart=again, mode=mode)
    B = f.vehicle.effectiveness()
    hops = [log_plant.hops(table, B)]
    assert len(hops[0]) == 2
    kept = methods.assess("ekf", [table], hops, B, WIDTH, ((),))[0][0]
    alone, _ = published.assess("ekf", table, B)
    assert np.allclose(kept.statistic, alone.statistic, rtol=0, atol=1e-6)
    assert (kept.statistic[hops[0][1].rows] > -50.0).all()


def test_the_truth_is_written_down(plan, rows):
    for row in of(rows, "default"):
        scenario = plan.flight(row["flight"])
        assert row["wind_m_s"] == scenario.wind["speed_m_s"] and bool(row["fault"]) == bool(scenario.faults)
        if not scenario.faults:
            assert row["healthy_s"] == row["assessed_s"] and row["onset_s"] is None and row["bound_sd"] is None
            continue
        fault = scenario.faults[0]
        assert (row["onset_s"], row["broken"], row["clear"]) == (fault["onset_s"], str(fault["rotor"]), True)
        assert row["loss"] == pytest.approx(fault["strength"], abs=1e-9)
        assert row["healthy_s"] < row["assessed_s"]


def test_calm_flights_are_assessed_well_and_bounds_are_below(rows):
    for row in of(rows, "default"):
        assert row["false_alarms"] == 0 and row["peak"] < 0.0
        if row["fault"]:
            assert row["right"] and row["delay_s"] < 1.5 and row["peak_2s"] > 0.0
            assert abs(row["estimate"] - row["loss"]) < 0.03
            assert 0.0 < row["bound_delay_s"] <= row["delay_s"] and 0.0 < row["bound_sd"] < 0.03


def test_rules_that_name_rotors_only():
    """A finding before the onset is a false alarm, of another rotor a wrong one, of the right one a detection; each rotor once."""
    asked = campaign.from_table({**PLAN, "healthy": 0.0})
    f = batch.fly(asked, [0], WIDTH)[0]
    broken = f.scenario.faults[0]["rotor"]
    other = broken % 4 + 1

    def finds(*pairs):
        return score.rule("x", f, [{"rotor": r, "time_s": t} for r, t in pairs], None, asked)

    row = finds((broken, 25.0), (broken, 23.0))
    assert (row["detected"], row["right"], row["delay_s"], row["wrong"]) == (True, True, pytest.approx(1.0), 0)
    row = finds((other, 15.0), (broken, 23.0))
    assert (row["false_alarms"], row["right"]) == (1, True)
    row = finds((other, 23.0))
    assert (row["detected"], row["wrong"], row["delay_s"]) == (False, 1, None)
    assert row["estimate"] is None and row["peak"] is None


def test_peaks_need_to_last(plan):
    f = batch.fly(plan, [0], WIDTH)[0]
    assert f.ticks.dt == 0.1
    assessed = np.flatnonzero(f.ticks.mode == 2)
    statistic = np.full(len(f.ticks.time), -9.0)
    statistic[assessed[20]] = 7.0
    assert score._peaks(f, statistic, None) == {"peak": -9.0}
    statistic[assessed[20] + 1] = 5.0
    assert score._peaks(f, statistic, None) == {"peak": 5.0}
    onset = float(f.ticks.time[assessed[10]])
    found = score._peaks(f, statistic, onset)
    assert (found["peak"], found["peak_1s"], found["peak_2s"]) == (-9.0, -9.0, 5.0)
    statistic[: assessed[0]] = 99.0  # what is not assessed does not count
    assert score._peaks(f, statistic, None) == {"peak": 5.0}


def test_the_width_follows_the_device(monkeypatch):
    class Device:
        kind, device_kind = "cpu", "NVIDIA H200"

        def default_backend(self):
            return self.kind

        def devices(self):
            return [self]

    monkeypatch.setattr(batch, "load_jax", Device)
    monkeypatch.setattr(run, "load_jax", Device)
    monkeypatch.setattr(backend, "jax", Device)
    assert batch.width() == batch.CPU_WIDTH and work._processes(3) == 3 and work._processes() >= 1
    monkeypatch.setenv("ROTORWATCH_BACKEND", "jax")
    assert batch.where() == "on the processor, 32 flights side by side"
    monkeypatch.delenv("ROTORWATCH_BACKEND")
    monkeypatch.setattr(toolchain, "compiler", lambda: "cc")
    assert batch.where() == "on the processor, 32 flights side by side, estimators as native code"
    monkeypatch.setattr(Device, "kind", "gpu")
    assert batch.width() == batch.ACCELERATOR_WIDTH and work._processes(3) == work._processes() == 1
    assert batch.where() == "on 1 x NVIDIA H200, 1024 flights side by side" and methods.engine() == "jax"


@pytest.mark.thorough
def test_as_many_at_once_as_fit_the_cache(monkeypatch):
    small, large = {"a": np.zeros(100)}, {"a": np.zeros(methods.CACHE_BYTES // 8 // 5), "b": np.zeros(1)}
    assert methods.side_by_side(small, 32) == 32
    assert methods.side_by_side(large, 32) == 4
    assert methods.side_by_side({"a": np.zeros(methods.CACHE_BYTES)}, 32) == 1

    class Device:
        tree = methods.load_jax().tree

        def default_backend(self):
            return "gpu"

    monkeypatch.setattr(methods, "load_jax", Device)
    assert methods.side_by_side(large, 1024) == 1024
