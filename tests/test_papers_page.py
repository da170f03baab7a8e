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


def test_claims_that_were_judged_for_several_forms_have_a_table_of_them(make, data):
    row = next(row for row in data if row["paper"] == "aesmf")
    told = make.page([row])
    known = {claim["claim"]: claim["verdict"] for claim in row["claims"]}
    assert row["forms"]
    for claim, verdicts in row["forms"].items():
        words = [make.WORDS.get(verdict, verdict) for verdict in verdicts.values()]
        assert f"| claim | {' | '.join(verdicts)} |" in told and f"| {claim} | {' | '.join(words)} |" in told
        assert known[claim] == reproduction.across(verdicts) or known[claim] == "partly"


def test_a_paper_without_a_new_result_keeps_its_row(make, data, tmp_path):
    new = {**data[1], "seeds": 99, "figures": {}, "literal": []}
    (tmp_path / f"{new['paper']}.json").write_text(json.dumps(new))
    found = make.rows(tmp_path, data)
    assert [row == old for row, old in zip(found, data, strict=True)] == [True, False, True, True, True]
    assert found[1]["seeds"] == 99 and "figures" not in found[1]


def test_one_verdict_of_several():
    def across(*verdicts):
        return reproduction.across(dict(zip("abc", verdicts)))

    assert across("holds", "holds") == "holds" and across("refuted", "refuted") == "refuted"
    assert across("holds", "refuted") == across("not reproduced", "partly") == "partly"
    assert across("not reproduced", "refuted") == "not reproduced"


def test_every_claim_of_every_paper_has_a_row(data):
    assert [row["paper"] for row in data] == list(reproduction.studies())
    for row in data:
        wanted = reproduction.claimed(row["paper"])
        assert len(wanted) == len(row["claims"])
        for text, claim in zip(wanted, row["claims"], strict=True):
            assert claim["claim"].startswith(text.split("{")[0])
