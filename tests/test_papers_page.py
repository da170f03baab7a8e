"""docs/papers.md is made from the claims' data, and has a row for every claim of the five papers."""

import importlib.util
import json
from pathlib import Path

import pytest

from rotorwatch.lab.experiments.studies import reproduction

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def make():
    spec = importlib.util.spec_from_file_location("make_papers", DOCS / "make_papers.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data(make):
    return json.loads(make.DATA.read_text(encoding="utf-8"))


def test_the_page_is_what_the_data_says(make, data):
    assert make.PAGE.read_text(encoding="utf-8") == make.page(data)


def test_other_data_give_another_page(make, data):
    other = json.loads(json.dumps(data))
    other[0]["claims"][0]["verdict"] = "refuted"
    other[0]["claims"][0]["measured"] = "a | b"
    assert "| a \\| b | refuted |" in make.page(other) != make.page(data)


def test_a_verdict_says_its_condition_and_tables_are_shown(make, data):
    other = json.loads(json.dumps(data))
    other[0]["claims"][0] |= {"verdict": "partly", "only_if": "it is calm"}
    other[0]["tables"] = [{"title": "Numbers", "head": ["a", "b"], "rows": [["1", "2"]]}]
    page = make.page(other)
    assert "| holds only if it is calm |" in page and "Numbers:\n\n| a | b |\n|---|---|\n| 1 | 2 |" in page


def test_a_folder_with_one_paper_leaves_the_others_as_they_are(make, data, tmp_path):
    whole = {"paper": "atsukf", "title": "t", "seeds": 1, "claims": [], "figures": {}}
    (tmp_path / "atsukf.json").write_text(json.dumps(whole), encoding="utf-8")
    now = make.rows(tmp_path, data)
    assert [a == b for a, b in zip(now, data, strict=True)] == [row["paper"] != "atsukf" for row in data]


def test_every_claim_of_every_paper_has_a_row(data):
    assert [row["paper"] for row in data] == list(reproduction.studies())
    for row in data:
        wanted = reproduction.claimed(row["paper"])
        assert len(wanted) == len(row["claims"])
        for text, claim in zip(wanted, row["claims"], strict=True):
            assert claim["claim"].startswith(text.split("{")[0])
