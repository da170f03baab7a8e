"""`rotorwatch estimate`: what a published method itself says of a log, in files, pictures and pages, and in the answer of `diagnose`."""

import csv
import functools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import rotorwatch as rw
from rotorwatch.base.physics import G0
from rotorwatch.commands import cli
from rotorwatch.diagnose import prepare
from rotorwatch.errors import ConfigError, LogError
from rotorwatch.flight.method_series import INTERVAL, SET, MethodSeries
from rotorwatch.logs import log_memory
from rotorwatch.report import method_plots
from rotorwatch_lab.commands import estimate as command
from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.estimate import Estimates, read_truth, steps
from rotorwatch_lab.published import helicopter_log, log_plant, own, paper_log, published
from script_files import loaded

ROOT = Path(__file__).parents[1]
FAULTY = next(iter(sorted(cli.SAMPLES.glob("hexa*.bin.xz"))))
NAMES = ["ekf", "thau"]


@pytest.fixture(scope="module")
def found():
    return rw.estimate(FAULTY, NAMES)


@functools.cache
def by_ekf():
    return rw.diagnose(FAULTY, estimator="ekf")


def called(*arguments):
    done = CliRunner().invoke(cli.cli, ["estimate", *map(str, arguments)])
    return done if done.exception is None or isinstance(done.exception, SystemExit) else str(done.exception)


