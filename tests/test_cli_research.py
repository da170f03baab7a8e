"""The research commands from outside: `rotorwatch reproduce` and `rotorwatch observability`."""

import json
import threading
import time
from types import SimpleNamespace

import pytest

from rotorwatch.base import many
from rotorwatch.base.many import processes
from rotorwatch_lab.commands import research
from rotorwatch_lab.experiments.studies import reproduction
from rotorwatch_lab.experiments.studies.reproduction import Claim, Reproduction


class Drawing:
    def savefig(self, path, metadata):
        path.write_text("<svg/>")


def fake(paper):
    def reproduce(seeds, literal=(), progress=None):
        progress(0.25, "first part")
        claim = Claim("It converges.", "0.30", f"0.31 over {seeds}", "holds", "The gain is the printed one.")
        forms = {"It converges.": {"as printed": "refuted", "mended": "holds"}}
        return Reproduction(paper, f"Title of {paper}", (claim,), {"p": float("nan")}, literal, seeds, forms=forms)

    return SimpleNamespace(PAPER=paper, LITERAL={"sign": "as printed"}, SEEDS=7, reproduce=reproduce, figures=lambda _: {"one": Drawing()})


@pytest.fixture(autouse=True)
def studies(monkeypatch):
    monkeypatch.setattr(reproduction, "studies", lambda: {name: fake(name) for name in ("axkf", "aesmf")})


def test_table_of_claims(run):
    code, out, _ = run("reproduce", "axkf")
    assert code == 0
    for words in ("Title of axkf", "It converges.", "0.30", "0.31 over 7", "holds", "The gain is the printed one."):
        assert words in out


def test_claims_assessed_for_several_forms_have_a_table(run):
    _, out, _ = run("reproduce", "axkf")
    assert all(words in out for words in ("as printed", "mended", "refuted"))
    _, out, _ = run("reproduce", "axkf", "--json")
    assert json.loads(out)["forms"] == {"It converges.": {"as printed": "refuted", "mended": "holds"}}


@pytest.mark.parametrize("paper", ["axkf", "all"])
def test_each_step_is_a_line_where_no_bar_moves(run, paper):
    _, _, err = run("reproduce", paper, "--jobs", 1)
    assert "axkf: 25% done; first part" in err
    _, _, err = run("reproduce", paper, "--jobs", 1, "--quiet")
    assert "first part" not in err


def test_a_condition_and_a_studys_tables_are_shown(run, monkeypatch):
    study = fake("axkf")
    claim = Claim("It converges.", "0.30", "0.31", "partly", "Why.", "it is calm")
    study.reproduce = lambda seeds, literal=(), progress=None: Reproduction("axkf", "Title", (claim,), {"n": 3})
    study.tables = lambda figures: [reproduction.Table("Numbers", ["a", "b"], [["1", str(figures["n"])]])]
    monkeypatch.setattr(reproduction, "studies", lambda: {"axkf": study})
    code, out, _ = run("reproduce", "axkf")
    assert code == 0 and "holds only if it is calm" in " ".join(out.split()) and "Numbers" in out and "3" in out


def test_json_of_one_is_an_object(run):
    code, out, _ = run("reproduce", "axkf", "--json", "--seeds", 2, "--literal", "sign")
    one = json.loads(out)
    assert code == 0 and one["paper"] == "axkf" and one["seeds"] == 2 and one["literal"] == ["sign"]
    assert one["figures"] == {"p": None} and one["claims"][0]["verdict"] == "holds"


@pytest.mark.parametrize("jobs", [1, 2])
def test_all_papers_keep_their_order(run, monkeypatch, jobs):
    def last_first(function, tasks, *_):
        return (many.Done(task.index, function(task.item)) for task in reversed(list(tasks)))

    monkeypatch.setattr(processes, "run", last_first)
    code, out, _ = run("reproduce", "all", "--json", "--jobs", jobs, "--seeds", 3)
    found = json.loads(out)
    assert code == 0 and [item["paper"] for item in found] == ["axkf", "aesmf"]
    assert [item["seeds"] for item in found] == [3, 3]


def test_figures_are_written_and_named(run, tmp_path):
    code, _, err = run("reproduce", "axkf", "--figures", tmp_path / "new")
    assert code == 0 and (tmp_path / "new" / "one.svg").exists() and "one.svg" in err


def test_what_is_kept_is_not_run_again(run, tmp_path, monkeypatch):
    argv = ("reproduce", "--all", "--json", "--jobs", 1, "-o", tmp_path)
    _, first, _ = run(*argv)
    (tmp_path / "aesmf.json").unlink()  # as after an interruption: one paper is left
    ran = []
    whole = reproduction.reproduce
    monkeypatch.setattr(reproduction, "reproduce", lambda paper, *a, **k: ran.append(paper) or whole(paper, *a, **k))
    code, second, err = run(*argv)
    assert code == 0 and ran == ["aesmf"] and second == first and "axkf: read from" in err
    run(*argv, "--seeds", 2)
    assert ran == ["aesmf", "axkf", "aesmf"]  # other seeds are another result


def test_a_long_run_says_that_it_runs(run, monkeypatch):
    """What is run and how long it may take at once; then, now and then, that it still is, until it is over."""
    monkeypatch.setattr(research, "EVERY_S", 0.02)
    whole = reproduction.reproduce
    monkeypatch.setattr(reproduction, "reproduce", lambda *a, **k: time.sleep(0.2) or whole(*a, **k))
    code, _, err = run("reproduce", "all", "--jobs", 1)
    first, *others = err.splitlines()
    assert code == 0 and "running axkf, aesmf: about" in first
    assert sum("still running, after 0 min" in line for line in others) > 3
    before = threading.active_count()
    _, _, err = run("reproduce", "axkf", "--quiet")
    assert err == "" and threading.active_count() == before


def test_a_result_is_kept_before_its_turn_comes(tmp_path):
    """An interruption while the first paper runs loses nothing of what was done beside it."""
    for later in ("aesmf", "axkf"):
        reproduction._reproduced(later, 2, tmp_path, None)
        assert reproduction.kept(tmp_path, reproduction.studies()[later], 2, ()) is not None


def test_a_kept_file_that_is_none_is_said(run, tmp_path):
    (tmp_path / "axkf.json").write_text("{}")
    code, _, err = run("reproduce", "axkf", "-o", tmp_path)
    assert code == 2 and "axkf.json is no result of a study" in err


def test_help_names_papers_and_readings(run):
    code, out, _ = run("reproduce", "--help")
    assert code == 0
    for paper in ("axkf", "aesmf"):
        title, readings = reproduction.about(paper)
        assert f"{paper}: {title[:30]}" in out and all(f"--literal {name}" in out for name in readings)


@pytest.mark.parametrize(
    "argv, words",
    [
        (("akf",), "is a method, not a paper; it is tried in axkf"),
        ((), "Name a paper, or give --all"),
        (("axkf", "--all"), "exclude each other"),
        (("nonsense",), "known are axkf, aesmf"),
        (("axkf", "--literal", "nonsense"), "it has sign"),
        (("all", "--literal", "sign"), "belongs to one paper"),
    ],
)
def test_what_does_not_exist_is_one_sentence(run, argv, words):
    code, out, err = run("reproduce", *argv)
    assert code == 2 and out == "" and words in err
