"""Campaigns: plans that are refused by field, folders that survive kills, and statistics of tables whose answer is known."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError
from rotorwatch_lab import campaign
from rotorwatch_lab.campaign import batch, page, score, store, summary, work
from rotorwatch_lab.campaign import plan as plans
from rotorwatch_lab.simulation import scenario

pyarrow = pytest.importorskip("pyarrow")
ROOT = Path(__file__).resolve().parents[1]
TEXT = """
seed = 5
healthy = 0.5
[scenario]
duration_s = 40.0
[scenario.airframe]
frame = { choice = ["quad-x", "hexa-x"] }
mass_kg = { log_uniform = [1.0, 4.0] }
[scenario.wind]
speed_m_s = { uniform = [0.0, 5.0] }
[[faults]]
kind = "loss"
onset_s = 22.0
strength = { uniform = [0.1, 0.4] }
[[faults]]
share = 0.5
kind = "loss"
together = 2
onset_s = 22.0
strength = 0.2
"""


def written(folder, text=TEXT):
    path = folder / "small.toml"
    path.write_text(text)
    return path


def table(changes=()):
    from rotorwatch.base.optional import tomllib

    found = tomllib.loads(TEXT)
    for path, value in changes:
        where = found
        for step in path[:-1]:
            where = where[step] if isinstance(step, int) else where.setdefault(step, {})
        where[path[-1]] = value
    return found


# ---------------------------------------------------------------- plans


def test_flights_follow_from_seed_and_number():
    plan = campaign.from_table(table())
    again = campaign.from_table(table())
    assert [plan.flight(k) for k in (7, 3, 11)] == [again.flight(k) for k in (7, 3, 11)]
    assert plan.flight(3) != campaign.from_table(table([(("seed",), 6)])).flight(3)


def test_draws_are_as_the_plan_says():
    plan = campaign.from_table(table())
    flights = [plan.flight(k) for k in range(400)]
    assert [f.airframe["frame"] for f in flights[:4]] == ["quad-x", "hexa-x"] * 2
    assert plan.rotors == (4, 6)
    mass = np.array([f.airframe["mass_kg"] for f in flights])
    assert mass.min() >= 1.0 and mass.max() <= 4.0 and abs(np.median(mass) - 2.0) < 0.3  # log-uniform
    wind = np.array([f.wind["speed_m_s"] for f in flights])
    assert 0.0 <= wind.min() < 0.3 and 4.7 < wind.max() <= 5.0 and abs(wind.mean() - 2.5) < 0.3
    assert 0.4 < np.mean([not f.faults for f in flights]) < 0.6
    both = [f for f in flights if len(f.faults) == 2]
    assert 0.2 < len(both) / sum(bool(f.faults) for f in flights) < 0.47
    assert all(f.faults[0]["rotor"] != f.faults[1]["rotor"] for f in both)
    broken = {x["rotor"] for f in flights if f.airframe["frame"] == "hexa-x" for x in f.faults}
    assert broken == {1, 2, 3, 4, 5, 6}
    assert len({f.seed for f in flights}) == 400


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ([(("flights",), 3)], "flights is not a field of a plan"),
        ([(("seed",), -1)], "seed must lie between"),
        ([(("healthy",), 1.5)], "healthy must lie between 0 and 1"),
        ([(("estimators",), ["nonsense"])], "estimators: there is no 'nonsense'"),
        ([(("estimators",), [])], "estimators and detectors are both empty"),
        ([(("detectors",), ["nonsense"])], "detectors: there is no 'nonsense'"),
        ([(("decisions",), 3)], r"decisions must be \[\[decisions\]\] tables"),
        ([(("decisions",), [{"sigmas": 3.0}])], r"decisions\[1\].name must be a text"),
        ([(("decisions",), [{"name": "a"}, {"name": "a"}])], r"decisions\[2\].name must be a text that no other"),
        ([(("decisions",), [{"name": "a", "sigma": 3.0}])], r"decisions\[1\].sigma is not a field"),
        ([(("decisions",), [{"name": "a", "least": 2.0}])], r"decisions\[1\].least must lie between 0 and 1"),
        ([(("scenario", "airframe", "frame"), "f450")], "scenario.airframe.frame: ArduPilot has no frame f450"),
        ([(("scenario", "airframe", "frame"), "ruav-40kg")], "scenario.airframe.frame: ruav-40kg is a helicopter"),
        ([(("scenario", "wind", "speed_m_s"), {"uniform": [0.0, 99.0]})], "scenario.wind.speed_m_s must lie between"),
        ([(("scenario", "wind", "speed_m_s"), {"uniform": [5.0, 1.0]})], "scenario.wind.speed_m_s.uniform .* smaller first"),
        ([(("scenario", "wind", "speed_m_s"), {"log_uniform": [0.0, 1.0]})], "speed_m_s.log_uniform must be above zero"),
        ([(("scenario", "wind", "speed_m_s"), {"choice": []})], "scenario.wind.speed_m_s.choice must be a list"),
        ([(("scenario", "wind", "speed_m_s"), {"normal": [1.0, 2.0]})], "scenario.wind.speed_m_s must be a number"),
        ([(("scenario", "wind", "sped"), 1.0)], "scenario.wind.sped is not a field"),
        ([(("scenario", "trajectory", "kind"), {"choice": ["hover", "loop"]})], "trajectory.kind must be one of"),
        ([(("scenario", "duration_s"), {"uniform": [30.0, 60.0]})], "scenario.duration_s must be one value"),
        ([(("scenario", "seed"), 3)], "scenario.seed is each flight's own"),
        ([(("scenario", "faults"), [])], "scenario.faults"),
        ([(("scenario", "airframe", "frame"), {"choice": ["quad-x", "deca-z"]})], "scenario.airframe.frame"),
        ([(("scenario", "airframe", "frame"), {"uniform": [1.0, 2.0]})], "scenario.airframe.frame must be a name"),
        ([(("scenario", "airframe"), {})], "scenario.airframe.frame is missing"),
        ([(("scenario", "wind"), 3.0)], "scenario.wind must be a table"),
        ([(("faults",), [])], "healthy is below 1"),
        ([(("faults", 0, "rotor"), 1)], r"faults\[1\].rotor is drawn anew"),
        ([(("faults", 0, "strength"), {"uniform": [0.1, 2.0]})], r"faults\[1\].strength must lie between"),
        ([(("faults", 1, "together"), 3)], r"faults\[2\].together must lie between 1 and 2"),
        ([(("faults", 0, "onset_s"), 90.0)], r"faults\[1\].onset_s is 90, not before the end"),
        ([(("seed",), 20.5)], "seed must be a whole number, not 20.5"),
        ([(("seed",), int("9" * 400))], "seed must be a number, not 9999"),
        ([(("healthy",), int("9" * 400))], "healthy must be a number, not 9999"),
        ([(("scenario", "rate_hz"), 333.0)], "scenario.rate_hz must be a multiple of 100"),
        ([(("scenario", "wind", "speed_m_s"), {"uniform": [0.0, int("9" * 400)]})], "speed_m_s.uniform must be two numbers"),
        ([(("scenario", "airframe", "payload_kg"), {"choice": [0.0, 9.0]})], "scenario.airframe.payload_kg: .* too much"),
        ([(("scenario", "wind", "speed_m_s"), {"choice": 3})], "scenario.wind.speed_m_s.choice must be a list of values"),
        ([(("faults", 0, "kind"), {"choice": ["loss", "stuck"]})], r"faults\[1\].strength: a stuck has none"),
        ([(("faults", 0, "share"), 0.0)], r"faults\[1\].share must lie between"),
    ],
)  # fmt: skip
def test_bad_plans_are_named_by_field(changes, says):
    with pytest.raises(ConfigError, match=says) as why:
        campaign.from_table(table(changes))
    assert str(why.value).count("\n") == 0


def paths_of(table, above=()):
    """Every place in a table, tables and their rows included."""
    for key, value in table.items() if isinstance(table, dict) else enumerate(table):
        yield (*above, key)
        if isinstance(value, (dict, list)):
            yield from paths_of(value, (*above, key))


DRAW = st.sampled_from(["choice", "uniform", "log_uniform", "x"])
NUMBER = st.floats() | st.integers(-5, 100) | st.booleans()
JUNK = st.recursive(
    st.none() | NUMBER | st.text(max_size=4) | st.sampled_from(["loss", "stuck", "hover", "hexa-x", "f450", "ruav-40kg"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(DRAW, st.lists(inner, max_size=3), max_size=2),
    max_leaves=5,
)


@given(where=st.sampled_from(sorted(paths_of(table()), key=str)), junk=JUNK, add=st.none() | st.text(max_size=3))
@settings(max_examples=trials(150), deadline=None)
def test_junk_anywhere_is_one_sentence_or_a_plan_that_flies(where, junk, add):
    """A value, a draw, a table or a key that does not belong: refused by the name of its part, else every flight can be drawn."""
    try:
        plan = campaign.from_table(table([((*where, add), junk) if add is not None and add_to(where) else (where, junk)]))
    except ConfigError as why:
        text = str(why)
        assert "\n" not in text and len(text) < 600
        assert str(where[0]) in text or "healthy" in text or repr(add) in text or str(add) in text, text
        return
    for k in range(4):
        assert plan.flight(k).duration_s > 0.0


def add_to(where):
    """Whether a place holds a table that a key can be added to."""
    found = table()
    for step in where:
        found = found[step]
    return isinstance(found, dict)


SCENARIO_FIELDS = [
    (part, name)
    for part, fields in scenario.FIELDS.items()
    for name, field in fields.items()
    if field.low < field.high and not field.numbers and (part, name) not in {("", "seed"), ("", "duration_s"), ("", "rate_hz")}
]


@pytest.mark.parametrize(("part", "name"), SCENARIO_FIELDS, ids=[".".join(f) for f in SCENARIO_FIELDS])
def test_draws_beyond_a_field_are_refused_by_its_name(part, name):
    field = scenario.FIELDS[part][name]
    for draw in ({"uniform": [field.low, field.high * 2 + 1]}, {"choice": [field.low, "x"]}, {"uniform": [field.low]}):
        with pytest.raises(ConfigError, match=rf"^scenario\.{part}\.{name}[ .]"):
            campaign.from_table(table([(("scenario", part, name), draw)]))


def test_files_that_are_no_plans(tmp_path):
    with pytest.raises(ConfigError, match=r"Cannot read the plan .*nowhere.toml"):
        campaign.read(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match="not valid TOML"):
        campaign.read(written(tmp_path, "seed = ["))
    with pytest.raises(ConfigError, match=r"small.toml: healthy must"):
        campaign.read(written(tmp_path, "healthy = 3"))


@pytest.mark.parametrize("path", sorted((ROOT / "plans").glob("*.toml")), ids=lambda p: p.stem)
def test_the_plans_that_come_along(path):
    plan = campaign.read(path)
    assert all(plan.flight(k) for k in range(len(plan.cells)))


# ---------------------------------------------------------------- folders

FAKE = '''
import os, sys, time
from pathlib import Path
from rotorwatch import campaign
from rotorwatch_lab.campaign import batch, score, work

def assess(plan, flights, size):
    """Rows that tell one flight from another, slowly."""
    time.sleep(0.12)
    with open(Path(__file__).with_name("assessed.txt"), "a") as file:
        file.write("".join(f"{k}\\n" for k in flights))
    rows = []
    for k in flights:
        s = plan.flight(k)
        row = dict.fromkeys(score.COLUMNS)
        row |= {"flight": k, "method": "default", "frame": s.airframe["frame"], "wind_m_s": s.wind["speed_m_s"], "induced_m_s": 5.0,
                "rotors": 4,
                "assessed_s": 30.0, "healthy_s": 20.0, "fault": "loss" if s.faults else "", "clear": bool(s.faults),
                "false_alarms": 0, "sure_false_alarms": 0, "wrong": 0, "trajectory": "hover", "autopilot": "ardupilot",
                "profile": "default"}
        rows.append(row)
    return rows

if __name__ == "__main__":
    batch.width = lambda: 4
    plan = campaign.read(sys.argv[1])
    work.run(plan, int(sys.argv[3]), sys.argv[2], int(sys.argv[4]), assess=assess)
'''


@pytest.fixture
def fake(tmp_path):
    """Start a campaign with an assess that takes no time to compile: run(folder, flights, jobs) -> process; and what it assessed."""
    script, plan = tmp_path / "fake_campaign.py", written(tmp_path)
    script.write_text(FAKE)

    def start(folder, flights, jobs):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(tmp_path)])}
        command = [sys.executable, str(script), str(plan), str(folder), str(flights), str(jobs)]
        return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)

    def assessed():
        path = tmp_path / "assessed.txt"
        return [int(line) for line in path.read_text().split()] if path.exists() else []

    return start, assessed


def parts(folder):
    return sorted(p.name for p in (folder / "parts").glob("[0-9]*.parquet")) if (folder / "parts").exists() else []


@pytest.mark.thorough
def test_killed_twice_and_the_same_table(fake, tmp_path):
    start, assessed = fake
    rng = np.random.default_rng()
    finished: list[str] = []
    for _ in range(2):
        process = start(tmp_path / "killed", 80, 2)
        until = time.monotonic() + 30
        while len(parts(tmp_path / "killed")) < len(finished) + 2 and time.monotonic() < until:
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.15))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        process.stderr.close()
        time.sleep(0.3)  # the workers see that they are alone
        before = len(assessed())
        time.sleep(0.3)
        assert len(assessed()) == before, "workers outlive a killed campaign"
        now = parts(tmp_path / "killed")
        assert set(finished) <= set(now) and len(now) < 20
        finished = now
    kept = {k for name in finished for k in numbers(name)}
    before = len(assessed())
    for folder, flights, jobs in (("killed", 80, 2), ("whole", 80, 1)):
        process = start(tmp_path / folder, flights, jobs)
        assert process.wait(60) == 0, process.stderr.read()
        process.stderr.close()
        if folder == "killed":
            again = assessed()[before:]
            assert not kept & set(again) and len(again) == len(set(again)) == 80 - len(kept)  # nothing twice, nothing lost
    killed, whole = (store.Folder(tmp_path / name).table() for name in ("killed", "whole"))
    assert killed.num_rows == 80 and killed.equals(whole)


def numbers(name):
    cell, batch, first, last = map(int, store.PART.fullmatch(name).groups())
    return store.Work(cell, batch, first, last).flights(2, 4)


def quick(plan, flights, size):
    rows = []
    for k in flights:
        row = dict.fromkeys(score.COLUMNS) | {"flight": k, "method": "default", "wind_m_s": plan.flight(k).wind["speed_m_s"]}
        rows.append(row)
    return rows


def test_more_flights_add_to_what_is_there(tmp_path, monkeypatch):
    monkeypatch.setattr(work.batch, "width", lambda: 4)
    plan, seen = campaign.read(written(tmp_path)), []

    def assess(plan, flights, size):
        seen.extend(flights)
        return quick(plan, flights, size)

    reported = []
    work.run(plan, 5, tmp_path / "a", 1, assess=assess)
    work.run(plan, 5, tmp_path / "a", 1, assess=assess)
    grown = work.run(plan, 23, tmp_path / "a", 1, lambda *a: reported.append(a), assess)
    assert sorted(seen) == list(range(23))
    assert grown.equals(work.run(plan, 23, tmp_path / "b", 1, assess=assess))
    assert work.run(plan, 7, tmp_path / "a", 1, assess=assess)["flight"].to_pylist() == list(range(7))
    assert reported[0][:2] == (5, 23) and reported[-1][:2] == (23, 23) and reported[-1][2] > 0


def test_an_error_in_a_process_is_reported(fake, tmp_path):
    start, _ = fake
    script = tmp_path / "fake_campaign.py"
    script.write_text(FAKE.replace("    time.sleep(0.12)", "    raise ValueError('planted')"))
    process = start(tmp_path / "broken", 40, 2)
    said = process.communicate(timeout=60)[1].decode()
    assert process.returncode != 0 and "ValueError" in said and "planted" in said


def test_folders_of_other_campaigns_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(work.batch, "width", lambda: 4)
    plan = campaign.read(written(tmp_path))
    work.run(plan, 2, tmp_path / "a", 1, assess=quick)
    other = campaign.read(written(tmp_path, TEXT.replace("seed = 5", "seed = 6")))
    with pytest.raises(ConfigError, match="another plan"):
        work.run(other, 2, tmp_path / "a", 1, assess=quick)
    monkeypatch.setattr(work, "__version__", "9.9")
    with pytest.raises(ConfigError, match=r"begun with rotorwatch .* this is 9.9"):
        work.run(plan, 2, tmp_path / "a", 1, assess=quick)
    monkeypatch.undo()
    monkeypatch.setattr(work.methods, "engine", lambda: "other")
    with pytest.raises(ConfigError, match=r"begun with (native|jax) code, here is other"):
        work.run(plan, 2, tmp_path / "a", 1, assess=quick)
    monkeypatch.undo()
    with store.Folder(tmp_path / "a").locked(), pytest.raises(ConfigError, match="Another campaign is running"):
        work.run(plan, 2, tmp_path / "a", 1, assess=quick)
    for flights, jobs in ((0, 1), (1, 0)):
        with pytest.raises(ConfigError, match="must be at least 1"):
            work.run(plan, flights, tmp_path / "b", jobs, assess=quick)


def test_intermittent_faults_can_be_planned():
    """`share` is how often a plan draws the fault, `duty` how much of a period it is there."""
    rows = [{"share": 3.0, "kind": "float", "onset_s": 22.0, "period_s": 2.0, "duty": {"uniform": [0.1, 0.2]}}]
    plan = campaign.from_table(table([(("faults",), rows), (("healthy",), 0.0)]))
    duties = [plan.flight(k).faults[0]["duty"] for k in range(20)]
    assert 0.1 <= min(duties) < max(duties) <= 0.2


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("campaign.json", b'{"version":', "campaign.json is damaged"),
        ("campaign.json", b"[]", "campaign.json is damaged"),
        ("campaign.json", b'{"version": "1", "width": "x"}', "campaign.json is damaged"),
        ("plan.toml", b"\xff", "holds results of another plan"),
        ("plan.toml", None, "holds results of another plan"),
        ("parts/00-00000-0000-0001.parquet", b"junk", "00-00000-0000-0001.parquet is damaged"),
    ],
)
def test_damaged_folders_are_reported(tmp_path, monkeypatch, name, data, says):
    monkeypatch.setattr(work.batch, "width", lambda: 4)
    plan = campaign.read(written(tmp_path))
    work.run(plan, 1, tmp_path / "a", 1, assess=quick)
    path = tmp_path / "a" / name
    path.unlink() if data is None else path.write_bytes(data)
    with pytest.raises(ConfigError, match=says) as why:
        work.run(plan, 1, tmp_path / "a", 1, assess=quick)
    assert "\n" not in str(why.value)


@pytest.mark.parametrize("where", ["{}/file", "{}/file/under", "/proc/campaign"])
def test_folders_that_cannot_be_made_are_reported(tmp_path, where):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="Cannot make the folder "):
        work.run(campaign.read(written(tmp_path)), 1, where.format(tmp_path), 1, assess=quick)


def test_a_flight_that_cannot_fly_is_reported_with_its_number(tmp_path):
    """Draws that only together are too much are met by the flight that drew them."""
    changes = [
        (("scenario", "airframe", "mass_kg"), {"choice": [4.0, 1.0]}),
        (("scenario", "airframe", "payload_kg"), {"choice": [0.0, 2.0]}),
    ]
    plan = campaign.from_table(table(changes))
    heavy = next(k for k in range(50) if plan.flight(k).airframe["mass_kg"] < 2.0 < 1.0 + plan.flight(k).airframe["payload_kg"])
    with pytest.raises(ConfigError, match=rf"flight {heavy}: airframe.payload_kg: "):
        batch.fly(plan, (heavy,), 1)


def test_without_pyarrow_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ConfigError, match="pip install pyarrow"):
        work.run(campaign.read(written(tmp_path)), 2, tmp_path / "a", 1, assess=quick)


# ---------------------------------------------------------------- statistics


def made(rows):
    full = [dict.fromkeys(score.COLUMNS) | {"method": "default", "frame": "quad-x", "autopilot": "px4", "profile": "fast", "trajectory":
            "hover", "rotors": 4, "wind_m_s": 1.0, "induced_m_s": 6.0, "fault": "", "broken": "", "clear": False, "false_alarms": 0,
            "sure_false_alarms": 0,
            "wrong": 0,
            "assessed_s": 36.0, "healthy_s": 36.0, "flight": k} | row for k, row in enumerate(rows)]  # fmt: skip
    types = {"int64": pyarrow.int64(), "string": pyarrow.string(), "double": pyarrow.float64(), "bool": pyarrow.bool_()}
    return pyarrow.Table.from_pylist(full, schema=pyarrow.schema([(c, types[k]) for c, (k, _) in score.COLUMNS.items()]))


def broken(**more):
    return {"fault": "loss", "clear": True, "detected": True, "right": True, "named": True, "delay_s": 0.4, "loss": 0.2,
            "estimate": 0.21, "lower": 0.15, "upper": 0.25, "bound_sd": 0.01, "bound_delay_s": 0.2, "peak": -5.0,
            **{f"peak_{s:g}s": 3.0 for s in score.WINDOWS_S}, **more}  # fmt: skip


def test_a_table_whose_answer_is_known():
    rows = [{"peak": -3.0}] * 150 + [{"false_alarms": 1, "sure_false_alarms": k, "peak": 1.0} for k in (0, 1)]
    rows += [broken()] * 30 + [broken(estimate=0.17, delay_s=0.8)] * 10
    missed = {"detected": False, "right": False, "named": False, "delay_s": None, "estimate": 0.0}
    rows += [broken(**missed, **{f"peak_{s:g}s": -8.0 for s in score.WINDOWS_S})] * 10
    found = campaign.summarise(made(rows), "known")
    all_ = found["methods"]["default"]["overall"]
    assert found["flights"] == 202 and found["healthy_h"] == pytest.approx(2.02)
    assert all_["false_alarms_h"]["value"] == pytest.approx(2 / 2.02)
    assert all_["sure_false_alarms_h"]["n"] == 1
    assert all_["detected"]["value"] == pytest.approx(0.8) and all_["detected"]["n"] == 50
    assert all_["delay_s"]["value"] == pytest.approx(0.4) and all_["delay_ratio"]["value"] == pytest.approx(2.0)
    rms = np.sqrt((30 * 0.01**2 + 10 * 0.03**2) / 40)
    assert all_["loss_rmse"]["value"] == pytest.approx(rms) and all_["rmse_ratio"]["value"] == pytest.approx(rms / 0.01)
    assert all_["coverage"]["value"] == 1.0
    roc = {p["threshold"]: p for p in found["methods"]["default"]["roc"]}
    assert roc[0.0]["false_alarms_h"]["n"] == 2 and roc[0.0]["detected_2s"]["value"] == pytest.approx(0.8)
    assert roc[2.0]["false_alarms_h"]["n"] == 0 and roc[3.0]["detected_2s"]["value"] == 0.0
    assert roc[-10.0]["detected_2s"]["value"] == 1.0
    curve = {p["delay_s"]: p for p in found["methods"]["default"]["delay_curve"]}
    assert curve[0.4]["detected"]["value"] == pytest.approx(0.6) and curve[0.1]["bound"]["value"] == 0.0
    assert curve[0.2]["bound"]["value"] == 1.0
    sizes = {p["low"]: p for p in found["methods"]["default"]["loss_error"]}
    assert sizes[0.12]["faults"] == 50 and sizes[0.12]["bias"]["value"] == pytest.approx(0.0)
    assert "50" in campaign.markdown(found)
    json.dumps(found, allow_nan=False)


def test_what_the_answers_name():
    """Of healthy flights how often an answer names a rotor, of faults how often it names the broken one, or only others."""
    sound = [{"answer": "healthy", "accused": ""}] * 97 + [{"answer": "ambiguous", "accused": "2+4"}] * 3
    reported = [broken(broken="2", answer=a, accused=w) for a, w in [("fault", "2")] * 6 + [("ambiguous", "2+4")] * 2]
    reported += [broken(broken="2", answer=a, accused=w) for a, w in (("healthy", ""), ("fault", "12"))]
    rows = made(sound + reported).to_pylist()
    without = [row | {"method": "ekf", "answer": None, "accused": None} for row in rows]
    found = campaign.summarise(pyarrow.Table.from_pylist(rows + without, schema=made([{}]).schema))["methods"]
    default, ekf = found["default"]["overall"], found["ekf"]["overall"]
    assert default["answered"]["value"] == pytest.approx(0.8) and default["answered"]["n"] == 10
    assert default["accused_h"]["n"] == 3 and default["accused_h"]["value"] == pytest.approx(3.0)
    assert default["misled"] == 1
    assert ekf["answered"] is None and ekf["accused_h"] is None and ekf["misled"] == 0
    assert "| 80 % (" in campaign.markdown({"flights": 110, "healthy_h": 1.1, "methods": {"default": found["default"]}})


def test_intervals_hold_what_they_promise():
    rng = np.random.default_rng(0)
    p, hours = 0.1, 7.0
    shares = [summary.share(rng.random(60) < p) for _ in range(500)]
    rates = [summary.rate(int(rng.poisson(0.5 * hours)), hours) for _ in range(500)]
    assert np.mean([s["low"] <= p <= s["high"] for s in shares]) > 0.92
    assert np.mean([r["low"] <= 0.5 <= r["high"] for r in rates]) > 0.94
    errors = [summary.boot(rng.normal(size=80), np.median) for _ in range(100)]
    assert 0.85 < np.mean([e["low"] <= 0.0 <= e["high"] for e in errors]) <= 1.0
    assert summary.rate(0, 10.0)["high"] == pytest.approx(0.3689, rel=1e-3)  # 3.689 / 10 h, Garwood
    assert summary.rate(3, 0.0) is None and summary.share(np.zeros(0, bool)) is None


def test_the_page_holds_all_it_needs(tmp_path):
    rows = [{"peak": -3.0}] * 5 + [{"peak": 0.5, "false_alarms": 1}] + [broken()] * 6
    page.write(campaign.summarise(made(rows), "<known>"), tmp_path / "index.html")
    text = (tmp_path / "index.html").read_text()
    assert "&lt;known&gt;" in text and "Cramer-Rao" in text
    assert not re.search(r"<script[^>]*\bsrc=", text)
    outside = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"<(link|img|iframe)\b", outside)


def test_curves_of_groups_are_those_of_their_flights():
    """Each frame's, profile's and wind's curves are what a table of these flights alone gives."""
    rows = [{"peak": -3.0, "frame": f, "wind_m_s": w} for f in ("quad-x", "hexa-x") for w in (1.0, 4.0)] * 5
    rows += [{"peak": 1.0, "false_alarms": 1, "frame": "hexa-x", "wind_m_s": 4.0}]
    rows += [broken(frame="quad-x")] * 6 + [broken(frame="hexa-x", delay_s=3.0, estimate=0.25, wind_m_s=8.0, peak_2s=-1.0)] * 4
    found = campaign.summarise(made(rows))["methods"]["default"]
    assert set(found["curves"]) == {"frame", "profile", "wind", "induced velocity"} and set(found["curves"]["wind"]) == set(
        found["groups"]["wind"]
    )
    for frame in ("quad-x", "hexa-x"):
        alone = campaign.summarise(made([row for row in rows if row.get("frame") == frame]))["methods"]["default"]
        curves = found["curves"]["frame"][frame]
        whole = {p["threshold"]: p for p in alone["roc"]}
        for point in curves["roc"]:
            assert point["false_alarms_h"] == pytest.approx(whole[point["threshold"]]["false_alarms_h"]["value"])
            assert point["detected_2s"] == pytest.approx(whole[point["threshold"]]["detected_2s"]["value"])
        assert [p["detected"] for p in curves["delay_curve"]] == [p["detected"]["value"] for p in alone["delay_curve"]]
        errors = [p for p in alone["loss_error"] if p["rmse"]]
        assert [p["rmse"] for p in curves["loss_error"]] == pytest.approx([p["rmse"]["value"] for p in errors])
    assert found["curves"]["frame"]["hexa-x"]["delay_curve"][0]["detected"] == 0.0


