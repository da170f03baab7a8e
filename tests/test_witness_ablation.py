"""Witnesses left out one by one."""

import pytest

from conftest import hexa_event
from rotorwatch import airframes
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight
from rotorwatch.toolkit import witness
from rotorwatch_lab.campaign import plan, witness_ablation

PLAN = {"scenario": {"airframe": {"frame": "quad-x"}}}


def names():
    return [w.name for w in witness.registered()]


def test_a_witness_is_left_out_only_for_a_while():
    before = names()
    with pytest.raises(RuntimeError), witness_ablation.without("rivals"):
        assert names() == [name for name in before if name != "rivals"]
        raise RuntimeError
    assert names() == before and "rivals" in before


def test_who_changes_events_or_the_view_is_heard():
    def adds(view, before):
        view.warnings.append("a sentence")
        return before

    ones = {"quiet": lambda view, before: before, "adds": adds, "takes": lambda view, before: before[1:]}
    vehicle = airframes.named("ardupilot-quad-x")
    view = witness.View(Flight("t", "", {}, 60.0), vehicle, (), (), vehicle.effectiveness())
    events = hexa_event(onset_s=20.0), hexa_event(onset_s=30.0)
    for name, hear in ones.items():
        made = witness.Witness(name, witness.Stage.EVENTS, 0, hear)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(witness, "_registered", lambda _, made=made: (made,))
            with witness_ablation.listening() as heard:
                witness.ask(witness.Stage.EVENTS, view, events)
        assert heard == ({name} if name != "quiet" else set())


def test_flights_are_assessed_again_without_witnesses_that_were_heard(monkeypatch):
    every = witness_ablation.ALL
    rows = [("healthy", {every: "clean"}), ("healthy", {every: "clean", "rivals": "accused", "leaning": "clean"}),
            ("loss", {every: "right", "rivals": "among"})]  # fmt: skip
    monkeypatch.setattr(witness_ablation.tools, "gathered", lambda *_: rows)
    found = witness_ablation.run(plan.from_table({**PLAN, "assess": "log", "kinds": [{"name": "healthy"}]}), 3)
    base, without = found["names"][witness_ablation.ALL], found["names"]["rivals"]
    assert found["flights"] == 3 and base["changed"] == 0 and base["loss right"] == 1
    assert (without["healthy vehicle accused"], without["loss right"], without["heard"], without["changed"]) == (1, 0, 2, 2)
    text = witness_ablation.markdown(found)
    assert "| without `rivals` | 2 | +1 | +0 | +0 | -1 | +0 | +1 | +0 | 2 |" in text
    assert "| without `leaning` | 1 | +0 | +0 | +0 | +0 | +0 | +0 | +0 | 0 |" in text
    assert "`hindsight`" in text.split("Never heard here")[1]


def test_a_plan_of_ticks_is_refused():
    with pytest.raises(ConfigError, match="assess = 'log'"):
        witness_ablation.run(plan.from_table(PLAN), 3)
