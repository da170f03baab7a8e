"""The page on witnesses: its file, installed as a package, is heard by diagnose and over a link."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import diagnose, logs
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.flight import Signal, kinds
from rotorwatch.live.replay import Replay
from rotorwatch.live.watched import Watched
from rotorwatch.witnesses import witness

PAGE = Path(__file__).resolve().parents[1] / "docs" / "your-own-witness.md"


@pytest.fixture
def hot(tmp_path, monkeypatch):
    """A flight of which one ESC is hot from 20 s on, with the page's witness installed."""
    (tmp_path / "hot_esc.py").write_text(re.search(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.S)[1])
    about = tmp_path / "hot_esc-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: hot-esc\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[rotorwatch.witnesses]\nhot_esc = hot_esc\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(kinds, "_TABLE", dict(kinds._TABLE))
    sys.modules.pop("hot_esc", None)
    witness._registered.cache_clear()
    flight = logs.read(SAMPLES / "quadx_healthy_hover.bin.xz").until(40.0)
    time = np.arange(0.0, 40.0, 0.1)
    values = np.tile([500.0, 500.0, 500.0, 500.0, 60.0, 60.0, 60.0, 60.0], (len(time), 1))
    values[time > 20.0, 6] = 104.0
    columns = (*(f"speed{k}" for k in range(1, 5)), *(f"temperature{k}" for k in range(1, 5)))
    return replace(flight, signals={**flight.signals, "esc": Signal(time, values, columns, "rad/s,degC")})


def found(events):
    return [(e["kind"], e["rotors"], round(e["onset_s"])) for e in events if e["kind"] == "hot_esc"]


def test_a_log_has_the_notice_in_its_answer(hot):
    answer = diagnose(hot)
    assert found(answer.to_dict()["events"]) == [("hot_esc", [3], 20)] and answer.verdict == "healthy"
    assert "Cool the ESC of rotor 3" in " ".join(answer.advice)


def test_a_link_has_it_when_the_flight_is_over(hot):
    alerts = []
    replay = Replay(hot, Watched("one", alerts.append))
    while replay.poll():
        pass
    assert found([a["event"] for a in alerts if a["type"] == "event"]) == [("hot_esc", [3], 20)]


def test_a_number_is_given_once(hot):
    witness.registered()
    with pytest.raises(TypeError, match="is taken by"):
        kinds.register(kinds.Kind(200, "another", "another"))