def made(n=4, says=INTERVAL, steps=40):
    """A series whose loss 2 is half known."""
    theta, spread = np.zeros((steps, n)), np.tile(np.diag(np.full(n, 0.04)), (steps, 1, 1))
    theta[steps // 2 :, 1] = 0.5
    blank = np.zeros((steps, 3))
    names = tuple(f"loss_{k + 1}" for k in range(n))
    return MethodSeries(
        "some", "rate_dynamics", says, 0.1 * np.arange(steps), np.ones(steps, int), theta, spread, blank, blank + 1, blank, blank + 1,
        np.zeros(steps, int), names, ("p", "q", "r"), ("rad/s",) * 3, ("p", "q", "r"), ("rad/s",) * 3, 0.1,
    )  # fmt: skip


def test_what_is_printed_is_a_median_and_ends_before_the_landing():
    """A single wild step and a wild last half second leave the printed lines as they are."""
    calm, wild = made(steps=100), made(steps=100)
    wild.theta[50, 0] = wild.theta[-5:, 2] = 9.0
    texts = [command._of(Estimates("log", (one,)), one) for one in (calm, wild)]
    assert texts[0] == texts[1] and "Medians over 1 s:" in texts[0] and "9.9 s" in texts[0].splitlines()[0]
    assert [line.split()[0] for line in texts[0].splitlines()[3:]] == ["0.0", "1.7", "3.5", "5.3", "7.1", "8.9"]


def test_series_are_those_of_the_estimator_run_by_hand(found):
    """Losses, covariance, states and innovations: what the estimator gives when it is stepped over the log's plant, to the last digits."""
    ready = prepare(rw.read(FAULTY))
    hop = log_plant.hops(ready.table, ready.vehicle.effectiveness())[0]
    _, out = run(published.method("ekf", hop.system, hop.dt), hop.u, hop.y, hop.valid)
    series, rows = found["ekf"], slice(0, len(hop.rows))
    for mine, its in ((series.theta, out.theta), (series.theta_cov, out.theta_cov), (series.x, out.x), (series.innovation, out.innovation)):
        assert np.allclose(mine[rows], its, rtol=1e-6, atol=1e-9)
    assert np.array_equal(series.time[rows], ready.table.time[hop.rows])
    sd = np.sqrt(np.diagonal(out.theta_cov, axis1=1, axis2=2))
    assert np.allclose(series.upper[rows] - series.lower[rows], 2 * 1.96 * sd, rtol=1e-5)


def test_a_set_is_a_bound_and_a_covariance_an_interval(found):
    system = rw.systems.RateDynamics.of(rw.airframes.paper("niermeyer-hexa"))
    assert own.says(rw.estimators.ESMF(system, 0.05)) == SET and found["ekf"].says == INTERVAL
    a, b = made(), made(says=SET)
    assert np.allclose(a.theta_off, 1.96 * 0.2) and np.allclose(b.theta_off, 0.2)
    assert "covariance" in a.whose and "set" in b.whose


def test_every_format_holds_the_same_numbers(found, tmp_path):
    for ending in ("csv", "json", "parquet"):
        found.write(tmp_path / f"e.{ending}")
    columns = found.columns()
    with open(tmp_path / "e.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(s.time) for s in found.series) and set(rows[0]) == set(columns)
    pa = pytest.importorskip("pyarrow.parquet")
    table = pa.read_table(tmp_path / "e.parquet").to_pydict()
    said = json.loads((tmp_path / "e.json").read_text())
    for name in ("time_s", "loss_3", "loss_3_low", "cov_loss_1_loss_2", "x_p", "innovation_f_z_off"):
        assert np.array_equal([float(row[name]) for row in rows], columns[name])
        assert np.array_equal(table[name], columns[name])
        own = [value for one in said["methods"] for value in one["series"][name]]
        assert np.array_equal(own, columns[name])
    assert [one["method"] for one in said["methods"]] == NAMES and said["methods"][1]["says"] == INTERVAL


def test_a_page_and_a_picture_show_every_method_beside_the_truth(found, tmp_path):
    pytest.importorskip("bokeh")
    pytest.importorskip("matplotlib")
    known = Estimates(found.log, found.series, {"other": "it does not fit"}, steps([("loss_1", 0.3, 30.0, 60.0)]))
    for ending in ("html", "svg", "png"):
        known.write(tmp_path / f"e.{ending}")
    page, picture = ((tmp_path / f"e.{ending}").read_text() for ending in ("html", "svg"))
    assert all(f"{name} on rate dynamics" in page for name in NAMES) and "holds the truth in" in page
    assert "other: it does not fit" in page.lower() and "http" not in page.split("<main")[1].split("<footer")[0]
    assert picture.startswith("<?xml") and (tmp_path / "e.png").read_bytes()[:4] == b"\x89PNG"
    shaded = method_plots.drawn(made(), a_range(), {f"loss_{k}": ("#000000", "solid") for k in range(1, 5)}, (-10, 60))["loss"]
    data = shaded.renderers[0].data_source.data
    assert np.allclose(data["t0_high"] - data["t0_low"], 200 * 1.96 * 0.2, rtol=1e-5)


def a_range():
    from bokeh.models import Range1d

    return Range1d(start=0.0, end=4.0)


def test_coverage_counts_steps_in_which_the_interval_holds_the_truth():
    """Loss 2 is estimated .5 from half time on with an interval of .392 around it; the truth is .2 then, and 1 in the last quarter."""
    truth = steps([("loss_2", 0.2, 2.0, 3.0), ("loss_2", 1.0, 3.0, np.inf)])
    result = Estimates("log", (made(),), {}, truth)
    assert np.allclose(result.coverage(result.series[0]), [1.0, 0.75, 1.0, 1.0])
    assert np.array_equal(result.true(result.series[0])[[19, 20, 29, 30], 1], [0.0, 0.2, 0.2, 1.0])
    assert Estimates("log", (made(),)).coverage(made()) is None
    one = made()
    ends = {name: (np.array([-1.0]), np.array([end])) for name, end in zip(one.theta_names, one.lower[0])}
    for beyond, share in ((1e-9, 1.0), (-1e-3, 0.0)):
        outside = {name: (time, value + beyond) for name, (time, value) in ends.items()}
        first = replace(one, status=np.where(np.arange(len(one.time)) == 0, 0, 2))
        assert np.allclose(Estimates("log", (first,), {}, outside).coverage(first), share)


def test_truth_files(tmp_path):
    simulated, listed = tmp_path / "a.truth.csv", tmp_path / "list.csv"
    simulated.write_text("time_s,north,loss_1,loss_2\n0,0,0,0\n1,0,0,0.4\n")
    listed.write_text("path,faulty_rotors,thrust_loss,start_s,end_s,faults\nx/a.bin.xz,2,0.4,10,20,2:0.3:10:15;2:0.4:15:20\nb.bin,,0,,,\n")
    assert read_truth(simulated, "a.bin")["loss_2"][1].tolist() == [0.0, 0.4]
    assert read_truth(listed, "a.bin")["loss_2"][0].tolist() == [10.0, 15.0, 20.0] and read_truth(listed, "b.bin") == {}
    for text, says in (("path\n", "needs the columns"), ("time_s,loss_1\n0,x\n", "no number"), (listed.read_text(), "no line for c.bin")):
        (tmp_path / "t.csv").write_text(text)
        with pytest.raises(ConfigError, match=says):
            read_truth(tmp_path / "t.csv", "c.bin")


def test_the_command_prints_and_writes(tmp_path):
    out = tmp_path / "e.csv"
    done = called(FAULTY, "--method", "ekf", "-o", out)
    assert done.exit_code == 0 and "ekf on rate dynamics" in done.output and "loss 6" in done.output and out.exists()
    said = json.loads(called(FAULTY, "--method", "ekf", "--json", "--quiet").output)
    assert said["schema"] == 1 and len(said["methods"][0]["series"]["loss_6"]) == len(out.read_text().splitlines()) - 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((FAULTY,), "Name a method; known are "),
        ((FAULTY, "--method", "nonsense"), "no estimator called 'nonsense'"),
        ((FAULTY, "--method", "ekf", "--method", "ekf"), "ekf is named twice"),
        ((FAULTY, "--method", "ekf", "-o", "x.xlsx"), "give a name that ends in .csv"),
        ((FAULTY, "--method", "ekf", "--truth", "none.csv"), "Cannot read the truth none.csv"),
        ((FAULTY, "--method", "ekf", "--airframe", "f450"), "no helicopter called 'f450'"),
        ((FAULTY, "--method", "ekf", "--airframe", "none.toml"), "Cannot read the airframe file none.toml"),
        (("none.bin", "--method", "ekf"), "none.bin"),
    ],
)
def test_what_is_wrong_is_one_sentence(arguments, says):
    said = called(*arguments)
    assert isinstance(said, str) and says in said and said.count(". ") <= 1 and "\n" not in said


