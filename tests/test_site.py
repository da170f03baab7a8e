"""The documents' site: it is built without a warning, has a place for every page, and explains every parameter."""

import importlib.util
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import rotorwatch as rw

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def make_api():
    spec = importlib.util.spec_from_file_location("make_api", ROOT / "docs" / "make_api.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_parameter_of_a_public_name_is_explained(make_api):
    assert make_api.unexplained() == []


def test_the_reference_has_every_public_name(make_api):
    page, listed = make_api.page(), (ROOT / "docs" / "api.md").read_text()
    for name in set(rw.__all__) - {"__version__"}:
        assert f"\n## {name}\n" in f"\n{page}" and f"`{name}`" in listed, name
    rows = [row for row in page.splitlines() if row.startswith("| `")]
    assert len(rows) > 100


@pytest.mark.parametrize(
    ("docstring", "found"),
    [
        (
            "First.\n\na: one, two. b (n,): three; c: four. Raises X.",
            {"a": "one, two.", "b": "(n,) three", "c": "four."},
        ),
        ("First.\n\na and b: both. other: is none.", {"a": "both. other: is none.", "b": "both. other: is none."}),
        ("First: b: no start of a sentence.", {}),
    ],
)
def test_explanations_are_found_in_prose(make_api, docstring, found):
    assert make_api.explained(docstring, ["a", "b", "c"]) == found


def test_the_site_is_built_without_a_warning(tmp_path):
    """Every page is read and every link followed; no page is written, which would take three times as long."""
    pytest.importorskip("myst_parser")
    command = ["-m", "sphinx", "-q", "-W", "--keep-going", "-b", "dummy", "-c", "docs", ".", tmp_path]
    done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_the_navigation_has_the_four_parts():
    conf = runpy.run_path(str(ROOT / "docs" / "conf.py"))
    made = conf["navigation"]((ROOT / "docs" / "index.md").read_text(), "docs")
    assert re.findall(r":caption: (.*)", made) == ["Start", "Tutorials", "How-to", "Reference", "Explanation"]
    trees = "\n".join(re.findall(r"```{toctree}\n(.*?)```", made, re.DOTALL))
    assert "/README\n" in trees and "/docs/tutorials/first-log\n" in trees and "/CONTRIBUTING\n" in trees
