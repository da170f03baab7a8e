"""The benchmark: fixed plans, thresholds set on healthy time, results files that hold together, rankings, public data by path."""

import copy
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import binomtest

from rotorwatch.base.optional import tomllib
from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import batch, benchmark, benchmark_plan, public_data, ranking, results_file, score, summary

pytest.importorskip("pyarrow")
ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "rotorwatch-two-methods"
SAMPLES = ROOT / "src" / "rotorwatch" / "samples"
FIXED = {
    ("quick", 1): "5e443ead679b4bbd9074b856c857a6e7e687c9902844066110cb090cbacde90b",
    ("full", 1): "cbcf426a9e351ee38f4a89f4a43f199dc0c7ae31ec80abf05fa7a0c4afdebc0e",
}
SMALL = """
healthy = 0.5
[benchmark]
version = 1
flights = 4
false_alarms_h = 6.0
within_s = 5.0
[scenario]
duration_s = 40.0
[scenario.airframe]
frame = "quad-x"
[[faults]]
kind = "loss"
onset_s = 25.0
strength = 0.3
"""


# ---------------------------------------------------------------- plans


def test_a_plan_that_was_published_stays_as_it_is():
    """Whoever changes one gives it a new version, and adds that here: results of the old one are not comparable."""
    assert {(n, (b := benchmark.read(n)).version): b.sha256 for n in benchmark.shipped()} == FIXED


def test_flights_can_be_taken_away(tmp_path):
    """Every flight of the plan with what is true of it, under hashes; the log is the one that is assessed."""
    plan = benchmark_plan.parsed(SMALL.replace("flights = 4", "flights = 2"), "small")
    written = benchmark.export(plan, tmp_path / "flights")
    names = [f"{number}{ending}" for number in ("00000", "00001") for ending in (".bin", ".truth.csv")]
    assert [path.name for path in written] == [*names, "plan.toml", "SHA256SUMS"]
    lines = dict(line.split("  ")[::-1] for line in written[-1].read_text().splitlines())
    assert lines == {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in written[:-1]}
    assert benchmark_plan.parsed((tmp_path / "flights" / "plan.toml").read_text(), "small").sha256 == plan.sha256
    flights = batch.simulated(plan.plan, range(2), batch.width())
    for (number, scenario, flown, record), log in zip(flights, (written[0], written[2]), strict=True):
        assert log.read_bytes() == batch.logbook.log(scenario, flown, record), number
    with pytest.raises(ConfigError, match="give a new folder"):
        benchmark.export(plan, tmp_path / "flights")
    done = CliRunner().invoke(cli.cli, ["benchmark", "quick", "--export", str(tmp_path / "x"), "--methods", "ekf"])
    assert done.exit_code == 2 and "--export takes a plan alone" in done.stderr


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[benchmark]", "[bench]"), r"has no table \[benchmark\]"),
        (("version = 1", ""), "benchmark.version is missing"),
        (("version = 1", "version = 1\nhours = 3"), "benchmark.hours is not a field"),
        (("version = 1", "version = 0"), "benchmark.version must lie between"),
        (("within_s = 5.0", "within_s = 0.55"), "benchmark.within_s must be one of 0.1, 0.2"),
        (("flights = 4", "flights = 2.5"), "benchmark.flights must be a whole number"),
        (('"quad-x"', '"f450"'), "scenario.airframe.frame"),
    ],
)
def test_a_plan_that_is_wrong_is_named_by_field(tmp_path, change, says):
    path = tmp_path / "small.toml"
    path.write_text(SMALL.replace(*change))
    with pytest.raises(ConfigError, match=says):
        benchmark.read(path)
    with pytest.raises(ConfigError, match="There is no benchmark nonsense: give full or quick, or the file of a plan"):
        benchmark.read("nonsense")


# ---------------------------------------------------------------- scores


def columns(rows):
    full = [
        dict.fromkeys(score.COLUMNS) | {"flight": k, "method": "x", "fault": "", "clear": False, "false_alarms": 0} | row
        for k, row in enumerate(rows)
    ]
    return {key: summary.column([row[key] for row in full], kind) for key, (kind, _) in score.COLUMNS.items()}


