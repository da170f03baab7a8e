"""Whether to fly again: the word, the checks, and what would make the answer surer; and the causes, for programs."""

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import rotorwatch as rw
from conftest import against_healthy, hexa_diagnosis, hexa_event
from rotorwatch.answer import settings
from rotorwatch.answer.conclusion import conclude
from rotorwatch.answer.findings import Evidence
from rotorwatch.flight.diagnosis import Diagnosis, Trend
from rotorwatch.flight.kinds import SUREST, Weight, table
from rotorwatch.report import html, terminal
from script_files import loaded
from test_cli import run  # noqa: F401 - a fixture

ROOT = Path(__file__).parents[1]
make_schema = loaded(ROOT / "docs" / "make_schema.py")
PAGE, TARGET, schema = make_schema.PAGE, make_schema.TARGET, make_schema.schema
SAMPLES = Path(rw.__file__).parent / "samples"


def concluded(*events, **more):
    return conclude(Evidence(events, 6, **{"hidden": np.full(6, 0.04), "assessed_s": 60.0, **more}))


def word(*events, **more):
    return concluded(*events, **more).fit_to_fly.word


def of_kind(kind, **extra):
    return hexa_event(kind=kind, rotors=(), loss=(), interval=(), extra={"trouble": "radio", **extra})


def test_a_healthy_flight_may_fly_and_too_short_a_one_says_nothing():
    assert word() == "fly" and word(hidden=None, assessed_s=0.0) == "cannot say" and word(hidden=np.full(6, 0.5)) == "cannot say"


@pytest.mark.parametrize("kind", [k.name for k in table().values() if k.weight is not Weight.OPEN])
def test_nothing_that_happened_is_green(kind):
    """A knock, a notice and a report among them: each kind of event, alone in a flight without a loss."""
    assert word(of_kind(kind)) in ("look first", "do not fly")


@pytest.mark.parametrize("trouble", ["power", "crash", "stopped"])
def test_a_trouble_that_ended_the_flight_forbids_the_next(trouble):
    assert word(of_kind("autopilot_report", trouble=trouble)) == "do not fly"
    assert word(of_kind("autopilot_report", trouble="compass")) == "look first"


@pytest.mark.parametrize(("interval", "expected"), [((0.33, 0.41), "do not fly"), ((0.05, 0.41), "look first")])
def test_a_large_loss_forbids_flying_whichever_rotor_it_is_of(interval, expected):
    assert word(hexa_event()) == "do not fly"
    assert word(hexa_event(alternatives=((4,),), interval=(interval,), probability=0.6)) == expected


def test_a_loss_that_grows_is_looked_at():
    trend = Trend(0.02, (0.01, 0.03), 0.0, 60.0, "growing")
    end = concluded(trends=(trend, *(None,) * 5))
    assert end.fit_to_fly.word == "look first" and "rotor 1" in end.fit_to_fly.checks[0]


def test_the_first_checks_are_the_likeliest_rotors_and_no_more_than_three():
    events = (
        hexa_event(rotors=(5,), alternatives=((2,),), probability=0.7),
        *(of_kind(k) for k in ("contact", "yaw_imbalance", "little_thrust_left")),
    )
    end = concluded(*events)
    assert "rotors 5 and 2" in end.fit_to_fly.checks[0] and len(end.fit_to_fly.checks) == 3 < len(end.advice)
    assert set(end.fit_to_fly.checks) | set(end.fit_to_fly.surer) <= set(end.advice)


@pytest.mark.parametrize(
    ("kind", "colour"), [("contact", "yellow"), ("little_thrust_left", "yellow"), ("loss_of_control", "red"), (None, "green")]
)
def test_a_knock_is_never_green_in_any_view(kind, colour):
    answer = hexa_diagnosis(events=() if kind is None else (of_kind(kind),), trace=None)  # pages without plots are made faster
    tone = {"yellow": "ambiguous", "red": "fault", "green": "healthy"}[colour]
    (first, *_) = terminal.diagnosis(answer).renderables
    assert str(first.style).endswith(colour) and first.plain.startswith(answer.fit_to_fly.word.upper())
    assert f'<section class="verdict {tone}">' in html.page(answer)
    assert ("✓" in answer.to_markdown().splitlines()[0]) == (colour == "green")


@pytest.mark.parametrize(("parameters", "said"), [
    ({"LOG_BITMASK": 176126.0}, "For the next log set LOG_BITMASK to 438271 (it is 176126): it adds motors faster and gyro faster."),
    ({"LOG_BITMASK": 438271.0}, ""),
    ({}, "Motors at 10 Hz: Set LOG_BITMASK bit 0, which adds 1 to its value (RATE at loop rate): the commands are rebuilt from it."),
])  # fmt: skip
def test_the_settings_are_given_as_a_whole_value(parameters, said):
    flight = rw.read(SAMPLES / "quadx_healthy_hover.bin.xz")
    assert settings.advice(replace(flight, parameters={**flight.parameters, "LOG_BITMASK": -1.0, **parameters})) == said


