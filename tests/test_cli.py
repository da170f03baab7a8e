"""The command line from outside, and the package's front door."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import click
import numpy as np
import pytest

import rotorwatch
import rotorwatch.calibrate  # imported first by a test of `fake`, it would keep that diagnoser for the tests of other files
from conftest import hexa_diagnosis
from rotorwatch.commands import cli
from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.report.info import info

ROOT = Path(__file__).parents[1]
VERDICTS = {"healthy": 0, "fault": 1, "crashed": 1, "ambiguous": 3, "inconclusive": 3}


def a_flight(**changes):
    time = np.arange(0.0, 20.0, 0.02)
    hover = np.tile([1500.0] * 4, (time.size, 1))
    signals = {
        "motors": Signal(time[::5], hover[::5], ("r1", "r2", "r3", "r4"), "us", source="RCOU"),
        "gyro": Signal(time, np.zeros((time.size, 3)), ("x", "y", "z"), "rad/s", "FRD", "IMU"),
    }
    flight = Flight("dataflash", "ArduPilot", signals, 20.0, firmware="ArduCopter V4.5", name="a.bin")
    return replace(flight, **changes)


@pytest.fixture
def fake(monkeypatch, tmp_path):
    """Logs named after their verdict, and a diagnoser that believes the name. Returns the folder."""

    def read(path, progress=None):
        if progress:
            progress(0.5)
        if "broken" in str(path):
            raise LogError(f"{path}: not a flight log.")
        if "bug" in str(path):
            raise RuntimeError("unforeseen")
        return a_flight(name=Path(path).name)

    def diagnose(flight, vehicle=None, baseline=(), estimator="default", progress=None, tuning=None, matters=0.2):
        verdict = flight.name.split("-")[0].removesuffix(".bin")
        flight = {**hexa_diagnosis().flight, "name": flight.name}
        reported = f"{len(baseline)} baseline, vehicle {getattr(vehicle, 'name', None)}, estimator {estimator}, {matters:g}"
        return hexa_diagnosis(verdict=verdict, flight=flight, baseline=reported)

    module = ModuleType("rotorwatch.diagnose")
    module.diagnose = diagnose
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(rotorwatch.logs, "read", read)
    for name in ("healthy", "fault", "ambiguous", "inconclusive", "crashed", "broken", "bug", "healthy-2"):
        (tmp_path / f"{name}.bin").write_bytes(b"x")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROTORWATCH_DEBUG", raising=False)
    return tmp_path


@pytest.fixture
def run(capfd):
    def go(*argv):
        with pytest.raises(SystemExit) as end:
            cli.main([str(a) for a in argv])
        out, err = capfd.readouterr()
        return end.value.code, out, err

    return go


# diagnose


@pytest.mark.parametrize(("verdict", "code"), VERDICTS.items())
def test_exit_code_says_the_verdict(fake, run, verdict, code):
    got, out, err = run("diagnose", f"{verdict}.bin")
    assert got == code and verdict in out.lower() and err == ""


def test_json_of_one_log_is_an_object_and_of_several_a_list(fake, run):
    code, out, _ = run("diagnose", "fault.bin", "--json")
    answer = json.loads(out)
    assert code == 1 and answer["verdict"] == "fault"
    assert 0.0 < answer["timing"]["read_s"] < answer["timing"]["total_s"]
    code, out, err = run("diagnose", "fault.bin", "broken.bin", "healthy.bin", "--json")
    first, broken, last = json.loads(out)
    assert (code, first["verdict"], last["verdict"]) == (2, "fault", "healthy")
    assert broken == {"schema": 3, "flight": {"name": "broken.bin"}, "error": "broken.bin: not a flight log."}
    assert err == "rotorwatch: broken.bin: not a flight log.\n"


@pytest.mark.parametrize(
    ("names", "code"),
    [
        (("healthy", "healthy-2"), 0),
        (("healthy", "ambiguous"), 3),
        (("ambiguous", "fault", "healthy"), 1),
        (("fault", "broken", "healthy"), 2),
        (("bug", "healthy"), 2),
    ],
)
def test_several_logs_give_a_line_each_and_the_gravest_code(fake, run, names, code):
    got, out, _ = run("diagnose", *(f"{n}.bin" for n in names))
    assert got == code
    lines = out.splitlines()
    assert len([line for line in lines if ".bin" in line]) == len(names)
    assert all(any(f"{n}.bin" in line for line in lines) for n in names)


def test_baselines_and_estimator_reach_the_diagnoser(fake, run):
    _, out, err = run(
        "diagnose",
        "fault.bin",
        "--baseline",
        "healthy.bin",
        "--baseline",
        "healthy-2.bin",
        "--estimator",
        "kf",
        "--matters",
        "0.3",
        "--json",
    )
    assert err == ""
    assert json.loads(out)["baseline"] == "2 baseline, vehicle None, estimator kf, 0.3"


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (("missing.bin",), "missing.bin: no such file."),
        (("broken.bin",), "broken.bin: not a flight log."),
        (("fault.bin", "--baseline", "broken.bin"), "broken.bin: not a flight log."),
        (("bug.bin",), "please report it"),
        (("fault.bin", "healthy.bin", "--report", "one.html"), "one file for 2 logs"),
        (("fault.bin", "--report", "healthy.bin/x.html"), "healthy.bin"),
    ],
)
def test_trouble_is_one_sentence(fake, run, argv, words):
    code, out, err = run("diagnose", *argv)
    assert code == 2 and out == ""
    assert err.startswith("rotorwatch: ") and words in err and err.count("\n") == 1 and "Traceback" not in err


def test_usage_errors_exit_with_2(fake, run):
    assert run("diagnose")[0] == 2
    assert run("diagnose", "fault.bin", "--nonsense")[0] == 2
    assert run("nonsense")[0] == 2


def test_debug_shows_the_traceback(fake, run, monkeypatch):
    monkeypatch.setenv("ROTORWATCH_DEBUG", "")  # restored afterwards, whatever --debug sets
    code, _, err = run("diagnose", "--debug", "bug.bin")
    assert code == 2 and "Traceback" in err and "unforeseen" in err


def test_interrupt_exits_with_130(fake, run, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["rotorwatch.logs"], "read", interrupt)
    code, out, err = run("diagnose", "fault.bin")
    assert (code, out, err) == (130, "", "rotorwatch: interrupted\n")


# --report


def test_report_of_one_log(fake, run):
    code, _, err = run("diagnose", "fault.bin", "--report", "sub/page.html")
    assert code == 1 and "sub/page.html" in err
    assert (fake / "sub/page.html").read_text().startswith("<!doctype html>")
    assert run("diagnose", "-q", "fault.bin", "--report", "sub")[2] == ""
    assert sorted(p.name for p in (fake / "sub").iterdir()) == ["fault.html", "page.html"]


def test_reports_of_several_logs(fake, run):
    run("diagnose", "fault.bin", "healthy.bin", "--report", "pages")
    assert sorted(p.name for p in (fake / "pages").iterdir()) == ["fault.html", "healthy.html"]


def test_report_names_never_clash(fake):
    logs = (Path("a/x.bin"), Path("b/x.bin.xz"), Path("plain"))
    assert [p.name for p in cli.report_paths(logs, Path("out/r-{name}.html"))] == ["r-x.html", "r-x-2.html", "r-plain.html"]


# Other commands


def test_demo_explains_the_samples_and_says_where_the_page_is(fake, run, monkeypatch):
    samples = fake / "samples"
    samples.mkdir()
    for name in ("fault-hexa.bin.xz", "healthy-quad.bin.xz"):
        (samples / name).write_bytes(b"x")
    monkeypatch.setattr(cli, "SAMPLES", samples)
    code, out, err = run("demo", "--report", "d.html")
    assert code == 0 and err == ""
    assert out.index("healthy-quad.bin.xz") < out.index("fault-hexa.bin.xz") < out.index("How to read this")
    assert "Report of the faulty flight: d.html" in out
    assert "fault-hexa.bin.xz" in (fake / "d.html").read_text().split("</title>")[0]
    assert "rotorwatch demo --report" in run("demo")[1]
    monkeypatch.setattr(cli, "SAMPLES", fake / "nothing")
    assert run("demo")[0] == 2


def test_calibrate_writes_the_vehicle_it_learned(fake, run, monkeypatch):
    written = {}
    learned = ModuleType("rotorwatch.calibrate")
    learned.calibrate = lambda flights, progress=None: type(
        "V", (), {"name": f"quad of {len(flights)}", "identified": {"flights": len(flights)}, "assumptions": ()}
    )
    files = ModuleType("rotorwatch.flight.vehicle_file")
    files.write = lambda vehicle, path: written.update({path: vehicle.name})
    monkeypatch.setitem(sys.modules, "rotorwatch.calibrate", learned)
    monkeypatch.setitem(sys.modules, "rotorwatch.flight.vehicle_file", files)
    code, out, err = run("calibrate", "healthy.bin", "healthy-2.bin", "-o", "v.toml")
    assert (code, written, err) == (0, {Path("v.toml"): "quad of 2"}, "")
    assert "learned from 2 flights" in out
    assert run("calibrate", "healthy.bin")[0] == 2


def test_inject_hands_its_options_to_the_campaign(fake, run, monkeypatch):
    asked = []
    module = ModuleType("rotorwatch_lab.experiments.inject")

    def campaign(paths, losses, repeats, seed, progress, jobs, scheduler, keep):
        asked.append(([p.name for p in paths], losses, repeats, seed, jobs, scheduler, keep))
        return {"table": [{"loss": 0.2, "injections": 8, "detected": 0.5, "delay_s": 1.25}], "false_alarms": 0}

    module.campaign = campaign
    monkeypatch.setitem(sys.modules, "rotorwatch_lab.experiments.inject", module)
    argv = ("inject", "healthy.bin", "--loss", "0.2,0.9", "--repeats", "2", "--seed", "9", "--jobs", "2", "--keep", "k")
    code, out, _ = run(*argv, "--json")
    assert code == 0 and json.loads(out)["false_alarms"] == 0
    assert asked == [(["healthy.bin"], (0.2, 0.9), 2, 9, 2, None, Path("k"))]
    _, out, _ = run(*argv)
    assert "20 %" in out and "50 %" in out and "1.25 s" in out
    for wrong in ("0.2;0.3", "0", "1", "nan", ""):
        code, out, err = run("inject", "healthy.bin", "--loss", wrong)
        assert code == 2 and out == "" and "--loss" in err


def test_fast_start():
    """Nothing heavy is loaded before it is needed. (How long it takes is a benchmark: docs/speed.md.)"""
    heavy = "jax scipy numpy bokeh rich pymavlink pyulog pandas pyarrow matplotlib cvxpy"
    code = (
        "import sys, rotorwatch.commands.cli as c\n"
        "try: c.main(['--version'])\nexcept SystemExit: pass\n"
        f"print([m for m in {heavy.split()!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == f"rotorwatch {rotorwatch.__version__}\n[]\n", done.stderr


def test_python_m_is_the_command_line():
    """For whoever has installed it where scripts are not on PATH."""
    done = subprocess.run([sys.executable, "-m", "rotorwatch", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, f"rotorwatch {rotorwatch.__version__}\n"), done.stderr


def test_help_of_every_command_is_complete(run):
    _, out, _ = run("--help")
    for name, command in cli.cli.commands.items():
        assert name in out
        assert run(name, "--help")[0] == 0
        assert all(p.help for p in command.params if isinstance(p, click.Option)), name


def test_help_begins_with_what_people_do(run):
    _, out, _ = run("--help")
    names = re.findall(r"^  ([a-z-]+)  ", out.partition("Start here:")[2], re.MULTILINE)
    assert names[:5] == ["diagnose", "info", "watch", "fleet", "serve"] and sorted(names) == sorted(cli.cli.commands)
    assert names.index("survive") < names.index("evaluate") < names.index("ablate")


def test_broken_pipe_is_quiet_and_no_verdict():
    """As in `rotorwatch ... | head`: 1 would say that a fault was found."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    done = subprocess.run([sys.executable, "-m", "rotorwatch.commands.cli", "--help"], stdout=write_end, stderr=subprocess.PIPE)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, b"")