def fault(rise):
    """A clear fault whose statistic reaches `rise[t]` at t seconds after the onset."""
    kept = {f"peak_{s:g}s": max([v for t, v in rise.items() if t <= s], default=-50.0) for s in score.RISE_S}
    return {"fault": "loss", "clear": True, "peak": -50.0, "healthy_s": 0.0, **kept}


def test_the_threshold_leaves_so_many_false_alarms_and_no_more():
    healthy = [{"peak": float(p), "healthy_s": 360.0} for p in range(-10, 0)]  # an hour in ten flights
    faults = [fault({0.5: -2.5, 3.0: 4.0}), fault({2.0: -2.5}), fault({8.0: 1.0}), fault({0.4: -3.5})]
    found = summary.at_rate(columns([*healthy, *faults]), 2.0, 5.0)
    assert found["threshold"] == -3.0 and found["false_alarms_h"]["n"] == 2  # -1 and -2 are left
    assert found["detected"]["value"] == 0.5 and found["delay_s"]["value"] == pytest.approx(np.median([0.5, 2.0]))
    wilson = summary.share(np.array([True, True, False, False]))
    assert found["detected"]["low"] <= wilson["low"] and found["detected"]["high"] >= wilson["high"]
    strict = summary.at_rate(columns([*healthy, *faults]), 0.5, 5.0)
    assert strict["threshold"] == -1.0 and strict["detected"]["value"] == 0.25 and strict["delay_s"]["value"] == 3.0
    lax = summary.at_rate(columns([*healthy, *faults]), 1e4, 10.0)
    assert lax["threshold"] == score.NOTHING and lax["detected"]["value"] == 1.0


def test_a_rule_keeps_its_own_threshold_and_without_healthy_time_nothing_is_said():
    rule = [{"healthy_s": 1800.0, "false_alarms": 2}, {"fault": "loss", "clear": True, "delay_s": 3.0, "healthy_s": 0.0}]
    found = summary.at_rate(columns([*rule, {**rule[1], "delay_s": 7.0}]), 1.0, 5.0)
    assert found["threshold"] is None and found["false_alarms_h"]["value"] == 4.0
    assert found["detected"]["value"] == 0.5 and found["delay_s"]["value"] == 3.0
    nothing = dict.fromkeys(("threshold", "false_alarms_h", "detected", "delay_s"))
    assert summary.at_rate(columns([fault({1.0: 2.0})]), 1.0) == {**nothing, "found": []}


def test_intervals_of_a_threshold_from_few_flights_are_wider_than_those_of_the_share():
    """The threshold is a number from the sample, too: in another sample it would have been another."""
    rng = np.random.default_rng(0)
    healthy = [{"peak": float(p), "healthy_s": 60.0} for p in 4.0 * rng.standard_normal(20)]
    faults = [fault({0.5: float(v)}) for v in 4.0 + 2.0 * rng.standard_normal(400)]
    found = summary.at_rate(columns([*healthy, *faults]), 3.0)["detected"]
    alone = summary.share(np.arange(400) < 400 * found["value"])
    assert found["high"] - found["low"] > 2.0 * (alone["high"] - alone["low"])


# ---------------------------------------------------------------- results files


def made(name="one", found=0.8, plan=None, **more):
    """Results of one method, as they would be written."""
    text = SMALL if plan is None else plan
    value = {"value": 0.5, "low": 0.25, "high": 1.0, "n": 10}
    scores = dict.fromkeys(results_file.MEASURES, value) | {"flights": 4, "clear_faults": 2, "healthy_h": 0.1, "threshold": -1.0}
    scores |= {"detected": {"value": found, "low": found - 0.1, "high": found + 0.1, "n": 10}, **more}
    method = {
        "name": name, "kind": "estimator", "about": "A <method>", "package": "somewhere", "version": "1.0", "path": "a:B", "failed": None,
        "scores": scores,
    }  # fmt: skip
    return {
        "format": "rotorwatch-benchmark", "format_version": 1, "rotorwatch": "0.1.0", "machine": "a machine",
        "plan": {"name": "small", "version": 1, "sha256": benchmark_plan.digest(text), "flights": 4, "false_alarms_h": 6.0, "within_s": 5.0,
                 "text": text},
        "methods": [method], "data": [],
    }  # fmt: skip