def test_a_log_without_a_flight_is_refused():
    t = np.arange(0.0, 20.0, 0.02)
    still = {"time_s": t, **{f"motor_{k}": np.zeros(len(t)) for k in range(1, 5)}, **{f"gyro_{a}_rad_s": 0 * t for a in "xyz"}}
    with pytest.raises(LogError, match="never in the air"):
        rw.estimate(log_memory.from_arrays(still, parameters={"MAV_TYPE": 2}, autopilot="PX4"), "ekf")


def test_diagnose_names_the_method_and_shows_its_own_estimate():
    found = by_ekf()
    event = found.events[found.main]
    assert found.headline.startswith("ekf: ") and "ekf itself estimated" in found.headline and "by its covariance" in found.headline
    low, high = event.extra["own_interval"][0]
    row = found.own.at(event.extra["own_at_s"])
    assert found.own.lower[row, event.rotors[0] - 1] == low and found.own.upper[row, event.rotors[0] - 1] == high
    said = json.loads(found.to_json())["own_estimate"]
    assert said["method"] == "ekf" and said["says"] == INTERVAL and len(said["series"]["time_s"]) <= 1001
    usual = rw.diagnose(FAULTY)
    assert usual.own is None and "own_estimate" not in usual.to_dict() and not usual.headline.startswith("default")


def test_the_report_of_another_method_says_who_found_it():
    from rotorwatch.report import html
    from rotorwatch.report.sections import other_checks, rotor_table

    pytest.importorskip("bokeh")
    found = by_ekf()
    assert other_checks.rows(found)[0][0] == "ekf" and "decision stage common to all methods" in rotor_table.scope(found)
    text = html.page(found)
    assert "ekf itself" in text and 'id="plot-own_loss"' in text and "1.96 standard deviations of ekf" in text


@functools.cache
def numbered():
    """The sample's vehicle, with the mass, arm and inertias that make the paper's plant the one that its log teaches."""
    ready = prepare(rw.read(FAULTY))
    B = ready.vehicle.effectiveness()
    J = np.diag(log_plant.hops(ready.table, B)[0].parameters["J"])
    mass, n = 2.0, B.shape[1]
    reach = max(np.hypot(r.x, r.y) for r in ready.vehicle.rotors) / max(max(abs(r.x), abs(r.y)) for r in ready.vehicle.rotors)
    yaw = log_plant.hops(ready.table, B)[0].parameters["B_tau"][2, 0] / B[2, 0]
    extra = {"mass_kg": mass, "arm_m": 0.3 * reach, "drag_ratio_m": 0.3 * yaw, "inertia_kg_m2": list(0.3 * mass * G0 / n * J)}
    return replace(ready.vehicle, extra=extra)


