"""One table for all estimators: what is counted, how flights are made, and the command."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from rotorwatch import airframes, diagnose
from rotorwatch.case.conductor import Case
from rotorwatch.commands import cli
from rotorwatch.engine.bindings import program
from rotorwatch.engine.motion.tick_table import ASSESS
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Event
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.experiments.studies import compare as study
from rotorwatch_lab.experiments.studies import compare_flights
from rotorwatch_lab.published import published


@pytest.fixture(scope="module")
def quads():
    """Two short simulated quads: healthy, and rotor with a loss of 0.4."""
    patch = pytest.MonkeyPatch()
    patch.setattr(compare_flights, "SECONDS", 27.0)
    patch.setattr(compare_flights, "AIRFRAMES", ("ardupilot-quad-x",))
    scenes = compare_flights.simulated(1, (0.4,))
    patch.undo()
    return scenes


def test_simulated_flights_fly_and_hold_the_truth(quads):
    healthy, faulty = quads
    assert healthy.faults == () and len(faulty.faults) == 1 and faulty.group == "simulated quad-x"
    ((rotor, onset, loss),) = faulty.faults
    t = faulty.ticks
    assert (t.mode == ASSESS).sum() * t.dt > 10 and not t.upset.any() and loss == 0.4
    after = (t.time > onset + 2.0) & (t.mode == ASSESS)
    # The controller makes up for the loss: the others as before, the faulty rotor 1 / (1 - 0.4) times as much.
    others = np.delete(t.thrust[after].mean(axis=0), rotor - 1)
    assert abs(t.thrust[after, rotor - 1].mean() * 0.6 / others.mean() - 1.0) < 0.05
    assert abs(t.load[after].mean() - 1.0) < 0.02 and 0.05 < t.rate[after].std(axis=0)[:2].min() < 1.0


def test_simulation_is_the_same_for_the_same_seed():
    vehicle = airframes.named("ardupilot-hexa-x")
    patch = pytest.MonkeyPatch()
    patch.setattr(compare_flights, "SECONDS", 2.0)
    one, other = (compare_flights.simulate(vehicle, [0.0], np.array([0]), np.array([9.0]), np.random.default_rng(s))[0] for s in (1, 1))
    patch.undo()
    for name, signal in one.signals.items():
        np.testing.assert_array_equal(signal.values, other[name].values, err_msg=name)


def event(rotors, detected, loss=0.4, alternatives=(), onset=None):
    return Event(
        "loss_of_effectiveness", rotors, detected if onset is None else onset, detected, None, (loss,) * len(rotors),
        ((loss - 0.05, loss + 0.05),) * len(rotors), 1.0, alternatives,
    )  # fmt: skip


@pytest.fixture
def assessed(quads, monkeypatch):
    """trial(events, theta of the faulty rotor): what is made of that in the faulty scene."""
    scene = quads[1]

    def trial(found, theta=0.4, which=scene):
        shown = np.zeros(which.ticks.thrust.shape)
        if which.faults:
            shown[:, which.faults[0][0] - 1] = theta
        out = program.TickOutput(*[shown] * len(program.TickOutput._fields))
        monkeypatch.setattr(published, "assess", lambda *a, **k: (out, None))
        said = SimpleNamespace(end=SimpleNamespace(events=tuple(found)))
        monkeypatch.setattr(Case, "by", lambda self, done: SimpleNamespace(answer=lambda: said))
        return study._trial("ekf", which)

    return trial


def test_what_counts(quads, assessed):
    ((rotor, onset, _),) = quads[1].faults
    other = rotor % 4 + 1
    good = assessed([event((rotor,), onset + 0.5)])
    assert good["right"] and good["named"] and good["covered"] and good["false_alarms"] == 0
    assert abs(good["delay_s"] - 0.5) < 1e-9 and good["square"] < 1e-12
    assert assessed([], theta=0.0)["square"] == pytest.approx(0.16)
    wrong = assessed([event((other,), onset + 0.5)])
    assert "right" not in wrong and wrong["false_alarms"] == 1
    late = assessed([event((other,), onset + 0.5), event((rotor,), onset + 2.0)])
    assert not late["right"] and late["named"] and late["false_alarms"] == 1 and abs(late["delay_s"] - 2.0) < 1e-9
    early = assessed([event((rotor,), onset - 3.0)])
    assert "delay_s" not in early and early["false_alarms"] == 1
    unsure = assessed([event((other,), onset + 1.0, alternatives=((rotor,),))])
    assert not unsure["right"] and unsure["named"] and unsure["false_alarms"] == 0
    off = assessed([event((rotor,), onset + 0.5, loss=0.2)])
    assert off["right"] and not off["covered"]
    assert assessed([event((1,), 15.0)], which=quads[0])["false_alarms"] == 1


def test_errors_are_compared_block_by_block(quads, assessed):
    """The seconds before an onset and the settled ones after it, in blocks; a constant error of one rotor of four is a quarter of it."""
    ((_, onset, _),) = quads[1].faults
    exact, late = assessed([])["blocks"], assessed([], theta=0.3)["blocks"]
    assert len(exact) == len(late) >= 4 and onset + study.SETTLED_S < quads[1].ticks.time[-1]
    assert exact[-1] == pytest.approx(0.0, abs=1e-12) and late[-1] == pytest.approx(0.025)
    assert exact[0] == pytest.approx(0.1)  # 0.4 is shown from the start


def test_the_paired_test_is_wilcoxons():
    rng = np.random.default_rng(0)
    first = rng.uniform(0.0, 0.1, 30)
    assert study.paired(first, 1.1 * first) == pytest.approx(2.0**-29)
    chance = [study.paired(first, first + 0.01 * rng.standard_normal(30)) for _ in range(200)]
    assert 0.01 <= np.mean(np.array(chance, float) < 0.05) <= 0.1
    assert study.paired(first, first) == 1.0 and study.paired(first[:5], first[:5] + 1) is None is study.paired(first, first[:9])


def test_the_better_one_is_first_and_the_others_have_a_p(quads):
    def row(rmse):
        return study._row([{"assessed_s": 60.0, "fault": True, "false_alarms": 0, "square": rmse**2}])

    group, errors = quads[0].group, np.linspace(0.01, 0.02, 12)
    found = [
        study.Compared(name, {group: row(rmse)}, 1.0, "", {group: list(errors * rmse)}) for name, rmse in (("plain", 0.2), ("mine_1", 0.1))
    ]
    result = study.gathered(quads, found)
    p = {name: one["p"] for name, one in result["groups"][group].items()}
    assert p["mine_1"] is None and p["plain"] < 0.001 and "| `plain` | 0.200 | < 0.001 |" in study.markdown(result)
    text = study.markdown(result, tools.latex)
    assert "\\texttt{mine\\_1} & 0.100 & - &" in text and text.count("\\\\\n") == 3 and "\\begin{tabular}{lrrrrrrrr}" in text
    assert all(line.startswith("%") for line in text.splitlines() if "flights" in line or "Simulated" in line)


def test_losses_over_time_are_the_truth_of_a_single_log(tmp_path):
    sample = next(iter(sorted(cli.SAMPLES.glob("hexax_m3*.bin.xz"))))
    truth = tmp_path / "hexa.truth.csv"
    truth.write_text("time_s,loss_1,loss_3\n0,0,0\n40,0,0\n47.6,0,0.368\n90,0,0.368\n")
    (scene,) = compare_flights.with_truth([sample], truth)
    assert scene.faults == ((3, 47.6, 0.368),)
    truth.write_text("time_s,loss_3\n0,0\n40,0.1\n47.6,0.368\n")
    with pytest.raises(ConfigError, match="loss_3 changes on the way"):
        compare_flights.with_truth([sample], truth)


def test_rows_add_up():
    hour = {"assessed_s": 1800.0}
    trials = [
        hour | {"fault": True, "false_alarms": 1, "square": 0.01, "delay_s": 1.0, "right": True, "named": True, "covered": True},
        hour | {"fault": True, "false_alarms": 0, "square": 0.16},
        hour | {"fault": False, "false_alarms": 2},
        hour | {"fault": True, "false_alarms": 0, "square": 0.01, "delay_s": 3.0, "right": False, "named": True, "covered": False},
    ]
    row = study._row(trials)
    assert row["flights"] == 4 and row["faults"] == 3 and row["false_alarms"] == 3
    assert row["loss_rmse"] == pytest.approx(np.sqrt(0.06)) and row["delay_s"] == 2.0
    assert row["right"] == pytest.approx(1 / 3) and row["named"] == pytest.approx(2 / 3)
    assert row["coverage"] == 0.5 and row["false_alarms_h"] == pytest.approx(1.5)
    empty = study._row([hour | {"fault": False, "false_alarms": 0}])
    assert empty["loss_rmse"] is None and empty["right"] is None


def test_a_method_and_the_default_in_one_table(quads, monkeypatch):
    monkeypatch.setattr(study, "STEPS", 256)
    result = study.compare(quads, ["default", "ekf"])
    rows = result["groups"]["simulated quad-x"]
    assert set(rows) == {"default", "ekf"} and result["failed"] == {}
    for name, row in rows.items():
        assert row["right"] == 1.0 and row["loss_rmse"] < 0.2 and row["false_alarms"] == 0, name
        assert 0.0 <= row["delay_s"] < 3.0
    assert 0.5 < result["us_per_step"]["ekf"] < 1e4
    text = study.markdown(result)
    assert "## Simulated quad-x" in text and "| `ekf` |" in text and "| `default` |" in text
    json.dumps(result, allow_nan=False)


def test_methods_that_cannot_run_say_why(quads, monkeypatch):
    def refuse(*a, **k):
        raise ConfigError("needs a helicopter.")

    monkeypatch.setattr(published, "assess", refuse)
    result = study.compare(quads, ["ekf"])
    assert result["failed"] == {"ekf": "needs a helicopter."}
    assert "`ekf`: needs a helicopter." in study.markdown(result)


def test_bad_requests_get_one_sentence(quads, tmp_path):
    with pytest.raises(ConfigError, match="no flight"):
        study.compare([])
    with pytest.raises(ConfigError, match="no estimator called"):
        study.compare(quads, ["crystal ball"])
    table = tmp_path / "truth.csv"
    table.write_text("path,rotor\na.bin,1\n")
    with pytest.raises(ConfigError, match="columns path"):
        compare_flights.with_truth([], table)
    for arguments in (["--losses", "x"], ["--losses", "0"], ["--losses", "1.2"]):
        done = CliRunner().invoke(cli.cli, ["compare", *arguments])
        assert isinstance(done.exception, ConfigError) and "--losses" in str(done.exception)


def test_truth_tables_choose_the_logs(tmp_path):
    sample = next(iter(sorted(cli.SAMPLES.glob("hexax_m3*.bin.xz"))))
    table = tmp_path / "truth.csv"
    table.write_text(f"path,faulty_rotors,thrust_loss,start_s\nelsewhere/{sample.name},3,0.368,47.6\n")
    (scene,) = compare_flights.with_truth([sample, tmp_path / "unlisted.bin"], table)
    assert scene.faults == ((3, 47.6, 0.368),) and scene.B.shape == (4, 6)


def test_the_command(monkeypatch):
    monkeypatch.setattr(compare_flights, "simulated", lambda *a: [])
    monkeypatch.setattr(study, "each", lambda scenes, names: iter([study.Compared(name, {}, 1.0) for name in names]))
    done = CliRunner().invoke(cli.cli, ["compare", "--json", "--estimators", "ekf, ukf"])
    assert done.exit_code == 0 and json.loads(done.stdout)["us_per_step"] == {"ekf": 1.0, "ukf": 1.0}
    done = CliRunner().invoke(cli.cli, ["compare", "--json", "--method", "ekf"])
    assert list(json.loads(done.stdout)["us_per_step"]) == ["default", *study.PAPERS, "ekf"]


def test_diagnose_by_name_says_what_it_assumes():
    sample = next(iter(sorted(cli.SAMPLES.glob("quadx_healthy*.bin.xz"))))
    diagnosis = diagnose(sample, estimator="ekf")
    assert diagnosis.verdict == "healthy" and diagnosis.estimator == "ekf"
    assert any("as published" in said for said in diagnosis.assumptions)
    with pytest.raises(ConfigError, match="learns its noise in flight"):
        diagnose(sample, tuning=published.Tuning())


@pytest.mark.parametrize(
    "arguments",
    [
        ["compare", "--estimators", "own_of_{}:Half"],
        ["tune", "--estimator", "own_of_{}:Half", str(cli.SAMPLES)],
        ["estimate", "--airframe", "ruav-40kg", "--estimator", "own_of_{}:Half", "flight.csv"],
        ["diagnose", "--estimator", "own_of_{}:Half", str(next(iter(sorted(cli.SAMPLES.glob("quadx_healthy*")))))],
    ],
    ids=lambda arguments: arguments[0],
)
def test_an_estimator_may_lie_in_the_current_folder(arguments, tmp_path, monkeypatch):
    module = f"own_of_{arguments[0]}"  # a module is imported once in a process
    (tmp_path / f"{module}.py").write_text("class Half:\n    name = 'half'\n    def init(self): ...\n")
    (tmp_path / "flight.csv").write_text("time_s,motor_1\n0,0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    done = CliRunner().invoke(cli.cli, [text.format(arguments[0]) for text in arguments])
    assert isinstance(done.exception, ConfigError) and "step" in str(done.exception), done.exception


def test_what_is_through_is_printed_when_it_is_interrupted(quads, monkeypatch):
    """Before anything runs the names are said; each estimator as soon as it is through; Ctrl-C ends with those."""

    def each(scenes, names, progress=None):
        row = study._row([{"assessed_s": 60.0, "fault": False, "false_alarms": 1}])
        yield study.Compared("default", {scenes[0].group: row}, 3.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "each", each)
    monkeypatch.setattr(compare_flights, "simulated", lambda *a: quads)
    done = CliRunner().invoke(cli.cli, ["compare", "--seeds", "1", "--estimators", "default,ekf"])
    said = done.stderr.splitlines()
    assert "2 estimators, one after the other: default, ekf" in said[0] and "flights for each" in said[1]
    assert said[2].startswith("1 of 2, default: ") and "false alarms 1" in said[2]
    assert "| `default` |" in done.stdout and "Interrupted: ekf did not run." in done.stdout and done.exit_code != 0
    result = CliRunner().invoke(cli.cli, ["compare", "--seeds", "1", "--estimators", "default,ekf", "--json", "-q"])
    assert json.loads(result.stdout)["missing"] == ["ekf"]