def changed(where, value, start=None):
    """Results with one field changed; value ...: left out."""
    results = copy.deepcopy(start or made())
    at = results
    for step in where[:-1]:
        at = at[step]
    if value is ...:
        del at[where[-1]]
    else:
        at[where[-1]] = value
    return results


QUICK = (benchmark_plan.SHIPPED / "quick.toml").read_text()


@pytest.mark.parametrize(
    ("results", "says"),
    [
        ([], 'holds no results of a benchmark: "format" is not'),
        (changed(["format"], "x"), 'holds no results of a benchmark: "format" is not'),
        (changed(["format_version"], 2), "has format version 2, this rotorwatch reads 1: update rotorwatch"),
        (changed(["format_version"], 0), "has format version 0, this rotorwatch reads 1: run the benchmark again"),
        (changed(["machine"], ...), "machine is missing"),
        (changed(["plan", "sha256"], ...), "plan.sha256 is missing"),
        (changed(["plan", "text"], SMALL + "# easier\n"), "its plan was edited after the run"),
        (changed(["plan", "name"], "quick"), "its plan calls itself quick version 1 and is not the one of rotorwatch"),
        (changed(["methods", 0, "package"], ...), r"methods\[1\].package is missing"),
        (changed(["methods", 0, "scores"], None), r"methods\[1\].scores is missing, and failed does not say why"),
        (changed(["methods", 0, "scores", "detected"], ...), r"methods\[1\].scores.detected is missing"),
        (changed(["methods", 0, "scores", "detected", "low"], 0.99), r"scores.detected must hold value, low and high"),
        (changed(["methods", 0, "scores", "delay_s"], 3.0), r"scores.delay_s must hold value, low and high"),
        (changed(["methods", 0, "scores", "threshold"], "x"), "scores.threshold must be a number or null"),
        (changed(["methods", 0, "scores", "found_flights"], [1, "2"]), "scores.found_flights must be a list of the numbers"),
        (changed(["methods", 0, "scores", "size_errors"], {"1": "x"}), "scores.size_errors must be a table of numbers"),
        (changed(["methods"], [made()["methods"][0]] * 2), "the method one is there twice"),
        (changed(["data"], [{"name": "x"}]), r"data\[1\].index_sha256 is missing"),
        (changed(["methods"], {}), "methods has the wrong type"),
    ],
)  # fmt: skip
def test_a_results_file_that_does_not_hold_together_is_one_sentence(tmp_path, results, says):
    path = tmp_path / "x.json"
    path.write_text(json.dumps(results))
    with pytest.raises(ConfigError, match=says) as why:
        results_file.read(path)
    assert str(why.value).startswith(str(path)) and "\n" not in str(why.value)


def test_what_is_written_is_read(tmp_path):
    results_file.write(made(), tmp_path / "x.json")
    assert results_file.read(tmp_path / "x.json") == made()
    results_file.write(made(plan=QUICK) | {"plan": {**made(plan=QUICK)["plan"], "name": "quick"}}, tmp_path / "x.json")
    (tmp_path / "y.json").write_bytes(b"\xff{")
    with pytest.raises(ConfigError, match=r"y.json holds no results of a benchmark: it is no JSON"):
        results_file.read(tmp_path / "y.json")
    with pytest.raises(ConfigError, match=r"Cannot read the results .*z\.json"):
        results_file.read(tmp_path / "z.json")
    with pytest.raises(ConfigError, match="machine is missing"):
        results_file.write(changed(["machine"], ...), tmp_path / "x.json")


def test_the_schema_in_the_documents_names_every_field():
    page = (ROOT / "docs" / "benchmark.md").read_text()
    for key in (
        *results_file.TOP,
        *results_file.PLAN,
        *results_file.METHOD,
        *results_file.DATA,
        *results_file.MEASURES,
        *results_file.FLIGHTS,
    ):
        assert f"`{key}`" in page, key
    for key in (*results_file.COUNTS, *results_file.NUMBERS, "format", "format_version"):
        assert f"`{key}`" in page, key


# ---------------------------------------------------------------- rankings


def written(folder, **results):
    paths = []
    for name, content in results.items():
        paths.append(folder / f"{name}.json")
        paths[-1].write_text(json.dumps(content))
    return paths


