"""docs/json.md names every field of the JSON, and no other."""

import json
import re
from pathlib import Path

import pytest

from conftest import hexa_diagnosis
from rotorwatch.flight import Message
from rotorwatch.report.info import info
from test_cli import a_flight

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs/json.md").read_text(encoding="utf-8")


def spelled_out(field):
    """`rates.{roll,pitch}_dps` as both of its names."""
    first, brace, rest = field.partition("{")
    choices, _, last = rest.partition("}")
    return [first + choice + end for choice in choices.split(",") for end in spelled_out(last)] if brace else [field]


def documented(heading):
    """{field: (type, meaning)} of the tables under that heading; a type that ends in ? may be absent."""
    section = TEXT.split(f"## {heading}")[1].split("\n## ")[0]
    always, _, sometimes = section.partition("### Additional fields of events")
    found = {}
    for part, mark in ((always, ""), (sometimes, "?")):
        rows = re.findall(r"^\| `([^`]+)` \| (.*?) \| (.*?) \|$", part, re.MULTILINE)
        found |= {name: (kind + mark, meaning) for field, kind, meaning in rows for name in spelled_out(field)}
    return found


def fields(value, table, path=""):
    """Paths of all fields in a JSON value; free objects are not looked into."""
    if isinstance(value, dict) and "free" not in table.get(path, ("",))[0]:
        for key, inner in value.items():
            here = f"{path}.{key}" if path else key
            yield here
            yield from fields(inner, table, here)
    elif isinstance(value, list) and not path.endswith("geometry"):
        for inner in value:
            yield from fields(inner, table, f"{path}[]")


def check(value, heading):
    table = documented(heading)
    found = set(fields(value, table))
    assert found - set(table) == set(), "fields that docs/json.md does not name"
    owners = {"", *(field.rpartition(".")[0] for field in found)}  # objects that are there and not empty
    required = {f for f, (kind, _) in table.items() if "?" not in kind and f.rpartition(".")[0] in owners}
    assert required - found == set(), "documented fields that are not there"


def test_diagnosis_has_the_documented_fields():
    check(json.loads(hexa_diagnosis().to_json()), "Fields")


def test_info_has_the_documented_fields():
    facts = info(a_flight(messages=(Message(1.0, "mode", "LAND"),)))
    check(json.loads(json.dumps(facts, allow_nan=False)), "Fields of `rotorwatch info LOG --json`")


@pytest.mark.parametrize("kind", ["number", "share", "s", "string", "list", "integer"])
def test_types_are_stated(kind):
    assert any(kind in entry[0] for entry in documented("Fields").values())


def test_a_real_diagnosis_has_the_documented_fields():
    samples = sorted((ROOT / "src/rotorwatch/samples").glob("*mul*.bin.xz"))
    if not samples:
        pytest.skip("the package carries no sample flight yet")
    import rotorwatch

    result = json.loads(rotorwatch.diagnose(samples[0]).to_json())
    check(result, "Fields")
    assert result["timing"]["read_s"] > 0 and result["timing"]["total_s"] >= result["timing"]["read_s"]