def test_info_prints_json_and_a_table(fake, run):
    code, out, _ = run("info", "fault.bin", "--json")
    facts = json.loads(out)
    assert code == 0 and facts["rotors"] == 4 and facts["name"] == "fault.bin"
    code, out, _ = run("info", "fault.bin")
    assert code == 0 and "RCOU" in out and "LOG_BITMASK" in out
    assert max(len(line) for line in out.splitlines()) <= 80


# info


def settings(flight):
    return {gap["signal"]: gap["setting"] for gap in info(flight)["missing"]}


def test_info_names_the_setting_that_would_log_what_is_missing():
    ardupilot = settings(a_flight())
    assert "bit 0, which adds 1 " in ardupilot["motors"] and "bit 18, which adds 262144 " in ardupilot["accel"]
    assert "bit 9, " in ardupilot["battery"] and "bit 17, " in ardupilot["lift"] and "bit 18" not in ardupilot["motors"]
    known = settings(a_flight(parameters={"LOG_BITMASK": 1024.0}))
    whole = 1024 | 1 << 0 | 1 << 9 | 1 << 17 | 1 << 18  # all that is named, whichever setting is followed
    assert {text.split(" to ")[1].split(" ")[0] for text in known.values() if "LOG_BITMASK" in text} == {str(whole)}
    px4 = settings(a_flight(autopilot="PX4"))
    assert "SDLOG_PROFILE bit 4," in px4["motors"] and "battery_status" in px4["battery"] and "lift" not in px4