def test_methods_that_flew_the_same_flights_are_compared_in_pairs(tmp_path):
    """What all methods find says nothing about which is better; intervals that overlap hide that one always finds more."""
    first = made("first", 0.83, found_flights=list(range(83)), right_flights=list(range(40)))
    never_better = made("never better", 0.73, found_flights=list(range(73)), right_flights=list(range(40)))
    elsewhere = made("elsewhere", 0.78, found_flights=list(range(10, 88)), right_flights=list(range(5, 46)))
    rows = {row["name"]: row for row in ranking.rank(written(tmp_path, a=first, b=never_better, c=elsewhere))["rows"]}
    assert rows["never better"]["paired"]["detected"] == {"only_first": 10, "only_this": 0, "p": 2 / 2**10}
    assert not rows["never better"]["like_first"] and rows["elsewhere"]["like_first"]
    assert rows["elsewhere"]["paired"]["detected"]["p"] == pytest.approx(binomtest(10, 15).pvalue)
    assert rows["elsewhere"]["paired"]["right"]["p"] == pytest.approx(binomtest(5, 11).pvalue)
    assert rows["never better"]["paired"]["right"] == {"only_first": 0, "only_this": 0, "p": 1.0}


def test_sizes_are_compared_in_the_flights_in_which_both_announced_a_loss():
    """Who announces a hard loss alone is not worse for it."""
    rng = np.random.default_rng(0)
    easy = {str(k): float(e) for k, e in enumerate(0.01 * rng.standard_normal(60))}
    found = summary.closer({**easy, "99": 0.7}, {k: 3.0 * e for k, e in easy.items() if k != "3"})
    assert found["flights"] == 59 and found["this"] == pytest.approx(3.0 * found["first"]) and found["p"] == 2.0 / 2**59
    assert found["first"] == pytest.approx(np.sqrt(np.mean([e**2 for k, e in easy.items() if k != "3"])))
    assert summary.closer({"1": 0.1}, {"1": -0.1})["p"] == 1.0 and summary.closer({"1": 0.1}, {})["flights"] == 0


def test_size_errors_are_of_announced_clear_faults():
    rows = [fault({0.5: 1.0}) | {"estimate": e, "loss": 0.3, "bound_sd": 0.01} for e in (0.28, 0.0, 0.35)]
    rows.append({"peak": 1.0, "healthy_s": 60.0, "estimate": 0.2, "loss": 0.0, "bound_sd": 0.01})
    assert summary.size_errors(columns(rows)) == {"0": -0.02, "2": 0.05}


def test_the_flights_behind_a_share_are_kept():
    rng = np.random.default_rng(0)
    rows = [{"flight": n, "peak": float(p), "healthy_s": 60.0} for n, p in enumerate(rng.standard_normal(20))]
    rows += [fault({0.5: float(v)}) | {"flight": 100 + n} for n, v in enumerate(2.0 * rng.standard_normal(50))]
    found = summary.at_rate(columns(rows), 3.0)
    assert found["found"] == [r["flight"] for r in rows[20:] if r["peak_0.5s"] > found["threshold"]] != []


def test_methods_of_several_files_are_ordered_by_what_they_find(tmp_path):
    many = {"value": 50.0, "low": 20.0, "high": 90.0, "n": 5}
    noisy = {"false_alarms_h": many, "own_false_alarms_h": many}
    failed = changed(["methods", 0, "failed"], "It fails: no reason.", changed(["methods", 0, "scores"], None, made("broken")))
    paths = written(
        tmp_path, a=made("good", 0.8), b=made("bad", 0.3), c=made("better", 0.85), d=made("rule", 0.9, threshold=None, **noisy), e=failed,
    )  # fmt: skip
    ranked = ranking.rank(paths)
    assert [row["name"] for row in ranked["rows"]] == ["better", "good", "bad", "rule"]
    assert [row["like_first"] for row in ranked["rows"]] == [True, True, False, False]
    assert [row["over"] for row in ranked["rows"]] == [False, False, False, True]
    assert [e["name"] for e in ranked["failed"]] == ["broken"]
    done = CliRunner().invoke(cli.cli, ["benchmark", "--rank", *map(str, paths), "-o", str(tmp_path / "page.html")])
    assert done.exit_code == 0, done.output
    assert done.output.index("better") < done.output.index("bad") and "It fails: no reason." in done.output
    page = (tmp_path / "page.html").read_text()
    assert "A &lt;method&gt;" in page and "85 % (75 to 95)" in page and "http" not in page.replace("http://www.w3.org", "")
    assert page.count("<svg") == 4 and benchmark_plan.digest(SMALL) in page


