"""The exported default estimator says what Python says, tick by tick, and its example runs."""

import ctypes
import subprocess

import numpy as np
import pytest
from tests.embedded_c_parts import STRICT, compilers

from rotorwatch import airframes
from rotorwatch.engine.bindings import program
from rotorwatch.engine.estimator import estimator_sizes
from rotorwatch.engine.estimator.estimator import Result
from rotorwatch.engine.estimator.hypotheses import hypothesis_count
from rotorwatch_lab.export_c import export_c
from test_engine import flight

FRAME, N, TICKS = "ardupilot-hexa-x", 6, 300
B = airframes.named(FRAME).effectiveness()
FITS = {estimator_sizes.ROTORS: N, estimator_sizes.HYPOTHESES: hypothesis_count(N)}


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    return export_c("default", tmp_path_factory.mktemp("default"), vehicle=FRAME, name="mine")


def reported(project, folder, real, *flags):
    """What the library says of a flight: a column for each output."""
    goal = folder / "mine.so"
    command = [compilers()[0], *STRICT, *flags, "-O1", "-fPIC", "-shared", "-o", str(goal), str(project.folder / "mine.c"), "-lm"]
    subprocess.run(command, check=True)
    library, fields = ctypes.CDLL(str(goal)), []
    kinds = {"real": real, "int": np.int32, "flag": np.bool_}
    for name, field in Result.declared():
        shape = tuple(FITS.get(size, size) for size in getattr(field, "shape", ()))
        kind = field.kind if shape else {"int": "int", "bool": "flag"}.get(Result.__annotations__[name], "real")
        fields.append((name, kinds[kind], shape))
    out = np.zeros(TICKS, np.dtype(fields, align=True))
    u, y, valid = flight(B, TICKS, 0.05)
    y[~valid] = np.nan  # what is not valid may hold anything
    state = np.zeros(project.state_bytes // 8 + 64)  # and gaps
    rows = [np.ascontiguousarray(u, real), np.ascontiguousarray(y, real), np.ascontiguousarray(valid)]
    address = [ctypes.c_void_p(a.ctypes.data) for a in (state, *rows, out)]
    library.mine_init(address[0])
    library.mine_run(TICKS - 1, *address)
    library.mine_step(address[0], *(ctypes.c_void_p(a[TICKS - 1 :].ctypes.data) for a in (*rows, out)))
    return out


def test_a_tick_in_c_is_the_tick_in_python(project, tmp_path):
    said, here = reported(project, tmp_path, np.float64), program.steps(0.05, B)
    wanted = here.run(*flight(B, TICKS, 0.05))._asdict()
    assert wanted["announced"].any()
    for name in said.dtype.names:
        np.testing.assert_allclose(said[name], wanted[name], rtol=1e-9, atol=1e-9, err_msg=name)


def test_single_precision_is_close(project, tmp_path):
    said = reported(project, tmp_path, np.float32, "-DROTORWATCH_FLOAT")
    wanted = program.steps(0.05, B).run(*flight(B, TICKS, 0.05))
    assert np.array_equal(said["announced"], wanted.announced)
    assert np.abs(said["theta"] - wanted.theta).max() < 0.02


def test_the_example_builds_without_a_warning_and_runs(project, tmp_path):
    for compiler in compilers():
        files = [str(project.folder / name) for name in ("mine.c", "example.c")]
        subprocess.run([compiler, *STRICT, "-O1", "-o", str(tmp_path / "example"), *files, "-lm"], check=True)
        text = subprocess.run([str(tmp_path / "example")], capture_output=True, text=True, check=True).stdout
        assert text.startswith("announced 0, losses") and text.count("0.000000") == N


def test_the_header_says_what_goes_in_and_of_which_definition_it_is(project):
    header, source = ((project.folder / f"mine.{end}").read_text() for end in "hc")
    for text in ("thrust_1 to thrust_6", "p_dot, q_dot, r_dot [rad/s^2]", project.digest, "mine_init(mine_state *state)"):
        assert text in header
    assert "malloc" not in source and "rw_" not in header.replace("rw_real", "").replace("rw_time", "")
