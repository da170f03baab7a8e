"""docs/papers.md is made from the claims' data, and has a row for every claim of the five papers."""

import json
import re
from pathlib import Path

import pytest

from rotorwatch.base import files
from rotorwatch_lab.experiments.studies import reproduction
from script_files import loaded

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def make():
    return loaded(DOCS / "make_papers.py")


@pytest.fixture(scope="module")
def data(make):
    return json.loads(make.DATA.read_text(encoding="utf-8"))


def test_the_page_is_what_the_data_says(make, data):
    assert make.PAGE.read_text(encoding="utf-8") == make.page(data)


def test_long_tables_have_a_file(make, data):
    found = make.long_tables(data)
    assert found and all(f"({name})" in make.page(data) for name in found)
    assert all((DOCS / name).read_text(encoding="utf-8") == text for name, text in found.items())


def test_other_data_give_another_page(make, data):
    other = json.loads(json.dumps(data))
    other[0]["claims"][0]["verdict"] = "refuted"
    other[0]["claims"][0]["measured"] = "a | b"
    assert "| a \\| b | refuted |" in make.page(other) != make.page(data)


def test_claims_that_were_assessed_for_several_forms_have_a_table_of_them(make, data):
    row = next(row for row in data if row["paper"] == "aesmf")
    head, *lines = make.by_form(row["forms"])
    known = {claim["claim"]: claim["verdict"] for claim in row["claims"]}
    assert [line[0] for line in lines] == list(row["forms"]) and "papers-aesmf-forms.csv" in make.page([row])
    for claim, *words in lines:
        verdicts = row["forms"][claim]
        assert dict(zip(head[1:], words, strict=True)) == {
            label: make.WORDS.get(verdicts.get(label, ""), verdicts.get(label, "")) for label in head[1:]
        }
        assert known[claim] == reproduction.across(verdicts) or known[claim] == "partly"


def test_one_verdict_of_several():
    def across(*verdicts):
        return reproduction.across(dict(zip("abc", verdicts)))

    assert across("holds", "holds") == "holds" and across("refuted", "refuted") == "refuted"
    assert across("holds", "refuted") == across("not reproduced", "partly") == "partly"
    assert across("not reproduced", "refuted") == "not reproduced"


def test_a_verdict_says_its_condition_and_tables_are_shown(make, data):
    other = json.loads(json.dumps(data))
    other[0]["claims"][0] |= {"verdict": "partly", "only_if": "it is calm"}
    other[0]["tables"] = [{"title": "Numbers", "head": ["a", "b"], "rows": [["1", "2"]]}]
    page = make.page(other)
    assert "| only if it is calm |" in page and "Numbers:\n\n| a | b |\n|---|---|\n| 1 | 2 |" in page


def test_a_folder_with_one_paper_leaves_the_others_as_they_are(make, data, tmp_path):
    whole = {"paper": "atsukf", "title": "t", "seeds": 1, "claims": [], "figures": {}}
    (tmp_path / "atsukf.json").write_text(json.dumps(whole), encoding="utf-8")
    now = make.rows(tmp_path, data)
    assert [a == b for a, b in zip(now, data, strict=True)] == [row["paper"] != "atsukf" for row in data]


def test_equations_tables_and_figures_lead_to_what_is_there(make, data):
    """Every file is there and has the names; every picture is; figures and table numbers are in order, and no figure is left out."""
    parts, source = files.toml(make.PARTS, "parts")[0], DOCS.parent / "src"
    assert set(parts) == {row["paper"] for row in data}
    last = {"aesmf": 9, "atsukf": 8, "axkf": 9, "intermediate": 18, "lyapunov-mhe": 2}  # figures in print
    for paper, found in parts.items():
        for _, _, code, _ in found["equations"] + found["tables"]:
            file = None
            for piece in re.split(r",\s*", code):
                name = piece
                if "/" in piece:
                    file, _, name = piece.partition(": ")
                    assert (source / file).is_file(), piece
                assert file and re.search(rf"\b{name}\b" if name else "", (source / file).read_text(encoding="utf-8")), (file, name)
        numbers = [int(n) for number, *_ in found["figures"] for n in re.findall(r"\d+", number)]
        assert sorted(numbers) == list(range(1, last[paper] + 1))
        for _, _, picture in found["figures"]:
            assert " " in picture or (DOCS / "methods" / f"{picture}.svg").exists(), picture


def test_literal_readings_that_the_page_names_are_there(make):
    for paper, found in files.toml(make.PARTS, "parts")[0].items():
        for *_, note in found["equations"] + found["tables"]:
            if "--literal" in note:
                names = re.findall(r"`(?:--literal )?([\w-]+)`", note)
                assert names and set(names) <= set(reproduction.about(paper)[1]), note


def test_every_claim_of_every_paper_has_a_row(data):
    assert [row["paper"] for row in data] == list(reproduction.studies())
    for row in data:
        wanted = reproduction.claimed(row["paper"])
        assert len(wanted) == len(row["claims"])
        for text, claim in zip(wanted, row["claims"], strict=True):
            assert claim["claim"].startswith(text.split("{")[0])