def test_files_of_different_plans_are_not_mixed(tmp_path):
    paths = written(tmp_path, a=made(), b=made(plan=SMALL.replace("0.3", "0.6")))
    with pytest.raises(ConfigError, match=r"a.json is of the plan small version 1 \(\w{8}\) and .*b.json of small version 1 \(\w{8}\)"):
        ranking.rank(paths)
    with pytest.raises(ConfigError, match="There is nothing to rank"):
        ranking.rank([])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["quick"], "give -o FILE.json"),
        (["quick", "-o", "x.txt"], "give a name that ends in .json"),
        (["quick", "full", "-o", "x.json"], "One plan at a time"),
        (["quick", "--method", "ekf", "-o", "x.json"], "write package.module:Class"),
        (["quick", "--methods", "nope", "-o", "x.json"], "There is no method called 'nope'; known are"),
        (["quick", "--methods", "ekf,rotorwatch_lab.estimators.ekf:EKF", "-o", "x.json"], "Two methods call themselves ekf"),
        (["quick", "--data", "crazypad", "-o", "x.json"], "write NAME=PATH"),
        (["quick", "--data", "crazypad=nowhere", "-o", "x.json"], "there is no such folder"),
        (["quick", "--data", "alfa=.", "-o", "x.json"], "fixed-wing"),
        (["--rank", "--methods", "ekf"], "--rank takes results files"),
        (["--rank"], "There is nothing to rank"),
        (["--rank", "x.json", "-o", "x.pdf"], "give a name that ends in .html"),
    ],
)
def test_what_the_command_cannot_do_is_one_sentence(arguments, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(cli.cli, ["benchmark", *arguments])
    assert says in " ".join(f"{done.output} {done.exception}".split())
    assert not list(tmp_path.iterdir())


def test_the_list_says_where_methods_come_from_and_tells_namesakes_apart():
    done = CliRunner().invoke(cli.cli, ["benchmark", "--list", "--json"])
    about = {m["name"]: m for m in json.loads(done.output)["methods"]}
    assert {"ekf", "default", "ardupilot-thrust-loss"} <= set(about)
    assert about["ekf"]["package"] == "rotorwatch" and about["ekf"]["path"] == "rotorwatch_lab.estimators.ekf:EKF"
    assert "Zhang" in about["adaptive_ekf"]["about"] and "Zhang" in about["akf"]["about"]


def test_ctrl_c_says_what_is_kept(tmp_path, monkeypatch):
    def stopped(*_, **__):
        (tmp_path / "x.parts").mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(benchmark, "run", stopped)
    done = CliRunner().invoke(cli.cli, ["benchmark", "quick", "--methods", "ekf", "-o", str(tmp_path / "x.json")])
    assert done.exit_code != 0
    assert "finished flights are kept in" in done.output and "the same command resumes from there" in done.output


# ---------------------------------------------------------------- methods that fail


class Wrong:
    """Says nothing that anybody can use."""

    name, not_kalman = "wrong", "x"

    def __init__(self, system, dt):
        self.system = system

    def init(self):
        return np.zeros(2)

    def step(self, carry, u, y, valid, dt=None):
        return carry, carry


class Grows(Wrong):
    name = "grows"

    def step(self, carry, u, y, valid, dt=None):
        return np.zeros(3), carry


class Breaks(Wrong):
    name = "breaks"

    def __init__(self, system, dt):
        raise RuntimeError("no\nlicence")


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("Wrong", "The estimator wrong of the package test_benchmark returns from step no theta"),
        ("Grows", "returns from step another carry than init makes"),
        ("Breaks", "The estimator breaks of the package test_benchmark fails: RuntimeError: no licence."),
    ],
)
def test_a_method_that_cannot_be_run_is_reported_before_anything_flies(kind, says, tmp_path):
    with pytest.raises(ConfigError, match=says):
        benchmark.run("quick", [f"{__name__}:{kind}"], tmp_path / "x.json")
    assert not list(tmp_path.iterdir())


