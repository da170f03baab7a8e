"""A newcomer's way: from a copy of the checkout in an empty environment to an answer on an own log (newcomer.py)."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
QUAD = ROOT / "src/rotorwatch/samples/quadx_healthy_hover.bin.xz"

pytestmark = pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs a checkout by git")


def walk(*words):
    """(exit code, what is said) of newcomer.py."""
    done = subprocess.run([sys.executable, ROOT / "tests" / "newcomer.py", *words], capture_output=True, text=True, timeout=600)
    return done.returncode, done.stdout + done.stderr


def test_a_newcomer_has_an_answer_on_an_own_log(tmp_path):
    """With the packages that are here; that the whole takes less than two minutes is asked, too."""
    code, said = walk("--shared", QUAD)
    assert code == 0, said
    steps = re.findall(r"^ +\d+\.\d s  (.+)$", said, re.MULTILINE)
    assert steps[:2] == ["a copy of the checkout", "a wheel of it"] and steps[-1] == "rotorwatch diagnose LOG"
    assert "HEALTHY" in said and "my own quadx_healthy_hover.bin.xz" in said


@pytest.mark.thorough
def test_a_newcomer_without_anything_here(tmp_path):
    """All packages are fetched, and machine code is built from nothing."""
    code, said = walk()
    assert code == 0, said
    assert "FAULT FOUND  Rotor 3" in said and "rotorwatch demo" in said


@pytest.mark.thorough
def test_a_file_that_is_no_log_ends_the_walk(tmp_path):
    (tmp_path / "notes.bin").write_text("no flight")
    code, said = walk("--shared", tmp_path / "notes.bin")
    assert code == 1 and "not a flight log" in said and "Traceback" not in said
