"""What flights and answers show of themselves in Python and in notebooks, and estimators given as objects."""

import functools
import inspect
import pydoc
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import rotorwatch as rw
from conftest import hexa_diagnosis
from rotorwatch.base import discovery
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch_lab.estimators.akf import AKF

ROOT = Path(__file__).parents[1]
SAMPLES = ROOT / "src/rotorwatch/samples"


def small_flight(**changes):
    time = np.arange(5) * 0.5
    gyro = Signal(time, np.arange(15.0).reshape(5, 3), ("x", "y", "z"), "rad/s", "FRD", "IMU", np.arange(15).reshape(5, 3) != 4)
    return Flight("DataFlash", "ArduPilot", {"gyro": gyro}, 2.0, firmware="4.5.1", name="a<b>.bin", parameters={"FRAME_CLASS": 1.0},
                  messages=(Message(0.5, "mode", "LOITER"),), warnings=("2 % of it was <damaged>",), **changes)  # fmt: skip


class _Page(HTMLParser):
    """Tags that stay open, cells by row, and all tags."""

    def __init__(self, text):
        super().__init__()
        self.open, self.rows, self.tags = [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag == "br":
            return
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1].append(data)


def test_one_line_says_what_a_thing_is():
    flight, found = small_flight(), hexa_diagnosis()
    for thing, words in (
        (flight, ("a<b>.bin", "ArduPilot 4.5.1", "2.0 s", "gyro")),
        (flight["gyro"], ("x y z", "rad/s", "5 samples", "2.0 Hz")),
        (found, ("hexa.bin", "fault", "otor 3")),
        (found.trace, ("3000 ticks", "6 rotors")),
    ):
        text = repr(thing)
        assert "\n" not in text and len(text) < 300
        assert all(word in text for word in words), text


def test_a_notebook_shows_verdict_rotors_and_events():
    found = hexa_diagnosis()
    page = _Page(found._repr_html_())
    assert not page.open and "script" not in page.tags
    assert sum(row[0] == str(k) for row in page.rows for k in range(1, 7)) == 12  # rotors, their health
    third = next(row for row in page.rows if row[0] == "3")
    assert "37.0 %" in third
    assert any("31.20 s" in row for row in page.rows)


def test_a_notebook_shows_what_a_log_holds_as_text():
    page = _Page(small_flight()._repr_html_())
    assert not page.open and not page.tags & {"b>", "damaged"}
    assert ["gyro", "x, y, z", "rad/s", "FRD", "5", "2.0", "IMU"] in page.rows


def test_tables_for_pandas():
    found = hexa_diagnosis()
    rotors = found.to_pandas()
    assert list(rotors.index) == [1, 2, 3, 4, 5, 6]
    assert rotors.loc[3, "loss"] == pytest.approx(0.37) and rotors.loc[3, "lower"] <= 0.37 <= rotors.loc[3, "upper"]
    ticks = found.trace.to_pandas()
    assert len(ticks) == len(found.trace.time) and ticks.index.name == "time_s"
    assert np.array_equal(ticks["loss_3"], found.trace.loss[:, 2])
    assert np.array_equal(ticks["residual_sd_thrust"], found.trace.residual_sd[:, 3])
    assert np.array_equal(ticks["evidence_rotor 3"], found.trace.evidence["rotor 3"])
    gyro = small_flight().to_pandas("gyro")
    assert np.isnan(gyro["y"].iloc[1]) and np.isnan(gyro.to_numpy()).sum() == 1
    with pytest.raises(rw.ConfigError, match="no signal baro; it has gyro"):
        small_flight().to_pandas("baro")


def test_a_flight_as_plain_data():
    import json

    facts = json.loads(json.dumps(small_flight().to_dict(), allow_nan=False))
    assert facts["signals"]["gyro"]["samples"] == 5 and facts["parameters"] == {"FRAME_CLASS": 1.0}
    assert facts["messages"][0]["text"] == "LOITER" and facts["warnings"] == ["2 % of it was <damaged>"]


class Kept:
    """Keeps its keyword."""

    name, init, step = "kept", None, None

    def __init__(self, system, dt, *, gain=1.0):
        self.gain = gain


class Forgetful(Kept):
    """Does not."""

    def __init__(self, system, dt, *, bias=1.0):
        pass