def test_the_papers_plants_turn_as_the_logs_plant_does():
    """With the inertias that the log's gains stand for, any commands and losses turn and lift all four plants as they do rate dynamics."""
    ready = prepare(rw.read(FAULTY))
    B = ready.vehicle.effectiveness()
    hop = log_plant.hops(ready.table, B)[0]
    still = {"damping": np.zeros(3), "tau_0": np.zeros(3), "F_0": np.array(0.0), "m": np.array(6 / G0)}
    hop = replace(hop, parameters={**hop.parameters, **still})
    known, seen = paper_log.numbers(numbered()), paper_log._seen(ready.flight, hop, ready.table.time[hop.rows])
    u, theta = np.array([1.1, 0.9, 1.0, 1.05, 0.95, 1.02]), np.array([0.0, 0.3, 0.0, 0.0, 0.1, 0.0])
    turn, f_z = hop.system.derivative(np.zeros(3), u, theta), hop.system.h(np.zeros(3), u, theta)[3]
    rates, attitude, hover, body = (paper_log.PLANTS[name](known, hop, seen)[0] for name in ("mhe", "axkf", "intermediate", "tsukf"))
    assert np.allclose(rates.derivative(np.zeros(3), u, theta), turn, rtol=1e-9)
    assert np.allclose(np.asarray(attitude.derivative(np.zeros(6), u, theta))[3:] / known.J, turn, rtol=1e-9)
    assert np.allclose(hover.B @ (u * (1 - theta)), [*turn, f_z], rtol=1e-9)
    assert np.allclose(np.asarray(body.derivative(np.zeros(12), u, theta))[8:], [f_z + G0, *turn], rtol=1e-9)
    assert np.isclose(rates.h(np.zeros(3), u, theta)[3], f_z)


def test_a_papers_plant_runs_on_a_log_beside_rate_dynamics():
    """The sample's rotor 3 loses 37 %: on the plant of its paper the intermediate observer has that rotor worst by far."""
    found = rw.estimate(FAULTY, "intermediate", vehicle=numbered(), plant="both")
    assert [s.plant for s in found.series] == ["rate_dynamics", "linear_hover (of the paper)"]
    for s in found.series:
        late = s.theta[(s.time > 60.0) & (s.time < 100.0)].mean(axis=0)
        assert late.argmax() == 2 and late[2] > 0.15 + np.sort(late)[-2]
        assert np.array_equal(s.time, found.series[0].time)


def test_the_weight_is_carried_and_nothing_turns_with_the_trim():
    known = paper_log.numbers(numbered())
    mean = np.array([1.1, 0.9, 1.0, 1.05, 0.95, 1.02])
    u = mean + paper_log._trim(known, mean)
    assert np.allclose(known.B_tau @ u, 0.0, atol=1e-9) and np.isclose(known.B_T @ u, known.m * G0)


@pytest.mark.parametrize(
    ("change", "method", "says"),
    [
        ({"mass_kg": None}, "tsukf", "needs mass_kg: put it into the vehicle file under"),
        ({"mass_kg": -1.0}, "tsukf", "mass_kg"),
        ({"inertia_kg_m2": [1.0]}, "tsukf", "inertia_kg_m2"),
        ({}, "aesmf", "The paper of aesmf has no multirotor"),
    ],
)
def test_what_a_papers_plant_lacks_is_said(change, method, says):
    vehicle = numbered()
    extra = {k: v for k, v in {**vehicle.extra, **change}.items() if v is not None}
    with pytest.raises(ConfigError, match=says):
        rw.estimate(FAULTY, method, vehicle=replace(vehicle, extra=extra), plant="paper")


def test_euler_angles_go_on_beyond_a_turn():
    yaw = np.linspace(0.0, 9.0, 50)
    q = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)
    assert np.allclose(paper_log._euler(q), np.stack([0 * yaw, 0 * yaw, yaw], axis=1), atol=1e-12)


def test_an_airframe_file_of_ones_own(tmp_path):
    file = tmp_path / "own.toml"
    text = (Path(rw.__file__).parent / "airframes/papers/ruav-40kg.toml").read_text()
    file.write_text(text)
    assert helicopter_log.method("ekf", str(file), 0.02).system.m == 40.0
    for old, new, says in (("mass = ", "weight = ", "airframe lacks mass"), ("hub_stiffness = ", 'hub_stiffness = "soft" #', "no number")):
        file.write_text(text.replace(old, new, 1))
        with pytest.raises(ConfigError, match=says):
            helicopter_log.method("ekf", str(file), 0.02)


def test_a_page_of_sets_says_what_they_neglect():
    system = rw.systems.RateDynamics.of(rw.airframes.paper("niermeyer-hexa"))
    said = " ".join(helicopter_log.notes(rw.estimators.ESMF(system, 0.05)))
    assert "neglect the remainder of the linearisation" in said and "guarantee nothing" in said
    assert "neglect" not in " ".join(helicopter_log.notes(rw.estimators.EKF(system, 0.05)))


def test_the_pages_tables_are_made_of_the_data():
    made = loaded(ROOT / "docs/make_estimates.py")
    data = json.loads(made.DATA.read_text())
    assert made.PAGE.read_text().endswith(made.page(data))
    assert {method for row in data["flights"] for method in row["methods"]} >= set(made.METHODS)
    assert all((ROOT / "docs" / f"estimate-{k}.png").exists() for k in range(1, len(data["drawn"]) + 1))
