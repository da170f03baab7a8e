"""The page of methods lists what discovery finds, and links the page of each method that has one."""

import re
from pathlib import Path

from rotorwatch.base import discovery
from script_files import loaded

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "methods" / "index.md"


def maker():
    return loaded(ROOT / "docs" / "make_methods.py")


def test_every_method_is_listed_with_its_page():
    text = PAGE.read_text()
    rows = dict(re.findall(r"^\| (?:\[)?`(\w+)`(\]\(\w+\.md\))? \|", text, re.MULTILINE))
    assert set(rows) == set(discovery.estimators()), "run docs/make_methods.py"
    for name, link in rows.items():
        assert bool(link) == (PAGE.parent / f"{name}.md").exists(), f"{name}: run docs/make_methods.py"


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#\s]+)\)", PAGE.read_text()):
        assert (PAGE.parent / target).exists(), target


def test_the_table_is_made_where_the_marks_are(monkeypatch):
    make = maker()
    plants = make.plants()
    monkeypatch.setattr(make, "plants", lambda: {k: plants[k] for k in ("rate_dynamics", "rigid_body")})
    kinds = {k: discovery.estimator(k) for k in ("default", "ekf", "lyapunov")}
    monkeypatch.setattr(discovery, "estimators", lambda: kinds)
    page = f"before\n{make.START}stale row\n{make.END}after\n"
    filled = make.filled(page)
    assert filled.startswith("before\n") and filled.endswith("after\n") and "stale row" not in filled
    assert "All take every plant, except `default`: `wrench_balance`; `lyapunov`: `rate_dynamics`." in filled
    assert "Augmented extended Kalman filter |" in filled


def test_a_method_that_needs_more_than_a_plant_has_is_not_said_to_take_it():
    from rotorwatch.errors import ConfigError

    class Picky:
        def __init__(self, system, dt):
            if system != "good":
                raise ConfigError("no.")

    assert maker().defined_for(Picky, {"a": "good", "b": "bad"}) == ["a"]
