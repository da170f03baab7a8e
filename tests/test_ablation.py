"""Ablation: every constant is in the table, one changed by parameter is the one changed in its file, and differences are paired."""

import csv
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from rotorwatch.commands import cli
from rotorwatch.engine.bindings import program
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.estimator import hypotheses, kalman, model_error, posterior
from rotorwatch.engine.events import decisions, losses
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN, Ticks
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import ablation
from rotorwatch_lab.campaign.constants import TABLE

DT = 0.1
DOCS = Path(__file__).parents[1] / "docs"


def hover(loss=0.0, count=160, n=4, onset=100) -> Ticks:
    """Ticks of a quad in hover, with noise; from `onset` on rotor 1 lacks `loss` and the controller has asked for more."""
    rng = np.random.default_rng(3)
    B = np.array([[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1.0]])
    time = DT * np.arange(count)
    missing = (np.arange(count) >= onset)[:, None] * loss * B[:, 0]
    thrust = np.ones((count, n)) + missing @ np.linalg.pinv(B).T
    wrench = thrust @ B.T + 0.02 * rng.standard_normal((count, 4))
    still = np.zeros((count, 3))
    return Ticks(
        time, time - DT, thrust, wrench, still, still, np.ones(count), np.ones((count, 4), bool),
        np.where(time < 6.0, LEARN, ASSESS).astype(np.int32), np.arange(count) == 0, np.full(count, 0.4), DT, np.zeros(count, bool),
        side=np.zeros((count, 2)),
    )  # fmt: skip


B = np.array([[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1.0]])


def test_the_table_names_every_constant_and_no_other():
    assert set(ablation.constants()) == set(TABLE)
    assert all(line.unit and line.meaning for line in TABLE.values())


def test_documents_and_exceptions_name_constants_that_exist():
    modules = {file: import_module(home) for file, home in ablation.DEFINITIONS.items()}
    for key in ablation.NOT_CHOSEN:
        file, _, name = key.partition(".")
        assert hasattr(modules[file], name), key
    with open(DOCS / "halved_and_doubled.csv", encoding="utf-8") as table:
        measured = {row["constant"] for row in csv.DictReader(table)}
    assert measured and measured <= set(TABLE)
    text = (DOCS / "ablation.md").read_text(encoding="utf-8")
    for file, name in re.findall(r"`(?:(\w+)\.)?([A-Z][A-Z0-9_]+)`", text):
        assert any(hasattr(m, name) for m in ([modules[file]] if file else modules.values())), f"{file}.{name}"


def test_variants_are_half_double_and_off():
    found = ablation.variants(["model_error.GAIN_ERROR", "plant.USUAL_S"])
    assert found["as it is"] == {}
    assert found["model_error.GAIN_ERROR half"] == {"model_error.GAIN_ERROR": tuple(0.5 * v for v in model_error.GAIN_ERROR)}
    assert found["model_error.GAIN_ERROR off"] == {"model_error.GAIN_ERROR": (0.0,) * 4}
    assert "plant.USUAL_S double" in found and "plant.USUAL_S off" not in found
    assert list(ablation.variants(["plant.USUAL_S"], ["half"])) == ["as it is", "plant.USUAL_S half"]
    with pytest.raises(ConfigError, match="No constant's name begins with nothing"):
        ablation.variants(["nothing"])


def test_constants_are_changed_only_for_a_while():
    before = kalman.OUTLIER
    with pytest.raises(RuntimeError), ablation.changed({"kalman.OUTLIER": 2.0}):
        assert kalman.OUTLIER == 2.0
        raise RuntimeError
    assert before == kalman.OUTLIER


def test_what_follows_from_a_constant_follows_and_is_none():
    nats, weight = hypotheses.CLEAR, hypotheses.PAIR_WEIGHT
    assert nats == pytest.approx(np.log(decisions.CLEAR)) and "hypotheses.CLEAR" not in ablation.constants()
    with ablation.changed({"decisions.CLEAR": 20.0, "losses.PAIR_WEIGHT": 0.5}):
        assert hypotheses.CLEAR == pytest.approx(np.log(20.0)) == -posterior.ALIKE
        assert hypotheses.PAIR_WEIGHT == 0.5
    assert nats == hypotheses.CLEAR == -posterior.ALIKE and weight == hypotheses.PAIR_WEIGHT


@pytest.mark.thorough
def test_constants_of_the_definition_are_built_in_and_given_back():
    table = hover(0.3)
    kept = ablation.assess(table, B, {})

    def width() -> float:
        (event,) = ablation.events.read(kept, table, B)
        assert event.rotors == (1,)
        low, high = event.interval[0]
        return high - low

    before, share = width(), losses.CURVE_SHARE
    with ablation.changed({"losses.CURVE_SHARE": 0.5}):
        assert width() > 1.2 * before
    assert width() == before and losses.CURVE_SHARE == share != 0.5


@pytest.mark.thorough
def test_the_estimator_is_built_with_the_constants_and_without_them_again():
    table, usual = hover(0.3), ablation.assess(hover(0.3), B, {})
    other = ablation.assess(table, B, {"kalman.OUTLIER": 2.0, "plant.GAIN_MEAN": (0.01, 0.01, 0.3, 0.0)})
    assert np.abs(other.log_odds - usual.log_odds).max() > 1.0
    np.testing.assert_array_equal(ablation.assess(table, B, {}).log_odds, usual.log_odds)


