"""Witnesses left out one by one."""

import pytest

from rotorwatch.errors import ConfigError
from rotorwatch.toolkit import witness
from rotorwatch_lab.campaign import plan, witness_ablation

PLAN = {"scenario": {"airframe": {"frame": "quad-x"}}}


def names():
    return [w.name for w in witness.registered()]


def test_a_witness_is_left_out_only_for_a_while():
    before = names()
    with pytest.raises(RuntimeError), witness.without("rivals"):
        assert names() == [name for name in before if name != "rivals"]
        raise RuntimeError
    assert names() == before and "rivals" in before


def test_each_flight_is_judged_without_each_witness(monkeypatch):
    quiet = dict.fromkeys([witness_ablation.ALL, *names()], "clean")
    right = dict.fromkeys(quiet, "right")
    rows = [("healthy", quiet), ("healthy", quiet | {"rivals": "accused"}), ("loss", right | {"rivals": "among"})]
    monkeypatch.setattr(witness_ablation.tools, "gathered", lambda *_: rows)
    found = witness_ablation.run(plan.from_table({**PLAN, "judge": "log", "kinds": [{"name": "healthy"}]}), 3)
    base, without = found["names"][witness_ablation.ALL], found["names"]["rivals"]
    assert found["flights"] == 3 and base["changed"] == 0 and base["fault right"] == 1
    assert (without["healthy rotor accused"], without["fault right"], without["fault ambiguous"], without["changed"]) == (1, 0, 1, 2)
    text = witness_ablation.markdown(found)
    assert "| without `rivals` | +1 | +0 | -1 | +1 | 2 |" in text and "`hindsight`" in text.split("Without effect here")[1]


def test_a_plan_of_ticks_is_refused():
    with pytest.raises(ConfigError, match="judge = 'log'"):
        witness_ablation.run(plan.from_table(PLAN), 3)
