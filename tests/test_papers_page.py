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


def test_every_claim_of_every_paper_has_a_row(data):
    assert [row["paper"] for row in data] == list(reproduction.studies())
    for row in data:
        wanted = reproduction.claimed(row["paper"])
        assert len(wanted) == len(row["claims"])
        for text, claim in zip(wanted, row["claims"], strict=True):
            assert claim["claim"].startswith(text.split("{")[0])
