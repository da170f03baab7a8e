"""The log reader in C: a log's bytes to an answer, as a command, in Node and in a page, as `diagnose` has it."""

import json
import lzma
import os
import re
import shutil
import struct
import subprocess

import numpy as np
import pytest

from browser_tab import Tab, launched, until
from fuzzing import mutate
from rotorwatch import airframes, diagnose
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.engine.intake import planning
from rotorwatch.engine.motion import tick_table
from rotorwatch.errors import ConfigError
from rotorwatch.export import export_log_reader as exporter
from rotorwatch_lab.simulation import scenario, simulate

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-ffp-contract=off")
SANITIZED = ("-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
PX4 = {
    "autopilot": "px4", "duration_s": 40.0, "airframe": {"frame": "quad-x"}, "trajectory": {"kind": "hover", "altitude_m": 5.0},
    "faults": [{"kind": "loss", "rotor": 3, "onset_s": 25.0, "strength": 0.4}],
}  # fmt: skip
DATAFLASH, ULOG = "hexax_m3_mul0.80_square_wind.bin", "quad.ulg"
WEAK = {DATAFLASH: [3], ULOG: [3]}
needs_gcc = pytest.mark.skipif(not shutil.which("gcc"), reason="needs gcc")
SAME_S, SAME = 0.1, 0.02  # by which onset and size may differ


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A DataFlash log and a ULog in which rotor 3 gets weak, a healthy one, and logs that are refused."""
    folder = tmp_path_factory.mktemp("logs")
    for name in (DATAFLASH, "quadx_healthy_hover.bin"):
        (folder / name).write_bytes(lzma.decompress((SAMPLES / f"{name}.xz").read_bytes()))
    simulate(scenario.from_table(PX4)).write(folder / ULOG)
    (folder / "empty.bin").write_bytes(b"")
    (folder / "text.bin").write_bytes(b"no log at all\n" * 1000)
    damaged = bytearray((folder / DATAFLASH).read_bytes())
    damaged[len(damaged) // 2 : len(damaged) // 2 + 40] = bytes(40)
    (folder / "damaged.bin").write_bytes(damaged)
    return folder


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """The exported C, with its page where that can be built."""
    folder = tmp_path_factory.mktemp("log-reader")
    exporter.export_log_reader(folder)
    return folder


@pytest.fixture(scope="module")
def build(project, tmp_path_factory):
    """build(flags) -> the command; the engine, which is tested elsewhere, is compiled once and without them."""
    folder = tmp_path_factory.mktemp("built")
    common, engine = ["gcc", "-std=c99", "-ffp-contract=off", "-O0", "-c"], folder / "engine.o"

    def made(*flags):
        if not engine.exists():
            subprocess.run([*common, project / "rw_engine.c", "-o", engine], check=True)
        goal = folder / f"rotorwatch-c{len(flags)}"
        own = [path for path in sorted(project.glob("rw_*.c")) if path.name != "rw_engine.c"]
        if not goal.exists():
            subprocess.run(["gcc", *STRICT, *flags, "-o", goal, *own, engine, "-lm"], check=True)
        return goal

    return made


@pytest.fixture(scope="module")
def command(build):
    return build("-O2")


@pytest.fixture(scope="module")
def page(project, tmp_path_factory, amount):
    """The folder with rotorwatch.wasm, rotorwatch.mjs and rotorwatch.html. With --thorough it is optimised as for users."""
    folder, running = tmp_path_factory.mktemp("page"), exporter.running
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(running, "VECTORS", amount(("-O0", *running.VECTORS[1:]), running.VECTORS))
        try:
            exporter.export_log_reader(folder, page=True)
        except ConfigError as why:
            pytest.skip(str(why))
    return folder


def assessed(command, log):
    """The answer to a log that is assessed."""
    done = subprocess.run([command, log], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@needs_gcc
@pytest.mark.parametrize("name", [DATAFLASH, ULOG])
def test_it_says_what_diagnose_says(name, command, logs):
    answer, reported = assessed(command, logs / name), diagnose(logs / name)
    assert answer["verdict"] == reported.verdict == "fault"
    (loss,), (known,) = answer["events"], reported.events
    assert loss["kind"] == known.kind and loss["rotors"] == list(known.rotors) == WEAK[name]
    assert loss["onset_s"] == pytest.approx(known.onset_s, abs=SAME_S) and loss["loss"][0] == pytest.approx(known.loss[0], abs=SAME)
    flight = answer["flight"]
    assert flight["frame"] == reported.flight["frame"] and flight["duration_s"] == pytest.approx(reported.flight["duration_s"], abs=1e-3)
    assert np.ravel(flight["hops"]) == pytest.approx(np.ravel(reported.flight["hops"]), abs=1e-3)
    assert answer["main_event"] == 0 and answer["tumbled_s"] is None and "rotorwatch diagnose" in answer["left_to_diagnose"]
    assert [(g["x"], g["y"], g["spin"]) for g in flight["geometry"]] == [
        (pytest.approx(g["x"], abs=1e-3), pytest.approx(g["y"], abs=1e-3), g["spin"]) for g in _scaled(reported.flight["geometry"])
    ]


def _scaled(geometry):
    reach = max(max(abs(g["x"]), abs(g["y"])) for g in geometry)
    return [{"x": g["x"] / reach, "y": g["y"] / reach, "spin": g["spin"]} for g in geometry]


@needs_gcc
def test_a_healthy_flight_has_no_events(command, logs):
    answer = assessed(command, logs / "quadx_healthy_hover.bin")
    assert answer["verdict"] == "nothing found" and answer["events"] == [] and answer["main_event"] is None
    assert answer["flight"]["assessed_s"] > 20.0


@needs_gcc
def test_bad_input_gets_a_sentence(command, logs, tmp_path):
    def refused(*arguments):
        done = subprocess.run([command, *arguments], capture_output=True, text=True)
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done
        return done.stderr

    assert "give one log" in refused() and "cannot be opened" in refused(tmp_path / "none.bin")
    assert "neither a ULog nor" in refused(logs / "empty.bin") and "neither a ULog nor" in refused(logs / "text.bin")
    assert "damaged at byte" in refused(logs / "damaged.bin")
    plane = (logs / ULOG).read_bytes().replace(b"int32_t CA_AIRFRAME\0\0\0\0", b"int32_t CA_AIRFRAME\1\0\0\0")
    (tmp_path / "plane.ulg").write_bytes(plane)
    assert "CA_AIRFRAME 1 is not a plain multirotor" in refused(tmp_path / "plane.ulg")
    swapped = (logs / DATAFLASH).read_bytes()
    for output, motor in ((1, 2), (2, 1)):
        name = f"SERVO{output}_FUNCTION\0".encode()
        assert name + struct.pack("<f", 32 + output) in swapped
        swapped = swapped.replace(name + struct.pack("<f", 32 + output), name + struct.pack("<f", 32 + motor))
    (tmp_path / "swapped.bin").write_bytes(swapped)
    assert "output 1 follows the rate controller as motor 2" in refused(tmp_path / "swapped.bin")


@needs_gcc
@pytest.mark.parametrize("name", [DATAFLASH, ULOG])
def test_a_log_that_was_cut_is_assessed_up_to_the_cut(name, command, logs, tmp_path):
    data = (logs / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(0.9 * len(data)) + 5])
    answer = assessed(command, tmp_path / name)
    assert answer["events"][0]["rotors"] == WEAK[name] and "ends in the middle" in answer["warnings"][0]


@needs_gcc
@pytest.mark.parametrize("name", [DATAFLASH, ULOG])
def test_damage_is_refused_or_assessed_within_its_memory(name, build, logs, tmp_path, amount):
    """With the address and undefined-behaviour sanitizers, which end the program at the first wrong access."""
    checked, data = build(*SANITIZED), (logs / name).read_bytes()
    data = data[: int(0.45 * len(data))]  # a shorter flight is quicker
    ends = set()
    for number in range(amount(12, 300)):
        damaged, what = mutate(data, 5, number)
        (tmp_path / name).write_bytes(damaged)
        done = subprocess.run([checked, tmp_path / name], capture_output=True, text=True, errors="replace", timeout=60)
        assert done.returncode in (0, 2), f"{number}: {what}: {done.stderr[-2000:]}"
        assert done.returncode == 0 or len(done.stderr.splitlines()) == 1
        ends.add(done.returncode)
        json.loads(done.stdout)
    assert 2 in ends


def test_frames_are_those_of_the_airframes():
    """Every frame that an autopilot's parameters name is in the table, with the effectiveness that Python uses."""
    text = exporter.tables()
    for name in ("ardupilot-quad-x", "ardupilot-y6-b", "px4-hexa-coaxial", "px4-octa-x"):
        row = re.search(rf'{{"{name}", (\d+), (\w+), {{{{(.*?)}}, ', text)
        vehicle = airframes.named(name)
        assert row and int(row[1]) == len(vehicle.rotors) and row[2] == "true"
        assert [float(x) for x in row[3].split(", ")] == vehicle.effectiveness()[0].tolist()
    assert '{1, 1, "ardupilot-quad-x"}' in text and '{5, 10, "ardupilot-y6-b"}' in text and '{4000, 4999, "px4-quad-x"}' in text
    assert f"#define RW_PLAN_READY_S {planning.READY_S}" in text and "NaN" not in text and "nan" not in text


def test_a_window_holds_few_samples_of_a_slow_signal():
    assert planning.samples_in(0.05, 0.01) == 4 and planning.samples_in(0.05, 1.0) == planning.samples_in(0.05, np.nan) == 1
    assert planning.half_averaged(0.5, 1.0, 50.0) == 0.1 and planning.half_averaged(0.5, 10.0, 50.0) == 0.25
    assert tick_table.ready_of(8.0, ((0.0, 10.0),)) == 5.0


@pytest.mark.skipif(not shutil.which("node"), reason="needs Node (apt-get install nodejs)")
def test_node_says_the_same(page, command, logs, amount):
    for name in amount((ULOG, "damaged.bin"), (DATAFLASH, ULOG, "damaged.bin")):
        done = subprocess.run(["node", page / "rotorwatch.mjs", logs / name], capture_output=True, text=True)
        native = subprocess.run([command, logs / name], capture_output=True, text=True)
        assert done.returncode == native.returncode, done.stderr
        assert alike(json.loads(done.stdout), json.loads(native.stdout))


def alike(one, other):
    """Equal but for the rounding of elementary functions."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(alike(one[k], other[k]) for k in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(alike, one, other))
    return one == (pytest.approx(other, abs=2e-4) if isinstance(one, float) else other)


def test_the_page_assesses_a_log_without_a_network(page, logs, chromium):
    """On a phone, and on a wide screen."""
    with launched(chromium) as browser:
        tab = Tab(browser, (page / "rotorwatch.html").as_uri(), viewport={"width": 390, "height": 900}, offline=True)
        shown = tab.page.inner_text

        def at_each_width(look):
            for width in (1400, 390):
                tab.page.set_viewport_size({"width": width, "height": 900})
                until(tab.page, f"innerWidth === {width}")
                assert not look()

        for name, headline in ((DATAFLASH, "Rotor 3 lost"), (ULOG, "Rotor 3 lost"), ("damaged.bin", "damaged at byte")):
            tab.page.set_input_files("#file", logs / name)
            until(tab.page, f"(document.documentElement.dataset.answer ?? '').includes('{name}')")
            assert headline in shown("#verdict")
            at_each_width(tab.overflow)
            if name != "damaged.bin":
                assert "rotorwatch diagnose" in shown("#left") and tab.page.locator("svg circle.weak").count() == 1
                assert re.search(r"loss of effectiveness: \d+ %", shown("#parts"))
        at_each_width(tab.violations)
        assert not tab.wrong and tab.hosts <= {""}
        tab.page.evaluate(
            "() => { const held = new DataTransfer(); held.items.add(new File(['x'], 'dropped.bin'));"
            "document.dispatchEvent(new DragEvent('drop', { dataTransfer: held, cancelable: true, bubbles: true })); }"
        )
        until(tab.page, "(document.documentElement.dataset.answer ?? '').includes('dropped.bin')")
        assert "neither a ULog nor" in shown("#verdict")


def test_the_command_writes_it(run, tmp_path):
    code, out, _ = run("export-c", "--log-reader", "-o", tmp_path)
    names = {os.path.basename(line) for line in out.splitlines()}
    assert code == 0 and {"CMakeLists.txt", "rw_main.c", "rw_log.h", "rw_engine.c", "rw_tables.h"} <= names
    assert names == {path.name for path in tmp_path.iterdir()}
    for wrong in (["--diagnoser", "--page"], ["--log-reader", "--vehicle", "ardupilot-quad-x"], ["--log-reader", "--diagnoser"]):
        code, _, err = run("export-c", *wrong, "-o", tmp_path)
        assert code == 2 and len(err.splitlines()) == 1, err


def test_without_a_compiler_for_webassembly_a_page_gets_a_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(exporter.shutil, "which", lambda name: None)
    with pytest.raises(ConfigError, match="needs clang and lld"):
        exporter.export_log_reader(tmp_path, page=True)