def test_info_says_what_prevents_a_diagnosis():
    bare = a_flight(signals={})
    facts = info(bare)
    assert not facts["ready"]
    assert {gap["signal"] for gap in facts["missing"] if gap["needed"]} == {"motors", "frame"}
    assert facts["missing"][0]["needed"] and not facts["missing"][-1]["needed"]


def test_info_counts_invalid_samples_and_empty_signals():
    gyro = Signal(np.arange(4.0), np.array([[np.nan], [1.0], [1.0], [1.0]]), ("x",), "rad/s")
    empty = Signal(np.zeros(0), np.zeros((0, 1)), ("out",), "1")
    facts = {s["name"]: s for s in info(a_flight(signals={"gyro": gyro, "throttle": empty}))["signals"]}
    assert facts["gyro"]["valid"] == 0.75 and facts["gyro"]["rate_hz"] == 1.0
    assert facts["throttle"]["samples"] == 0 and facts["throttle"]["start_s"] is None


def test_info_shows_notable_messages_only():
    said = (Message(1.0, "text", "EKF3 IMU0 is using GPS"), Message(2.0, "text", "Potential Thrust Loss (3)"), Message(3.0, "mode", "LAND"))
    assert [m["time_s"] for m in info(a_flight(messages=said))["messages"]] == [2.0, 3.0]


# The package


def test_importing_the_package_loads_nothing_heavy():
    heavy = "{'numpy', 'jax', 'bokeh', 'rich', 'pymavlink', 'pyulog', 'click'}"
    code = f"import sys, rotorwatch; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "[]\n"


def test_verbs_are_functions_and_modules_at_once():
    """However the submodule came to be imported: `rotorwatch.info` can be called and holds its other names."""
    code = (
        "import inspect, rotorwatch.report.info, rotorwatch as rw; from rotorwatch.flight import Flight; "
        "assert rw.info(Flight('csv', '', {}, 0.0)) == rw.info.info(Flight('csv', '', {}, 0.0)); "
        "assert list(inspect.signature(rw.info).parameters) == ['flight', 'progress']; "
        "assert rw.inject.PART and callable(rw.inject) and rw.Flight is Flight; print('ok')"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "ok\n"


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = rotorwatch.nonsense
    assert {"read", "diagnose", "Flight"} <= set(dir(rotorwatch))


def test_version_is_the_packages():
    from rotorwatch.base.optional import tomllib

    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"] == rotorwatch.__version__
