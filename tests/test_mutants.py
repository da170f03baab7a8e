"""The campaign of planted errors: which tests assess a file, and that its table is of errors as they are drawn."""

import csv
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import mutants

ROOT = Path(__file__).resolve().parents[1]


def test_every_file_in_it_has_tests_of_its_own():
    for files in mutants.parts().values():
        assert files
        for file in files:
            assert mutants.tests_of(file), f"no tests are named for {file}: tests/test_<name>.py, or a row of mutants.NAMED"
    assert sum(share for _, share in mutants.PARTS.values()) == pytest.approx(1.0)
    assert [m.file for m in mutants.by_hand() if not mutants.tests_of(m.file)] == []


def test_the_tests_that_are_named_exist():
    for names in mutants.NAMED.values():
        assert all((ROOT / "tests" / f"test_{name}.py").exists() for name in names), names
    assert mutants.tests_of("engine/motion/tick_table.py") == ("tests/test_ticks.py",)


def test_the_campaign_itself_loads_nothing_of_the_package():
    """What it had loaded would be tried in place of the changed copy, and no error would be caught."""
    lines = "import sys; sys.path.insert(0, 'tests'); import mutants; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", lines], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "mutants" in done.stdout.split()
    assert [name for name in done.stdout.split() if name.partition(".")[0] == "rotorwatch"] == []


def test_the_table_tells_every_survivor_apart():
    rows = mutants.read(ROOT / mutants.TABLE)
    assert len(rows) > 100 and len({row.key for row in rows}) == len(rows)
    parts = mutants.parts()
    for row in rows:
        assert row.outcome in (mutants.CAUGHT, mutants.SURVIVED) and bool(row.test) == (row.outcome == mutants.CAUGHT)
        assert row.explanation if row.outcome == mutants.SURVIVED else not row.explanation, row
        assert row.part == mutants.HAND or row.file in parts[row.part] or not (ROOT / mutants.SOURCE / row.file).exists()
    with (ROOT / mutants.TABLE).open(encoding="utf-8", newline="") as file:
        assert tuple(next(csv.reader(file))) == mutants.FIELDS
    page = (ROOT / "docs" / "mutants.md").read_text(encoding="utf-8")
    assert mutants.figures(rows) in page, "docs/mutants.md has other figures than docs/mutants.csv"


SOURCE = '''"""Text with 3 numbers."""
from __future__ import annotations
@decorated(1)
def f(x: int | None = None, width=2) -> list[1]:
    if x is None or x < 4:
        raise ValueError(f"at least {2 + 2}")
    return draw(x + 5, line_width=6)
'''


def test_what_nobody_would_notice_is_left_out():
    """Type hints, decorators, the words of an exception, measures of a page; the rest is there."""
    pytest.importorskip("cosmic_ray")
    found = Counter((name.partition("_")[0], line) for name, _, line in mutants.places(SOURCE))
    assert {line for _, line in found} == {4, 5, 7}
    assert found["NumberReplacer", 4] == 2  # a default is no type hint
    assert found["NumberReplacer", 5] == 2 and found["NumberReplacer", 7] == 2  # 5 and not 6
    assert found["ReplaceBinaryOperator", 7] == 1 and found["ReplaceOrWithAnd", 5] == 1


def test_a_sample_is_the_same_for_the_same_seed(monkeypatch):
    pytest.importorskip("cosmic_ray")
    monkeypatch.setattr(mutants, "parts", lambda: {"campaign": ("rotorwatch_lab/campaign/__init__.py", "rotorwatch_lab/campaign/score.py")})
    few = mutants.ranked("campaign", 5)[:7]
    assert few == mutants.ranked("campaign", 5)[:7] != mutants.ranked("campaign", 6)[:7]
    source = (ROOT / mutants.SOURCE / few[0][1]).read_text(encoding="utf-8")
    changed = mutants.changed(source, few[0][2], few[0][3])
    assert changed and sum(a != b for a, b in zip(source.splitlines(), changed.splitlines())) == 1
