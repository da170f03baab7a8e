"""docs/ranking.md is made of the results in benchmarks/results, and results that their seeds do not give are refused."""

import functools
import json
from pathlib import Path

import pytest

from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import benchmark, benchmark_plan, results_file
from script_files import loaded
from test_benchmark import SMALL

pytest.importorskip("pyarrow")
DOCS = Path(__file__).parents[1] / "docs"
PLAN = SMALL.replace("flights = 4", "flights = 3")


@pytest.fixture(scope="module")
def make():
    return loaded(DOCS / "make_ranking.py")


@pytest.fixture(scope="module")
def entered(make):
    return sorted(make.RESULTS.glob("*.json"))


def test_the_page_is_what_the_results_say(make, entered):
    assert entered and make.PAGE.read_text(encoding="utf-8") == make.page(entered)


def test_entered_results_are_of_the_plan_and_of_methods_that_are_there(make, entered):
    """A method is rotorwatch's, a package's with a version, or a file of the results' name beside them."""
    for path in entered:
        results = results_file.read(path)
        assert results["plan"]["sha256"] == benchmark_plan.read("quick").sha256, path.name
        for method in results["methods"]:
            assert method["version"] or (path.with_suffix(".py").exists() and method["path"].startswith(f"{path.stem}:")), method["name"]


def test_results_that_their_seeds_do_not_give_are_refused(make, monkeypatch, tmp_path):
    path = tmp_path / "mine.json"
    monkeypatch.setattr(benchmark, "run", functools.partial(benchmark.run, jobs=1))  # processes of its own would compile all again
    monkeypatch.setattr(benchmark, "REPEATS", 1)
    results = benchmark.run(benchmark_plan.parsed(PLAN, "three"), ["ardupilot-thrust-loss", "default"], path)
    again = []
    fly = benchmark.run
    monkeypatch.setattr(benchmark, "run", lambda *what: again.append(fly(*what)) or again[-1])
    assert make.check(path) == []
    monkeypatch.setattr(benchmark, "run", lambda *_: again[0])  # a third time gives what the second has given
    (own,) = (method for method in results["methods"] if method["name"] == "default")
    own["scores"]["found_flights"] = sorted({0, 1, 2} - set(own["scores"]["found_flights"]))
    own["scores"]["healthy_h"] *= 1.5
    path.write_text(json.dumps(results))
    first, second = make.check(path)
    assert first.startswith("mine.json: default: healthy_h is ") and second.startswith("mine.json: default: found_flights is a list of ")


@pytest.mark.thorough
def test_the_cheapest_entry_is_computed_again(make, entered):
    assert make.check(make.RESULTS / "slow_observer.json") == []


def test_what_rounding_may_change(make):
    assert make._alike(0.5, 0.505, 64) and not make._alike(0.5, 0.55, 64) and not make._alike(None, 0.5, 64) and make._alike(None, None, 64)
    assert make._alike([1, 2], [1], 64) and not make._alike([1, 2, 3], [1], 64)
    assert make._alike({"value": 1.0, "low": 0.0}, {"value": 1.0, "low": 0.9}, 64) and not make._alike({"value": 1.0}, {"value": 1.1}, 64)
    assert make._alike({"3": 0.1}, {"3": 0.101}, 64) and not make._alike({"3": 0.1, "4": 0.1}, {"3": 0.2, "5": 0.1}, 64)
    assert make._alike({}, None, 64) is False


def test_a_file_that_is_no_result_is_one_sentence(make, tmp_path):
    (tmp_path / "x.json").write_text("{}")
    with pytest.raises(ConfigError, match="holds no results of a benchmark"):
        make.check(tmp_path / "x.json")
