"""The template project under examples/plugin: installed as a stranger would install it, used by the real command line."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rotorwatch as rw

ROOT = Path(__file__).resolve().parents[1]
TEMPLATE = ROOT / "examples" / "plugin"
pytest.importorskip("hatchling")
pytest.importorskip("pip")


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """command(*words) -> what a process says in whose path the template is installed."""
    site = tmp_path_factory.mktemp("site")
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check", "--no-compile"]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, "--target", site, TEMPLATE], check=True)
    path = os.pathsep.join([str(ROOT / "src"), str(site)])

    def run(*words):
        return subprocess.run(
            [sys.executable, "-m", *words], cwd=site, env={**os.environ, "PYTHONPATH": path}, capture_output=True,
            text=True, timeout=300,
        )  # fmt: skip

    return run


@pytest.fixture(scope="module")
def acme(tmp_path_factory):
    """A sample flight of a quadrotor as Acme would have logged it: other rotor order, per cent, degrees, g."""
    flight = rw.read(ROOT / "src/rotorwatch/samples/quadx_healthy_hover.bin.xz")
    lines = ["ACMELOG 1"]

    def write(kind, name, scale=1.0, columns=slice(None), offset=0.0, beside=None):
        signal = flight[name]
        values = (signal.values[:, columns] - offset) * scale
        if beside is not None:
            values = np.hstack([values, beside])
        lines.extend(f"{kind},{1e6 * t:.0f}," + ",".join(f"{v:.7g}" for v in row) for t, row in zip(signal.time, values))

    write("M", "motors", 0.1, [2, 0, 3, 1], 1000.0)  # ArduPilot: front right, rear left, front left, rear right
    write("I", "gyro", 180 / np.pi, beside=flight["accel"].values / 9.80665)
    write("A", "attitude")
    write("V", "velocity")
    write("P", "position")
    path = tmp_path_factory.mktemp("acme") / "flight.acme"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_its_log_and_airframe_are_read_by_the_real_command(command, acme):
    done = command("rotorwatch.commands.cli", "info", str(acme))
    assert done.returncode == 0 and "Acme log" in done.stdout and "acme-quad" in done.stdout, done.stderr
    assert "has what a diagnosis needs" in done.stdout and not done.stderr


def test_what_it_holds_is_listed_with_its_package(command):
    done = command("rotorwatch.commands.cli", "benchmark", "--list")
    listed = " ".join(done.stdout.split())
    for name in ("template_observer", "template-full-output"):
        assert name in listed, done.stdout + done.stderr
    assert "rotorwatch-plugin-template 1.0.0" in listed and not done.stderr


def test_its_own_tests_pass(command):
    done = command("pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull, str(TEMPLATE / "tests"))
    assert done.returncode == 0 and "5 passed" in done.stdout, done.stdout + done.stderr