def test_a_method_that_fails_on_the_way_is_left_out_and_the_others_go_on(tmp_path, monkeypatch):
    methods = tuple(benchmark.selected_methods(["ekf", "akf"]))
    entered = benchmark._entered(benchmark.parsed(SMALL) if hasattr(benchmark, "parsed") else benchmark_plan.parsed(SMALL), methods)
    assess, ran = benchmark.Assessor(str(tmp_path), methods), []

    def rows(plan, flown, size, failed):
        ran.append(plan.estimators)
        if "akf" in plan.estimators:
            failed("akf", FloatingPointError("it\nblew up"))
        return []

    monkeypatch.setattr(batch, "fly", lambda plan, flights, size: list(flights))
    monkeypatch.setattr(batch, "rows", rows)
    assess(entered, (0, 1), 2)
    assess(entered, (2, 3), 2)
    assert ran == [("ekf", "akf"), ("ekf",)]
    assert assess.failed() == {"akf": "The estimator akf of the package rotorwatch 0.1.0 fails: FloatingPointError: it blew up."}


def test_parts_of_other_methods_are_not_mixed_in(tmp_path):
    entered = benchmark._entered(benchmark_plan.parsed(SMALL), benchmark.selected_methods(["ekf"]))
    other = benchmark._entered(benchmark_plan.parsed(SMALL), benchmark.selected_methods(["akf"]))
    (tmp_path / "plan.toml").write_text(other.text)
    with pytest.raises(ConfigError, match="holds parts of a run with another plan or other methods: delete that folder"):
        benchmark._same_run(tmp_path, entered)


# ---------------------------------------------------------------- public data


@pytest.mark.parametrize(
    ("path", "rotors"),
    [
        ("normal_flight/E9_log03", ()),
        ("motor_data/cut_M2_0.5мм_46.5мм/E9_log00", (2,)),
        ("cut_M2_1мм_1мм_45мм_M1_1мм_0.5мм_45.5мм/E9_log05", (1, 2)),
        ("cut_propeller_M3_2mm_2mm_43mm__E8_log03.usd.xz", (3,)),
        ("tape_on_propeller_M1_M3__E9_log00.usd", (1, 3)),
        ("add_weight_W1_near_M3_M4/E8_log00", ()),
        ("add_weight_W1_near_M3_M4/E8_log00.csv", None),  # the same flight again, as a table
        ("README.md", None),
    ],
)
def test_the_index_of_crazypad_knows_its_names(path, rotors):
    index = public_data.shipped()["crazypad"]
    entries = public_data._entries(tomllib.loads(index.read_text()), index)
    entry = next((e for e in entries if e.fits(path)), None)
    assert (None if entry is None else tuple(sorted(entry.rotors))) == rotors


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("about = 'x'", r"has no \[\[logs\]\] tables"),
        ("[[logs]]\npath='*'", r"logs\[1\] must have either healthy = true or rotors"),
        ("[[logs]]\npath='*'\nhealthy=true\nrotors=[1]", "must have either healthy = true or rotors"),
        ("[[logs]]\npath='*'\nrotors=[1]", r"logs\[1\].onset_s is missing; give 0.0"),
        ("[[logs]]\npath='*'\nrotors=[0]\nonset_s=0.0", "rotors must lie between"),
        ("[[logs]]\npath='*'\nrotors=[1]\nonset_s=0.0\nloss=2.0", "loss must lie between 0 and 1"),
        ("[[logs]]\npath='*'\nhealthy=true\nwhen=3", r"logs\[1\].when is not a field"),
        ("[[logs]]\nhealthy=true", "path must be a pattern"),
        ("[[logs]]\npath='no*'\nhealthy=true", "no file in it fits a pattern"),
    ],
)
def test_an_index_that_is_wrong_is_named_by_field(tmp_path, text, says):
    (tmp_path / "rotorwatch-index.toml").write_text(text)
    (tmp_path / "log.bin").write_bytes(b"x")
    with pytest.raises(ConfigError, match=says):
        public_data.read("mine", tmp_path)


