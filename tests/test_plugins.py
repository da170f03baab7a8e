"""Methods, plants and detectors of other packages: found by their entry points, named by module:Class, and refused in one sentence."""

import warnings

import pytest

from rotorwatch import airframes, detectors, logs
from rotorwatch.base import discovery
from rotorwatch.errors import ConfigError, LogError, PluginWarning
from rotorwatch_lab import campaign
from rotorwatch_lab.published import origin

GOOD = """
class Own:
    "A method of another package."
    name = "own"
    not_kalman = "x"
    def init(self): ...
    def step(self, carry, u, y, valid, dt=None): ...

class Plant:
    name = "own_plant"
    def f(self): ...
    def h(self): ...

class Rule:
    name, autopilot = "own-rule", ""
    @staticmethod
    def detect(flight, vehicle, airborne):
        return ()

class Half:
    name = "half"
    def init(self): ...

class Log:
    FORMAT = "own log"
    @staticmethod
    def sniff(head, name):
        return head.startswith(b"OWN")
    @staticmethod
    def read(data, name, progress=None):
        import numpy as np
        from rotorwatch.flight import Flight, Signal
        motors = Signal(np.arange(3.0), np.ones((3, 4)), ("r1", "r2", "r3", "r4"), "1")
        return Flight("own log", "Own", {"motors": motors}, 2.0)

class Broken(Log):
    FORMAT = "broken log"
    sniff = staticmethod(lambda head, name: 1 / 0)

class Frame:
    @staticmethod
    def identify(flight):
        if flight.autopilot == "Own":
            return Frame.NAMES["own-quad"]()
    NAMES = {"own-quad": lambda: __import__("dataclasses").replace(
        __import__("rotorwatch").airframes.named("crazyflie"), name="own-quad")}

class Wrong:
    identify = staticmethod(lambda flight: "a quadrotor" if flight.autopilot == "Own" else None)
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """package(entry points, source): a package of that kind on the path, as an installer would leave it there."""

    def make(entries, source=GOOD, name="elsewhere"):
        (tmp_path / f"{name}.py").write_text(source)
        info = tmp_path / f"{name}-1.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
        lines = [f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in rows.items()) for group, rows in entries.items()]
        (info / "entry_points.txt").write_text("\n\n".join(lines) + "\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(__import__("sys").modules, name, raising=False)

    return make


def test_what_other_packages_offer_is_found(package):
    package(
        {
            "rotorwatch.estimators": {"own": "elsewhere:Own"},
            "rotorwatch.systems": {"own_plant": "elsewhere:Plant"},
            "rotorwatch.detectors": {"own-rule": "elsewhere:Rule"},
        }
    )
    assert discovery.estimators()["own"] is discovery.estimator("own")
    assert discovery.systems()["own_plant"] is discovery.system("own_plant")
    assert "own-rule" in [m.name for m in detectors.modules()]
    assert "own-rule" not in [m.name for m in detectors.for_autopilot("ArduPilot")]  # it is no autopilot's own check
    assert origin.source(discovery.estimator("own")) == ("elsewhere", "1.2", "elsewhere:Own")
    assert "ekf" in discovery.estimators()
    plan = campaign.from_table({"estimators": ["own", "elsewhere:Own"], "scenario": {"airframe": {"frame": "quad-x"}}, "healthy": 1.0})
    assert plan.estimators == ("own", "elsewhere:Own")


@pytest.mark.parametrize(
    ("target", "source", "says"),
    [
        ("elsewhere:Own", "import nonsense_that_is_not_there", "cannot be loaded .*nonsense_that_is_not_there.* fix or uninstall that"),
        ("elsewhere:Missing", GOOD, "cannot be loaded .*Missing"),
        ("elsewhere:Half", GOOD, "lacks step"),
        ("elsewhere:Own", GOOD.replace('name = "own"', 'name = "other"'), "calls itself 'other'"),
        ("elsewhere:Own", GOOD.replace('name = "own"', "name = 3"), "must have a string as its name, not 3"),
        ("elsewhere:Own", "raise SystemError('no GPU\\nat all')", "SystemError: no GPU at all"),
    ],
)  # fmt: skip
def test_a_broken_plug_in_is_one_sentence_that_names_the_package(package, target, source, says):
    package({"rotorwatch.estimators": {"own": target}}, source)
    with pytest.raises(ConfigError, match=says) as why:
        discovery.estimator("own")
    assert "of the package elsewhere 1.2" in str(why.value) and "\n" not in str(why.value)
    with pytest.warns(PluginWarning, match=says):
        found = discovery.estimators()
    assert "own" not in found and "ekf" in found
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        discovery.estimator("ekf")  # who asks for another one does not hear of it


def test_a_broken_detector_of_another_package_stops_no_diagnosis(package):
    package({"rotorwatch.detectors": {"own-rule": "elsewhere:Missing", "px4-esc-current": "elsewhere:Rule"}})
    with pytest.warns(PluginWarning, match="of the package elsewhere 1.2"):
        names = [m.name for m in detectors.modules()]
    assert "own-rule" not in names and names.count("px4-esc-current") == 1


def test_a_name_of_ours_stays_ours(package):
    package({"rotorwatch.estimators": {"ekf": "elsewhere:Own"}}, GOOD.replace('name = "own"', 'name = "ekf"'))
    with pytest.warns(PluginWarning, match="ekf of the package elsewhere 1.2 is not used"):
        assert discovery.estimators()["ekf"].__module__ == "rotorwatch_lab.estimators.ekf"
    assert discovery.estimator("ekf").__module__ == "rotorwatch_lab.estimators.ekf"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("elsewhere:Nothing", "elsewhere has no Nothing"),
        ("no_such_module:Own", "importing no_such_module failed"),
        ("elsewhere:Half", "estimator elsewhere:Half lacks step"),
        ("elsewhere:", "names no estimator: write package.module:Class"),
        ("../x.py:Own", "names no estimator: write package.module:Class"),
    ],
)
def test_a_class_that_cannot_be_named(package, name, says):
    package({})
    with pytest.raises(ConfigError, match=says) as why:
        discovery.estimator(name)
    assert "\n" not in str(why.value)


def test_what_a_method_says_of_itself():
    assert origin.about(discovery.estimator("adaptive_ekf")).startswith("Adaptive extended Kalman filter: Zhang's")
    assert origin.source(discovery.estimator("ekf")).path == "rotorwatch_lab.estimators.ekf:EKF"


def test_a_log_format_and_an_airframe_of_another_package_are_used(package, tmp_path):
    package({"rotorwatch.logs": {"x": "elsewhere:Log"}, "rotorwatch.airframes": {"y": "elsewhere:Frame"}})
    (tmp_path / "a.log").write_bytes(b"OWN 1")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flight = logs.read(tmp_path / "a.log")
        assert flight.format == "own log" and flight.name == "a.log"
        assert airframes.identify(flight).name == airframes.named("own-quad").name == "own-quad"
        assert "own-quad" in airframes.names() and "crazyflie" in airframes.names()
        (tmp_path / "b.log").write_bytes(b"nobody's")
        with pytest.raises(LogError, match=r"known are .*own log"):
            logs.read(tmp_path / "b.log")


def test_a_broken_format_or_airframe_of_another_package_stops_nothing(package, tmp_path):
    package(
        {
            "rotorwatch.logs": {"a": "elsewhere:Broken", "b": "elsewhere:Missing", "c": "elsewhere:Log", "d": "elsewhere:Rule"},
            "rotorwatch.airframes": {"a": "elsewhere:Wrong", "b": "elsewhere:Frame"},
        }
    )  # fmt: skip
    (tmp_path / "a.log").write_bytes(b"OWN 1")
    with pytest.warns(PluginWarning) as said:
        flight = logs.read(tmp_path / "a.log")
        vehicle = airframes.identify(flight)
    assert flight.format == "own log" and vehicle.name == "own-quad"
    texts = " ".join(str(w.message) for w in said)
    assert texts.count("of the package elsewhere 1.2") == len(said) and "\n" not in texts
    for part in ("a of the package elsewhere 1.2 is passed over: its sniff failed (ZeroDivisionError", "cannot be loaded",
                 "lacks FORMAT", "str is not a Vehicle"):  # fmt: skip
        assert part in texts


def test_a_format_of_ours_stays_ours(package):
    ulog = next(m for m in logs.formats() if m.__name__.endswith(".ulog"))
    source = GOOD.replace('FORMAT = "own log"', f"FORMAT = {ulog.FORMAT!r}")
    package({"rotorwatch.logs": {"x": "elsewhere:Log"}}, source)
    with pytest.warns(PluginWarning, match="its FORMAT is already in use"):
        assert ulog.FORMAT not in logs.offered()


def test_a_reader_of_another_package_that_gives_no_flight(package, tmp_path):
    package({"rotorwatch.logs": {"x": "elsewhere:Log"}}, GOOD.replace("return Flight(", "return dict(").replace('"own log", "Own", {', "a={"
            ).replace("}, 2.0)", "})"))  # fmt: skip
    (tmp_path / "a.log").write_bytes(b"OWN 1")
    with pytest.raises(LogError, match="returned no Flight"):
        logs.read(tmp_path / "a.log")