@pytest.mark.thorough
def test_the_page_shows_every_method_and_group(tmp_path, monkeypatch):
    """More methods than colours, a rule without a statistic, and pictures by frame, profile and wind."""
    monkeypatch.setattr(page, "COLOURS", page.COLOURS[:1])
    rows = [{"peak": -3.0}, {"peak": 0.5, "false_alarms": 1}, *[broken()] * 3, *[broken(frame="hexa-x", wind_m_s=8.0)] * 3]
    rows += [broken(autopilot="ardupilot", profile="default", wind_m_s=4.0)]
    names = [f"method-{k}" for k in range(2)]
    rows = [{**row, "method": name} for name in names for row in rows]
    blank = dict.fromkeys(("peak", "estimate", "lower", "upper", *(f"peak_{s:g}s" for s in score.WINDOWS_S)))
    rows += [{**broken(), **blank, "method": "rule"}, {**blank, "method": "rule", "false_alarms": 1}]
    page.write(campaign.summarise(made(rows)), tmp_path / "index.html")
    text = (tmp_path / "index.html").read_text()
    for title in ("All flights", "By frame", "By logging profile", "By wind"):
        assert f"<h2>{title}</h2>" in text
    for name in (*names, "rule"):
        assert re.search(rf'"label":\{{"type":"value","value":"{name}"\}}', text), name
    for what in ("detected within 2 s", "detected within a time", "error of announced losses"):
        assert text.count(f"method-1: {what}") >= 3  # by frame, profile, wind
    assert "rule: detected within" not in text


def test_an_empty_table_is_refused():
    with pytest.raises(ConfigError, match="no flight"):
        campaign.summarise(made([]))


def test_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(work.batch, "width", lambda: 4)
    monkeypatch.setattr(
        campaign, "run", lambda *a, **k: work.run(*a, assess=lambda *b: made([broken(flight=k) for k in b[1]]).to_pylist(), **k)
    )
    command = ["campaign", str(written(tmp_path)), "--flights", "9", "--jobs", "1", "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(cli.cli, command, catch_exceptions=False)
    assert done.exit_code == 0 and "9 flights" in done.output
    assert {"flights.parquet", "summary.json", "index.html", "plan.toml"} <= {p.name for p in (tmp_path / "out").iterdir()}
    done = CliRunner().invoke(cli.cli, [*command, "--json", "-q"], catch_exceptions=False)
    assert json.loads(done.stdout)["flights"] == 9
    assert plans.read(tmp_path / "out" / "plan.toml").cells == plans.read(tmp_path / "small.toml").cells
