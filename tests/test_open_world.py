"""Campaigns assessed by logs: plans of kinds, what an answer is worth, the table, and a few flights through the command."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Event
from rotorwatch_lab import campaign
from rotorwatch_lab.campaign import open_score, open_world
from rotorwatch_lab.simulation import scenario
from script_files import loaded

KINDS = [
    {"name": "calm"},
    {"name": "fast", "share": 2.0, "scenario": {"wind": {"speed_m_s": {"uniform": [6.0, 7.0]}}}},
    {
        "name": "tilt",
        "scenario": {"airframe": {"payload_kg": 0.1}},
        "fault": {"kind": "tilt", "angle_deg": {"uniform": [2.0, 5.0]}, "onset_s": 22.0},
    },
]


def table(**changes):
    part = {"duration_s": 40.0, "airframe": {"frame": "quad-x"}, "wind": {"speed_m_s": {"uniform": [0.0, 1.0]}}}
    return {"seed": 4, "assess": "log", "scenario": part, "kinds": KINDS, **changes}


def test_each_flight_is_of_one_kind_and_a_kind_changes_its_own_fields_only():
    plan = campaign.from_table(table())
    flights = [(plan.kind(k).name, plan.flight(k)) for k in range(400)]
    count = {name: sum(name == kind for kind, _ in flights) for name in ("calm", "fast", "tilt")}
    assert 0.4 < count["fast"] / 400 < 0.6 and min(count.values()) > 70
    for kind, f in flights:
        assert (6.0 <= f.wind["speed_m_s"] <= 7.0) if kind == "fast" else (f.wind["speed_m_s"] <= 1.0)
        assert f.airframe["payload_kg"] == (0.1 if kind == "tilt" else 0.0)
        assert [x["kind"] for x in f.faults] == (["tilt"] if kind == "tilt" else [])
        assert all(2.0 <= x["angle_deg"] <= 5.0 for x in f.faults)
    assert {x["rotor"] for _, f in flights for x in f.faults} == {1, 2, 3, 4}
    assert plan.flight(9) == campaign.from_table(table()).flight(9)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"assess": "me"}, "assess must be one of ticks, log"),
        ({"kinds": []}, r'assess = "log" needs \[\[kinds\]\]'),
        ({"estimators": ["ekf"]}, 'assess = "log" needs'),
        ({"healthy": 0.5}, "kinds stand instead of healthy"),
        ({"kinds": [{"name": "a"}, {"name": "a"}]}, r"kinds\[2\].name must be a text that no other kind has"),
        ({"kinds": [{"name": "a", "fault": 3}]}, r"kinds\[1\].scenario and kinds\[1\].fault must be tables"),
        ({"kinds": [{"name": "a", "fault": {"kind": "tilt", "onset_s": 3.0}}]}, r"kinds\[1\].fault.angle_deg is missing"),
        ({"kinds": [{"name": "a", "fault": {"kind": "loss", "share": 2.0}}]}, r"kinds\[1\].fault.share"),
        ({"kinds": [{"name": "a", "scenario": {"wind": {"sped": 1.0}}}]}, r"kinds\[1\].scenario.wind.sped is not a field"),
        ({"kinds": [{"name": "a", "scenario": {"airframe": {"frame": "y6"}}}]}, "airframe.frame is the same for all kinds"),
        ({"kinds": [{"name": "a", "scenario": {"duration_s": 50.0}}]}, "duration_s is the same for all kinds"),
        ({"kinds": [{"name": "a", "scenario": {"airframe": {"payload_kg": {"uniform": [0.0, 9.0]}}}}]}, r"kinds\[1\].*too much"),
    ],
)  # fmt: skip
def test_bad_kinds_are_named_by_field(changes, says):
    with pytest.raises(ConfigError, match=says):
        campaign.from_table(table(**changes))


# ---------------------------------------------------------------- what an answer is worth


def flown(*faults):
    rows = [{"onset_s": 30.0, **fault} for fault in faults]
    return scenario.from_table({"duration_s": 60.0, "airframe": {"frame": "hexa-x"}, "faults": rows})


def event(rotors, onset=30.2, alternatives=(), kind="loss_of_effectiveness", loss=0.3):
    n = len(rotors)
    return Event(kind, rotors, onset, onset + 0.5, None, (loss,) * n, ((loss - 0.05, loss + 0.05),) * n, 0.99, alternatives)


def answer(*events, verdict="fault", weak=(), suspects=()):
    states = dict.fromkeys(range(1, 7), "healthy") | dict.fromkeys(weak, "degraded") | dict.fromkeys(suspects, "suspect")
    rotors = tuple(SimpleNamespace(rotor=r, status=s) for r, s in states.items())
    return SimpleNamespace(verdict=verdict, events=events, rotors=rotors)


LOSS = {"kind": "loss", "rotor": 3, "strength": 0.32}
TILT = {"kind": "tilt", "rotor": 3, "angle_deg": 4.0}
DOUBT = answer(event((3,), alternatives=((4,),)), verdict="ambiguous")


@pytest.mark.parametrize(
    ("faults", "said", "outcome"),
    [
        ((), answer(verdict="healthy"), "clean"),
        ((), DOUBT, "doubt"),
        ((), answer(event((2,))), "accused"),
        ((), answer(weak=(2,)), "accused"),  # by a comparison with healthy flights
        ((), answer(event((2,), kind="contact"), verdict="healthy"), "clean"),
        ((), answer(verdict="inconclusive"), "clean"),
        ((LOSS,), answer(event((3,)), weak=(3,)), "right"),
        ((LOSS,), answer(event((3,), kind="output_override"), weak=(3,)), "right"),
        ((LOSS,), answer(event((3,)), event((1,)), weak=(1, 3)), "extra"),
        ((LOSS,), answer(event((3,), onset=20.0), weak=(3,)), "extra"),  # before it was broken
        ((LOSS,), answer(event((1,)), weak=(1,)), "wrong"),
        ((LOSS,), DOUBT, "among"),
        ((LOSS,), answer(verdict="ambiguous", suspects=(3,)), "among"),
        ((LOSS,), answer(event((1,), alternatives=((4,),)), verdict="ambiguous"), "astray"),
        ((LOSS,), answer(verdict="healthy"), "missed"),
        ((LOSS, LOSS | {"rotor": 5}), answer(event((3,)), weak=(3,)), "partly"),
        ((LOSS, LOSS | {"rotor": 5}), answer(event((3, 5)), weak=(3, 5)), "right"),
        ((TILT,), answer(verdict="healthy"), "clean"),
        ((TILT,), answer(event((3,)), weak=(3,)), "right"),
        ((TILT,), answer(event((3, 1)), weak=(3, 1)), "wrong"),
        ((TILT,), DOUBT, "doubt"),
        (({"kind": "stuck", "rotor": 3},), answer(event((6,), loss=1.0), weak=(6,)), "wrong"),
    ],
)  # fmt: skip
def test_what_an_answer_is_worth(faults, said, outcome):
    assert open_score.assessed(flown(*faults), said)["outcome"] == outcome


@pytest.mark.parametrize(
    ("fault", "said", "named"),
    [
        (TILT, answer(event((), kind="turned_mount"), verdict="healthy"), True),
        (TILT, answer(event((), kind="contact"), verdict="healthy"), False),
        (TILT, answer(event((), kind="turned_mount"), event((1,)), weak=(1,)), False),  # and a healthy rotor is accused
        ({"kind": "slow", "rotor": 3, "times": 4.0}, answer(event((3,), kind="slow_response")), True),
        ({"kind": "slow", "rotor": 3, "times": 4.0}, answer(event((3,)), weak=(3,)), False),
        (LOSS, answer(event((3,)), weak=(3,)), None),
    ],
)
def test_a_fault_that_is_no_loss_is_named_by_its_kind(fault, said, named):
    assert open_score.assessed(flown(fault), said).get("named") is named


def test_size_delay_and_a_fault_that_is_said_to_be_over():
    found = open_score.assessed(flown(LOSS), answer(event((3,), loss=0.3), weak=(3,)))
    assert found["error"] == pytest.approx(-0.02) and found["holds"] is True and found["ended"] is False
    assert found["delay_s"] == pytest.approx(0.7)
    over = open_score.assessed(flown(LOSS), answer(event((3,), loss=0.5)))
    assert over["ended"] is True and over["holds"] is False
    comes_and_goes = LOSS | {"period_s": 4.0}
    assert "ended" not in open_score.assessed(flown(comes_and_goes), answer(event((3,))))
    assert "error" not in open_score.assessed(flown({"kind": "stuck", "rotor": 3}), answer(event((3,))))


def test_a_loss_that_still_grows_is_compared_with_what_it_has_come_to():
    assert open_score.losses(flown(LOSS | {"ramp_s": 60.0})) == pytest.approx({3: 0.16})
    assert open_score.losses(flown({"kind": "complete loss", "rotor": 2})) == {2: 1.0}


def test_counts_of_a_table_whose_answer_is_known():
    blank = dict.fromkeys(open_world.COLUMNS)
    healthy = blank | {"group": "healthy", "kind": "calm", "airborne_s": 72.0}
    rows = [healthy | {"outcome": what} for what in ["clean"] * 97 + ["doubt", "accused", "accused"]]
    for row, verdict in zip(rows, ("inconclusive", "error", "inconclusive", "healthy")):
        row["verdict"] = verdict
    broken = blank | {"group": "loss", "kind": "step", "loss": 0.3, "airborne_s": 50.0, "error": 0.1, "holds": True, "ended": False}
    rows += [broken | {"outcome": what} for what in ("right", "right", "right", "extra")]
    found = open_world.summarise(SimpleNamespace(to_pylist=lambda: rows), "made")
    lines = {line["name"]: line for line in found["lines"]}
    assert found["flights"] == 104 and "a fault that is no loss" not in "".join(lines)
    assert lines["calm"]["accused"]["value"] == 0.02 and lines["calm"]["doubt"]["value"] == 0.01
    assert lines["calm"]["hours"] == pytest.approx(2.0) and lines["calm"]["accused_h"]["value"] == pytest.approx(1.0)
    assert lines["calm"]["accused_h"]["low"] == pytest.approx(0.121, abs=1e-3)  # Poisson, 2 events
    quarter = lines["all: a loss of a quarter and more"]
    assert quarter["right"]["value"] == 0.75 and quarter["accused"]["value"] == 0.25 and quarter["hours"] == 0.0
    text = open_world.markdown(found)
    assert lines["calm"]["unanswered"] == 3
    assert "| calm | 100 | 2 (0.6–7.0) |" in text and text.count("| kind of flight |") == 3
    assert "| calm | 100 | 2 | 1 |" in open_world.markdown(found, brief=True)
    assert [len(row) for row in open_world.table(found)] == [len(open_world.HEADS)] * (len(found["lines"]) + 1)
    still = found["lines"][-1] | {"name": "healthy: still", "group": "healthy", "right": None, "unanswered": 2}
    still |= {key: {"value": 0.0, "low": 0.0, "high": 0.1, "n": 4} for key in ("accused", "doubt")}
    assert "No rotor accused, none ambiguous: still (4, 2 without an answer).\n" in open_world.markdown(found | {"lines": [still]})
    calm = text.split("| kind of flight |")[2]
    assert "no answer" in calm and all(head not in calm for head in ("right", "crashed", "hours", "an hour"))


def test_the_results_page_takes_the_table_between_its_marks():
    path = Path(__file__).resolve().parents[1] / "docs" / "make_open_world.py"
    script = loaded(path)
    page = script.PAGE.read_text(encoding="utf-8")
    made = script.filled(page, {"flights": 3, "name": "made", "lines": []})
    assert "3 flights of made: " in made and script.filled(made, {"flights": 3, "name": "made", "lines": []}) == made
    for part in (page.split(script.START)[0], page.split(script.END)[1]):
        assert part in made


# ---------------------------------------------------------------- for real


def test_the_command_writes_logs_of_both_autopilots_and_diagnoses_them(tmp_path):
    pytest.importorskip("pyarrow")
    plan = tmp_path / "open.toml"
    plan.write_text(
        """
        assess = "log"
        [scenario]
        duration_s = 38.0
        autopilot = { choice = ["ardupilot", "px4"] }
        airframe.frame = "quad-x"
        trajectory = { altitude_m = 5.0, land = false }
        [[kinds]]
        name = "half a rotor"
        fault = { kind = "loss", strength = 0.5, onset_s = 25.0 }
        """
    )
    command = ["campaign", str(plan), "--flights", "2", "--jobs", "1", "-o", str(tmp_path / "out"), "--json", "-q"]
    done = CliRunner().invoke(cli.cli, command, catch_exceptions=False)
    lines = {line["name"]: line for line in json.loads(done.stdout)["lines"]}
    assert lines["half a rotor"]["flights"] == 2 and lines["half a rotor"]["right"]["value"] == 1.0
    rows = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert rows["flights"] == 2 and not (tmp_path / "out" / "index.html").exists()
    again = CliRunner().invoke(cli.cli, command, catch_exceptions=False)
    assert again.stdout == done.stdout