def test_estimators_given_as_objects():
    assert discovery.estimator(AKF) is AKF and discovery.title(AKF) == "akf"
    partial = functools.partial(Kept, gain=3.0)
    assert discovery.estimator(partial) is partial and discovery.title(partial) == "kept"
    again = discovery.estimator(Kept(None, 0.1, gain=2.5))
    assert again(None, 0.1).gain == 2.5 and discovery.title(Kept(None, 0.1)) == "kept"
    with pytest.raises(rw.ConfigError, match="does not keep its keyword bias"):
        discovery.estimator(Forgetful(None, 0.1))
    with pytest.raises(rw.ConfigError, match="int is no estimator, it has no name"):
        discovery.estimator(3)


def test_a_diagnosis_by_an_instance_is_that_by_the_name(hover_log):
    by_name = rw.diagnose(hover_log, estimator="akf")
    plant = rw.systems.RateDynamics(J=np.eye(3), B_tau=np.ones((3, 6)), B_T=np.ones(6), m=1.0, gyro_sd=0.1, accel_sd=0.1)
    by_object = rw.diagnose(hover_log, estimator=AKF(plant, 0.05))
    assert by_object.estimator == by_name.estimator == "akf"
    assert by_object.events == by_name.events and by_object.events
    changed = rw.diagnose(hover_log, estimator=functools.partial(AKF, memory_s=3.0))
    assert changed.trace is not None and by_name.trace is not None
    assert not np.array_equal(changed.trace.loss, by_name.trace.loss)


@pytest.fixture(scope="module")
def hover_log():
    """The sample flight with a fault that comes with rotorwatch."""
    from rotorwatch.commands.cli import SAMPLES

    return rw.read(next(p for p in SAMPLES.glob("*.bin.xz") if "healthy" not in p.name))


def test_a_name_that_is_nearly_right_is_shown_the_right_one():
    for ask, near in (
        (lambda: discovery.estimator("axkff"), "(did you mean axkf?); known are adaptive_ekf"),
        (lambda: small_flight().to_pandas("gyr"), "(did you mean gyro?)"),
        (lambda: rw.export_c("eekf", "."), "(did you mean ekf?)"),
        (lambda: rw.reproduce("aesmff"), "(did you mean aesmf?)"),
    ):
        with pytest.raises(rw.ConfigError) as why:
            ask()
        assert near in str(why.value)
    with pytest.raises(rw.ConfigError) as why:
        discovery.estimator("nothing like it")
    assert "did you mean" not in str(why.value)


def test_everything_that_can_be_asked_for_is_listed():
    assert {"diagnose", "campaign", "detectors", "systems", "fleet", "logs", "gathering"} <= set(dir(rw))
    assert all(hasattr(rw, name) for name in dir(rw))


@pytest.mark.parametrize("name", ["diagnose", "diagnose_many", "info", "calibrate", "evaluate", "inject"])
def test_help_begins_with_the_function_and_its_arguments(name):
    """Not with the classes and imports of its module."""
    text = pydoc.render_doc(getattr(rw, name), renderer=pydoc.plaintext)
    function = getattr(rw, name).__wrapped__
    assert "CLASSES" not in text and f"\n    {name}(" in text
    said = inspect.getdoc(function)
    assert all(re.search(rf"\b{p}\b", said) for p in inspect.signature(function).parameters), f"{name}: an argument is not explained"


def test_series_and_answers_plot_themselves(tmp_path):
    flight = rw.read(SAMPLES / "quadx_healthy_hover.bin.xz")
    answer = rw.diagnose(flight)
    for made, lines in ((flight["gyro"].plot(tmp_path / "gyro.png"), 3), (answer.trace.plot(), 4), (answer.plot(), 4)):
        assert len(made.axes[0].lines) == lines and "[s]" in made.axes[-1].get_xlabel()
    assert (tmp_path / "gyro.png").read_bytes().startswith(b"\x89PNG") and "rad/s" in flight["gyro"].plot().axes[0].get_ylabel()
    lines = {line.get_label(): line for line in answer.trace.plot().axes[0].lines}
    np.testing.assert_allclose(lines["rotor 2"].get_ydata(), 100.0 * answer.trace.loss[:, 1])


def test_dir_lists_the_whole_interface_and_nothing_else():
    page = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    documented = {name for row in re.findall(r"^\| (`.*?`) \|", page, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
    assert documented <= set(dir(rw)) and {"new", "fit_odds"} <= documented
    assert not {"Any", "ModuleType", "TYPE_CHECKING", "annotations", "sys", "_VERBS"} & set(dir(rw))