def flight(states, false=0, delays=(), errors=(), held=(), hours=0.5):
    return {"kind": "campaign", "states": states, "false": false, "hours": hours, "delays": list(delays), "errors": list(errors),
            "held": list(held)}  # fmt: skip


def test_measures_are_shares_of_states_faults_and_hours():
    found = ablation.measures([
        flight(["right", "wrong"], 1, [0.5, None], [0.03, -0.04], [True, False]), flight(["ambiguous", "missed"], 0, [1.5]),
    ])  # fmt: skip
    assert found["right"] == 0.5 and found["wrong"] == 0.25 and found["found"] == pytest.approx(2 / 3)
    assert found["delay_s"] == 1.0 and found["rms"] == pytest.approx(np.sqrt((9 + 16) / 2) / 100)
    assert found["coverage"] == 0.5 and found["false_per_h"] == 1.0
    assert set(ablation.measures([flight([])]).values()) == {None, 0.0}


def test_differences_are_of_the_same_states():
    """b states right only after, c only before: (b - c) / n, with McNemar's deviation; what changes both ways is seen."""
    before = [flight(["right", "right", "missed", "missed", "wrong"])]
    after = [flight(["right", "missed", "ambiguous", "right", "wrong"], 2)]
    reported = ablation.differences(before, after)
    b, c, n = 2, 1, 5
    assert reported["right"]["difference"] == pytest.approx((b - c) / n) and reported["right"]["changed"] == b + c
    assert reported["right"]["sd"] == pytest.approx(np.sqrt(b + c - (b - c) ** 2 / n) / n)
    assert reported["wrong"]["changed"] == 0 and reported["false"]["difference"] == 2.0


def test_a_fault_is_found_late_or_never_and_an_event_without_one_is_false():
    """The assess's own books, on ticks whose answer is put in by hand."""
    table = hover(count=400)
    case = ablation.Case("campaign", table, B, (table.time >= 20.0)[:, None] * np.array([0.3, 0.0, 0.0, 0.0]))
    quiet = ablation.outcomes(case, made(table, rotor=None))
    assert quiet["states"] == ["right", "missed"] and quiet["delays"] == [None] and quiet["false"] == 0
    reported = ablation.outcomes(case, made(table, rotor=0, at=21.0, theta=0.31))
    assert reported["states"] == ["right", "right"] and reported["delays"] == [pytest.approx(1.0, abs=0.11)] and reported["held"] == [True]
    assert reported["errors"] == [pytest.approx(0.01)]
    wrong = ablation.outcomes(case, made(table, rotor=2, at=10.0, theta=0.2))
    assert wrong["false"] == 1 and wrong["states"][0] == "wrong" and wrong["delays"] == [None]


def made(table, rotor, at=0.0, theta=0.0) -> program.TickOutput:
    """What the estimator would have left had it announced a rotor's loss at a time."""
    T, hyp = len(table.time), list_hypotheses(4)
    k = round(at / DT)
    on = np.arange(T) >= k
    sizes = dict(theta=4, theta_sd=4, gives=4, log_odds=len(hyp.names), probability=len(hyp.names), share=4, detectable=4, biases=4)
    sizes |= dict(innovation=4, innovation_var=4, onsets=4)
    shape = {name: (size,) for name, size in sizes.items()}
    kept = program.TickOutput(**{name: np.zeros((T, *shape.get(name, ()))) for name in program.TickOutput._fields})
    kept = kept._replace(announced=np.zeros(T, bool), active=np.zeros((T, 4, 4), bool))
    kept.share[:, 0] = 1.0
    kept.theta_sd[:] = 0.02
    if rotor is not None:
        kept.announced[k] = True
        kept.active[on, 0, rotor] = True
        kept.theta[on, rotor] = theta
        kept.onsets[:] = np.maximum(np.arange(T) - k + 5, 0)[:, None]
        kept.probability[k, rotor] = 1.0
    return kept


def test_the_command_refuses_what_it_cannot_do(tmp_path, capsys):
    plan = tmp_path / "plan.toml"
    plan.write_text('[scenario]\nduration_s = 40.0\n[scenario.airframe]\nframe = "quad-x"\n')
    for options, said in (
        (["--variants", "tenfold"], "give some of off, half, double"),
        (["--only", "nothing"], "No constant's name begins with nothing"),
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main(["ablate", str(plan), *options, "--quiet"])
        assert stop.value.code == 2 and said in " ".join(capsys.readouterr().err.split())


def test_the_table_says_what_changed():
    row = {"right": 0.5, "wrong": 0.0, "found": 1.0, "delay_s": 0.4, "rms": 0.01, "coverage": 0.9, "false_per_h": 0.0}
    reported = {"right": {"difference": -0.1, "sd": 0.02, "changed": 3}, "wrong": {"difference": 0.0, "sd": 0.0, "changed": 0},
            "false": {"difference": 0.5, "sd": 0.1, "changed": 1}}  # fmt: skip
    result = {
        "set": {"campaign": 4},
        "variants": {"as it is": row, "kalman.OUTLIER off": row},
        "differences": {"kalman.OUTLIER off": reported},
    }
    text = ablation.markdown(result)
    assert "50.0 % of the states right" in text
    (line,) = [line for line in text.splitlines() if "OUTLIER" in line]
    assert line.startswith("| `kalman.OUTLIER` | off | -10.0 ± 3.9 | 0 | - | +2 |")
