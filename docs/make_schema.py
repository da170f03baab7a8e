"""Write docs/diagnosis.schema.json, the JSON schema of `rotorwatch diagnose --json`, from the tables of docs/json.md:

    python docs/make_schema.py

The type of a field is the first word of its entry there; `or null` and `?` as the page explains them. Unknown fields stay allowed, since
new ones may come.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from rotorwatch.answer import fitness
from rotorwatch.base import files
from rotorwatch.flight.diagnosis import SCHEMA

HERE = Path(__file__).parent
PAGE, TARGET = HERE / "json.md", HERE / "diagnosis.schema.json"
NUMBER, TEXT, WHOLE = {"type": "number"}, {"type": "string"}, {"type": "integer"}
INTERVAL = {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2}
# First word of a type -> its schema; every other one is a number with a unit.
TYPES: dict[str, dict[str, Any]] = {
    "object": {"type": "object"}, "string": TEXT, "integer": WHOLE, "boolean": {"type": "boolean"}, "true": {"type": "boolean"},
    "list": {"type": "array"}, "lists": {"type": "array"}, "strings": {"type": "array", "items": TEXT},
    "integers": {"type": "array", "items": WHOLE}, "shares": {"type": "array", "items": NUMBER}, "interval": INTERVAL,
    "intervals": {"type": "array", "items": INTERVAL}, "of": {"type": "array", "items": INTERVAL},
}  # fmt: skip
EMPTY = {"common_mode"}  # objects that may be empty
VALUES = {"schema": {"const": SCHEMA}, "fit_to_fly.word": {"enum": [fitness.FLY, fitness.LOOK, fitness.DO_NOT, fitness.CANNOT]}}


def rows(text: str) -> list[tuple[str, str, bool]]:
    """(path, type, may be absent) of every field of a diagnosis, in the order of the page."""
    section = text.split("## Fields\n")[1].split("\n## ")[0]
    always, _, sometimes = section.partition("### Additional fields of events")
    found = []
    for part, absent in ((always, False), (sometimes, True)):
        for field, kinds, _ in re.findall(r"^\| `([^`]+)` \| (.*?) \| (.*?) \|$", part, re.MULTILINE):
            paths, each = spelled_out(field), [kind.strip() for kind in kinds.split(";")]
            each = each if len(each) == len(paths) else [each[k % len(each)] for k in range(len(paths))]
            found += [(path, kind, absent or "?" in kind) for path, kind in zip(paths, each, strict=True)]
    return found


def spelled_out(field: str) -> list[str]:
    """`rates.{roll,pitch}_dps` as both of its paths."""
    first, brace, rest = field.partition("{")
    choices, _, last = rest.partition("}")
    return [first + choice + end for choice in choices.split(",") for end in spelled_out(last)] if brace else [field]


def node(kind: str) -> dict[str, Any]:
    """The schema of a type in words."""
    one = TYPES.get(re.split(r"[ ,?]", kind)[0], NUMBER)
    return {"anyOf": [dict(one), {"type": "null"}]} if "null" in kind else json.loads(json.dumps(one))


def inside(schema: dict[str, Any], step: str) -> dict[str, Any]:
    """The schema of a property, or of the elements of a list (`[]`)."""
    schema = schema["anyOf"][0] if "anyOf" in schema else schema
    return schema.setdefault("items", {"type": "object"}) if step == "[]" else schema.setdefault("properties", {})[step]


def schema(text: str) -> dict[str, Any]:
    """The whole schema from the page's text."""
    whole: dict[str, Any] = {
        "$schema": "https://json-schema.org/draft/2020-12/schema", "title": "rotorwatch diagnosis", "type": "object", "required": [],
    }  # fmt: skip
    for path, kind, absent in sorted(rows(text), key=lambda row: row[0].count(".") + row[0].count("[]")):
        *parents, name = path.replace("[]", ".[]").split(".")
        at = whole
        for step in parents:
            at = inside(at, step)
        at = at["anyOf"][0] if "anyOf" in at else at
        at.setdefault("properties", {})[name] = node(kind) | VALUES.get(path, {})
        if not absent and path.partition(".")[0] not in EMPTY - {path}:
            at.setdefault("required", []).append(name)
    return whole


def main() -> None:
    with files.replacing(TARGET) as unfinished:
        unfinished.write_text(json.dumps(schema(PAGE.read_text(encoding="utf-8")), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
