"""Exported C says what Python says: every estimator, step by step, in double and single precision."""

import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from exporting import STRICT, address, difference, estimator, exported, library, measurements, room, struct
from rotorwatch.base import discovery
from rotorwatch_lab.compiling.c99 import operations
from rotorwatch_lab.compiling.c99.plan import Plan
from rotorwatch_lab.export_c import export_c, program_of

EQUAL = 1e-12
NAMES = [name for name in discovery.estimators() if name != "default"]  # of that see test_export_default.py
# Random steps a method is compared on; sliding windows carry much more along. With ROTORWATCH_FULL_LAW=1
# set: 100,000 steps of every method, and the sanitizers on every one of them, in some 20 minutes.
FULL = os.environ.get("ROTORWATCH_FULL_LAW") == "1"
ROWS = {"mhe": 300, "esmf": 300, "aesmf": 300, "aesmf-on-rates": 300, "ekf": 5_000}
USUAL_ROWS, MANY_ROWS = 1_000, 100_000
CHUNK = {"mhe": 1_000, "esmf": 5_000, "aesmf": 5_000, "aesmf-on-rates": 5_000}  # rows of one flight, whose carries fit the memory
# Single precision: largest difference of losses over a flight, in losses, and of the covariance, relative.
FLOAT_LOSS, FLOAT_FLIGHT = 1e-4, 400
FLOAT = ("ekf", "adaptive_ekf", "lyapunov", "ukf", "tsukf")
SANITIZE = ("-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


# aesmf has all of the step of esmf.
USUAL = ("aesmf-on-rates", "mhe", "imm")
ALL = [USUAL[0], *(n for n in NAMES if FULL or n != "esmf")]


@pytest.mark.parametrize("name", [pytest.param(n, marks=[] if n in USUAL else pytest.mark.thorough) for n in ALL])
def test_a_step_in_c_is_the_step_in_python(name, tmp_path):
    program = exported(name)
    lib = library(program, tmp_path, "-O1" if FULL or name in FLOAT else "-O0")
    rows, found = MANY_ROWS if FULL else ROWS.get(name, USUAL_ROWS), (0.0, "")
    chunk = min(rows, CHUNK.get(name, 10_000))
    for seed in range(rows // chunk):
        much, where = difference(name, program, lib, chunk, seed)
        assert much <= EQUAL, f"{where} differs by {much:.2g} in flight {seed}"
        found = max(found, (much, where))
    print(f"{name}: {rows} steps, at most {found[0]:.1e} ({found[1]})")


def forgetful(packed):
    """Storage that is given away as soon as it is written."""
    return lambda self, kind, blocks: packed(self, kind, [(size, begin, begin, node) for size, begin, _, node in blocks])


@pytest.mark.parametrize("fault", ["sign", "storage", "order"])
def test_the_law_catches_planted_errors(fault, tmp_path, monkeypatch):
    if fault == "sign":
        wrong = operations.ELEMENTWISE["sub"]._replace(c={"f": "({0} - R(1.000000001) * {1})", "i": "0", "l": "0"})
        monkeypatch.setitem(operations.ELEMENTWISE, "sub", wrong)
    elif fault == "storage":
        monkeypatch.setattr(Plan, "_packed", forgetful(Plan._packed))
    program = program_of(estimator("ekf"), "ekf")
    if fault == "order":
        source = re.sub(r"a\[9 \* i \+ k0\]", "a[9 * k0 + i]", program.source)
        assert source != program.source
        program = type(program)(**{**vars(program), "source": source})
    lib = library(program, tmp_path, "-O0", "-Wno-restrict")
    assert difference("ekf", program, lib, 300)[0] > EQUAL


def runs(program, lib, real, table):
    """A whole flight in C."""
    u, y, valid = table
    state, out = np.zeros((), struct(program.state, real)), np.zeros(len(u), struct(program.out, real))
    keep = room(program)
    getattr(lib, f"{program.name}_init")(address(state), address(keep))
    rows = [np.ascontiguousarray(a) for a in (u.astype(real), y.astype(real), valid)]
    getattr(lib, f"{program.name}_run")(len(u), address(state), *map(address, rows), address(out), address(keep))
    return out


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("name", FLOAT)
def test_single_precision_is_close(name, tmp_path):
    """The same flight with float and with double; float calls float functions only."""
    program, table = exported(name), measurements(estimator(name), FLOAT_FLIGHT)
    double = runs(program, library(program, tmp_path / "d", "-O1"), np.float64, table)
    flags = ("-O1", "-DROTORWATCH_FLOAT", "-Wdouble-promotion")
    single = runs(program, library(program, tmp_path / "s", *flags), np.float32, table)
    gap = np.abs(single["theta"] - double["theta"]).max()
    assert gap < FLOAT_LOSS, gap
    assert np.array_equal(single["status"], double["status"])
    called = subprocess.run(["nm", "-u", str(tmp_path / "s" / f"{program.name}.so")], capture_output=True, text=True).stdout
    assert not re.search(r"\b(sqrt|exp|log|cos|acos|cbrt|pow|fmod)(@|$)", called, re.MULTILINE), called


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("name", NAMES if FULL else ["ekf", "tsukf", "mhe"])
def test_sanitizers_find_nothing(name, tmp_path):
    export_c(name, tmp_path)
    command = ["gcc", *STRICT, *SANITIZE, "-o", str(tmp_path / "example"), *map(str, tmp_path.glob("*.c")), "-lm"]
    subprocess.run(command, check=True)
    done = subprocess.run([str(tmp_path / "example")], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("status"), done.stderr[:2000]