def test_logs_with_known_faults_are_scored_as_simulated_flights_are(tmp_path):
    for path in SAMPLES.glob("*.xz"):
        shutil.copy(path, tmp_path)
    (tmp_path / "damaged.bin").write_bytes(b"nothing that flies")
    (tmp_path / "rotorwatch-index.toml").write_text(
        "[[logs]]\npath='*healthy*'\nhealthy=true\n[[logs]]\npath='hexax_m3*.bin'\nrotors=[3]\nonset_s=47.6\nloss=0.37\n"
        "[[logs]]\npath='damaged.bin'\nhealthy=true\n"
    )
    data = public_data.read("mine", tmp_path)
    assert [(p.name, e.rotors) for p, e in data.logs][-2:] == [
        ("hexax_m3_mul0.80_square_wind.bin.xz", (3,)), ("quadx_healthy_hover.bin.xz", ()),
    ]  # fmt: skip
    plan = benchmark._entered(benchmark_plan.parsed(SMALL), benchmark.selected_methods(["default", "px4-esc-current"]))
    rows, left_out = public_data.assess(data, plan)
    assert [log for log, _ in left_out] == ["damaged.bin"] and "damaged.bin" in left_out[0][1]
    assert {(row["method"], row["rotors"]) for row in rows} == {(m, n) for m in ("default", "px4-esc-current") for n in (4, 6)}
    (faulty,) = [row for row in rows if row["fault"] and row["method"] == "default"]
    assert faulty["right"] and faulty["delay_s"] < 2.0 and abs(faulty["estimate"] - 0.37) < 0.08 and faulty["loss"] == 0.37
    (whole,) = [row for row in rows if not row["fault"] and row["method"] == "default"]
    assert whole["false_alarms"] == 0 and whole["healthy_s"] > 60.0


# ---------------------------------------------------------------- the whole of it, with a package from outside


def installed(folder):
    """The example package as an installer leaves it: its modules, and its metadata beside them."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    shutil.copytree(EXAMPLE / "src" / "two_methods", folder / "two_methods")
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = [f"[{g}]\n" + "\n".join(f"{k} = {v}" for k, v in e.items()) for g, e in project["entry-points"].items()]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.thorough
def test_two_methods_of_another_package_are_tried_and_ranked_by_the_real_command(tmp_path):
    site = installed(tmp_path / "site")
    own = "class Quick(FixedGain):\n    'A gain that forgets sooner.'\n    name = 'quick_gain'\n"
    (tmp_path / "beside.py").write_text(f"from two_methods.fixed_gain import FixedGain\n{own}")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(site)])}

    def command(*arguments):
        line = [sys.executable, "-m", "rotorwatch.commands.cli", "benchmark", *arguments]
        done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900)
        assert done.returncode == 0, done.stderr
        return done

    shorter = (ROOT / "src/rotorwatch_lab/campaign/benchmark_plans/quick.toml").read_text()
    (tmp_path / "plan.toml").write_text(shorter.replace("flights = 64", "flights = 7").replace('name = "quick"', 'name = "shorter"'))
    names = "fixed_gain,residual_cusum"
    command("plan.toml", "--methods", names, "--method", "beside:Quick", "-o", "two.json", "--jobs", "1")
    results = results_file.read(tmp_path / "two.json")
    found = {m["name"]: m for m in results["methods"]}
    assert list(found) == ["fixed_gain", "residual_cusum", "quick_gain"]
    assert (found["fixed_gain"]["package"], found["fixed_gain"]["version"]) == ("rotorwatch-two-methods", "1.0.0")
    assert (found["quick_gain"]["package"], found["quick_gain"]["path"]) == ("beside", "beside:Quick")
    for method in found.values():
        scores = method["scores"]
        assert scores["flights"] == 7 and scores["clear_faults"] > 1 and scores["us_per_step"]["value"] > 0.0
        assert scores["detected"]["value"] > 0.3 and scores["right"]["value"] > 0.2, method["name"]  # of few flights
    shown = command("--rank", "two.json", "-o", "page.html").stdout
    assert all(name in shown for name in found)
    assert "rotorwatch-two-methods 1.0.0" in (tmp_path / "page.html").read_text()
