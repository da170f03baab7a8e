"""Blackbox logs of a vehicle that never hovers through the command line: what assesses them, and what says that it cannot."""

import json

import pytest

import blackbox_writer as writer
from rotorwatch.commands.cli import main
from rotorwatch_lab.simulation import fpv


@pytest.fixture(scope="module")
def log(tmp_path_factory, amount):
    seconds = amount(25.0, 60.0)
    return str(writer.simulated(fpv.fly(1, seconds, 11, rpm=True)[0], tmp_path_factory.mktemp("fpv") / "quad.bbl"))


def run(capsys, *words):
    """(exit code, standard output, standard error) of the program."""
    code = 0
    try:
        main(list(words))
    except SystemExit as end:
        code = end.code or 0
    shown = capsys.readouterr()
    return code, shown.out, " ".join(shown.err.split())


@pytest.mark.thorough
def test_inject_assesses_as_diagnose_does(log, capsys):
    """In hover's way nothing of such a flight is assessed; a rotor that loses half of its thrust is found in most of it."""
    code, out, _ = run(capsys, "inject", log, "--loss", "0.5", "--repeats", "2", "--jobs", "1", "--json", "-q")
    (row,) = (shown := json.loads(out))["table"]
    assert code == 0 and shown["healthy"]["false_alarms"] == row["false_alarms"] == 0
    assert shown["healthy"]["hours"] * 3600.0 > 35.0
    assert row["injections"] == 8 and row["detected"] >= 0.75 and row["right"] == 1.0


@pytest.mark.thorough(keep=3)
@pytest.mark.parametrize(("words", "why"), [
    (("compare", "--seeds", "0"), ("does not hover", "published methods model hover")),
    (("watch", "--speed", "max", "--jsonl"), ("firmware without a telemetry link", "`rotorwatch diagnose`")),
    (("false-alarms", "--hours", "0.1"), ("does not hover", "noise of hover")),
    (("diagnose", "--estimator", "ekf"), ("does not hover", "leave out the estimator")),
    (("tune", "--estimator", "ekf"), ("does not hover", "published methods model hover")),
])  # fmt: skip
def test_what_is_made_for_hover_says_so(log, capsys, words, why):
    code, out, err = run(capsys, words[0], log, *words[1:])
    assert (code, out) == (2, "") and all(words in err for words in ("quad.bbl", *why))


def test_calibrate_says_what_it_cannot_learn(log, capsys, tmp_path):
    code, out, err = run(capsys, "calibrate", log, "-o", str(tmp_path / "quad.toml"))
    assert code == 0 and "learned from 1 flight" in out and "does not hover: only its airframe is used" in err
    code, out, _ = run(capsys, "diagnose", log, "--vehicle", str(tmp_path / "quad.toml"), "--json", "-q")
    answer = json.loads(out)  # of half a minute the bound may be too large for `healthy`
    assert code in (0, 3) and not [e for e in answer["events"] if e["rotors"]]


def test_a_fleet_keeps_them(log, capsys, tmp_path):
    store = ("--store", str(tmp_path / "fleet.db"))
    code, _, err = run(capsys, "fleet", "add", log, "--aircraft", "racer", "--jobs", "1", *store)
    assert code == 0 and "1 added" in err
    code, out, _ = run(capsys, "fleet", "show", "racer", *store)
    assert code == 0 and "racer" in out