def test_the_answer_of_a_log_has_the_settings_and_comes_back_from_json():
    answer = rw.diagnose(SAMPLES / "quadx_healthy_hover.bin.xz")
    assert answer.fit_to_fly.word == "fly" and answer.fit_to_fly.checks == () and "438271" in answer.fit_to_fly.surer[0]
    assert Diagnosis.from_dict(json.loads(answer.to_json())).fit_to_fly == answer.fit_to_fly
    old = {k: v for k, v in answer.to_dict().items() if k not in ("fit_to_fly", "causes")}
    assert Diagnosis.from_dict(old).fit_to_fly is None


# Causes


def test_a_sure_loss_has_one_cause_with_its_evidence():
    (cause,) = hexa_diagnosis().causes
    assert cause == {"name": "loss_of_effectiveness", "rotors": (3,), "probability": SUREST, "evidence": (hexa_event().reason,)}
    (part,) = hexa_diagnosis(events=(hexa_event(extra={"cause": "propeller"}),)).causes
    assert part["name"] == "propeller"


def test_parts_share_the_probability_of_their_rotor():
    shares = {"bearing": 0.1, "propeller": 0.7, "unknown": 0.2}
    causes = hexa_diagnosis(events=(hexa_event(extra={"cause": "propeller", "causes": shares}),)).causes
    assert [c["name"] for c in causes] == ["propeller", "loss_of_effectiveness", "bearing"]
    assert sum(c["probability"] for c in causes) == pytest.approx(SUREST)


def test_candidates_of_unknown_probability_come_last():
    causes = hexa_diagnosis(events=(hexa_event(alternatives=((4,), (1, 6)), probability=0.6),)).causes
    assert [(c["rotors"], c["probability"]) for c in causes] == [((3,), 0.6), ((4,), None), ((1, 6), None)]


def test_reports_before_a_loss_of_control_compete_with_its_cause():
    report = of_kind("autopilot_report", trouble="compass")
    lost = replace(of_kind("loss_of_control"), onset_s=40.0, detected_s=40.5)
    lost = replace(
        lost, extra={"cause": "controller", "evidence": ["it left its setpoint"], "before": [{"trouble": "compass", "time_s": 31.2}]}
    )
    causes = concluded(report, lost).causes
    assert [c["name"] for c in causes] == ["controller", "compass"] and causes[1]["evidence"] == (report.reason,)
    assert "it left its setpoint" in causes[0]["evidence"]


def test_damage_from_takeoff_and_an_offset_load():
    causes = hexa_diagnosis(events=(), whole_flight=against_healthy(verdict="ambiguous").whole_flight).causes
    found = [(c["name"], c["rotors"], c["probability"]) for c in causes]
    assert found == [("damage_from_takeoff", (3,), 0.9), ("centre_of_mass", (), 0.06), ("damage_from_takeoff", (1,), 0.04)]


def test_a_log_that_contradicts_itself_and_a_healthy_one_have_no_causes():
    assert hexa_diagnosis(events=()).causes == () and hexa_diagnosis(doubts=("The outputs are not those that flew.",)).causes == ()


# The schema


def test_the_schema_is_that_of_the_page():
    assert json.loads(TARGET.read_text(encoding="utf-8")) == schema(PAGE.read_text(encoding="utf-8"))


ANSWERS = {
    "fault": lambda: hexa_diagnosis(), "healthy": lambda: hexa_diagnosis(events=()), 
    "doubt": lambda: hexa_diagnosis(doubts=("The outputs are not those that flew.",)),
    **{path.name: (lambda path=path: rw.diagnose(path)) for path in sorted(SAMPLES.glob("*.xz"))},
}  # fmt: skip


@pytest.mark.parametrize("answer", ANSWERS)
def test_answers_follow_the_schema(answer):
    validator = jsonschema.Draft202012Validator(json.loads(TARGET.read_text(encoding="utf-8")))
    found = json.loads(ANSWERS[answer]().to_json())
    assert not [f"{list(e.absolute_path)}: {e.message}" for e in validator.iter_errors(found)]


@pytest.mark.parametrize(
    "change",
    [{"verdict": 3}, {"rotors": None}, {"causes": [{"name": "x"}]}, {"fit_to_fly": {"word": "perhaps", "checks": [], "surer": []}}],
)
def test_the_schema_refuses_another_structure(change):
    found = json.loads(hexa_diagnosis().to_json())
    assert not jsonschema.Draft202012Validator(schema(PAGE.read_text(encoding="utf-8"))).is_valid({**found, **change})


def test_the_line_for_a_forum_is_one_line_without_private_data():
    line = hexa_diagnosis(aircraft="4A003F", flight={**hexa_diagnosis().flight, "name": "4A003F.bin"}).to_line()
    assert line.startswith("DO NOT FLY: Rotor 3 (front left) lost 37 %") and "hexa" in line and "\n" not in line and "4A003F" not in line


def test_the_command_prints_the_line(run):  # noqa: F811
    code, out, _ = run("diagnose", str(SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"), "--line", "--quiet")
    assert code == 1 and out.startswith("DO NOT FLY: Rotor 3 (front left)") and out.count("\n") == 1
