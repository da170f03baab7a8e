"""A diagnosis by native code and by JAX: the same answer, and one line where native code cannot be had."""

import functools
import json
import os
import shutil
import subprocess
import sys
import warnings

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.errors import BackendWarning
from rotorwatch_lab.compiling import native
from rotorwatch_lab.compiling.run import run, run_built
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.experiments.studies.compare_flights import _scene, simulate
from rotorwatch_lab.published import published
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

SAMPLE = SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"
COMMAND = [sys.executable, "-m", "rotorwatch.commands.cli", "diagnose", str(SAMPLE), "--json"]

needs_compiler = pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="needs a C compiler: install gcc or clang")


def said(**env):
    done = subprocess.run(COMMAND, capture_output=True, text=True, env={**os.environ, **env}, check=False)
    assert done.returncode == 1, done.stderr
    return json.loads(done.stdout), done.stderr


ASSESS = """
import json, sys, numpy as np, rotorwatch as rw
d = rw.diagnose(sys.argv[1])
reported = [[e.kind, list(e.rotors), e.onset_s, e.detected_s, [list(a) for a in e.alternatives], list(e.loss)] for e in d.events]
np.savez(sys.argv[2], loss=d.trace.loss, events=json.dumps(reported))
"""


@pytest.mark.thorough
@needs_compiler
def test_both_backends_say_the_same(tmp_path):
    answers = []
    for backend in ("native", "jax"):  # each in a process of its own, as users run them
        out = tmp_path / f"{backend}.npz"
        command = [sys.executable, "-c", ASSESS, str(SAMPLE), str(out)]
        subprocess.run(command, env={**os.environ, "ROTORWATCH_BACKEND": backend}, check=True)
        with np.load(out) as file:
            answers.append((json.loads(str(file["events"])), file["loss"]))
    (a, a_loss), (b, b_loss) = answers
    assert a
    for x, y in zip(a, b, strict=True):
        assert x[:-1] == y[:-1]
        np.testing.assert_allclose(x[-1], y[-1], rtol=1e-9)
    # Rounding is amplified where an onset is chosen; what is estimated moves by no more than that.
    np.testing.assert_allclose(a_loss, b_loss, atol=1e-8)


@needs_compiler
def test_the_command_uses_native_code_of_itself_and_then_needs_no_jax():
    said()  # builds it
    code = (
        "import sys; from rotorwatch.commands import cli\n"
        f"try: cli.main({COMMAND[3:]!r})\nexcept SystemExit: pass\n"
        "print('jax' in sys.modules, file=sys.stderr)"
    )
    env = {k: v for k, v in os.environ.items() if k != "ROTORWATCH_BACKEND"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=False)
    assert done.stderr.splitlines()[-1] == "False"
    assert json.loads(done.stdout)["verdict"] == "fault"


def test_without_a_compiler_jax_runs_and_says_so_only_when_native_code_was_asked_for(monkeypatch):
    monkeypatch.setenv("CC", "nonesuch")
    method, table = (EKF(RateDynamics.of(airframes.paper("niermeyer-hexa")), 0.01), (np.full((5, 6), 0.3), np.zeros((5, 4))))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(method, *table, backend="auto")
    with pytest.warns(BackendWarning, match=r"no C compiler \(nonesuch\).*JAX runs instead"):
        run(method, *table, backend="native")


def test_the_command_says_in_one_line_that_there_is_no_compiler():
    """Of a published method: the default's code comes with the package, or is made here before the compiler is gone, else Python runs it
    for two minutes."""
    line = "rotorwatch: There is no C compiler (nonesuch): install gcc or clang, or set CC. JAX runs instead."
    code = (
        f"import os, rotorwatch; rotorwatch.diagnose({str(SAMPLE)!r}); os.environ['CC'] = 'nonesuch'\n"
        f"from rotorwatch.commands import cli; cli.main({[*COMMAND[3:], '--estimator', 'ekf']!r})"
    )
    env = {**os.environ, "ROTORWATCH_BACKEND": "native"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=False)
    assert done.returncode in (0, 1, 3) and line in done.stderr


def test_a_published_methods_native_code_is_known_by_its_name():
    """Native code of a method is known by name and arguments; a stranger's, whose source may change, never is."""
    build = published.builder("ekf", 0.05, ())
    assert native._named(build) == native._named(published.builder.__wrapped__("ekf", 0.05, ()))
    assert native._named(build) != native._named(published.builder("ekf", 0.1, ()))
    assert native._named(published.builder("test_backends:Strange", 0.05, ())) is None
    assert native._named(functools.partial(published.watched, "ekf", 0.05, np.ones(2))) is None


@pytest.mark.thorough
@needs_compiler
def test_a_published_methods_native_code_says_what_jax_says(monkeypatch):
    """Of a whole flight; step by step every method's code is compared in test_export_estimators."""
    vehicle = airframes.named("ardupilot-quad-x")
    flight = simulate(vehicle, [0.4], [1], [20.0], np.random.default_rng(3))[0]
    table = _scene("one", flight, vehicle, ()).ticks
    seen = {}
    for backend in ("native", "jax"):
        monkeypatch.setenv("ROTORWATCH_BACKEND", backend)
        seen[backend] = published.assess("ekf", table, vehicle.effectiveness())[0]
    assert np.ptp(seen["jax"].theta[:, 1]) > 0.3
    np.testing.assert_allclose(seen["native"].theta, seen["jax"].theta, atol=1e-8)
    assert (seen["native"].announced == seen["jax"].announced).all()


class Turning:
    """x' = gain x + u; refused as C with a loop whose end depends on data."""

    def __init__(self, gain, endless):
        self.gain, self.endless = gain, endless

    def init(self):
        return np.zeros(2)

    def step(self, carry, u, y, valid):
        import jax

        x = self.gain * carry + u
        if self.endless:
            x = jax.lax.while_loop(lambda x: x[0] > 1.0, lambda x: 0.5 * x, x)
        return x, x


@needs_compiler
@pytest.mark.parametrize("endless", [False, True])
def test_a_strangers_method_is_traced_once_for_all_vehicles(monkeypatch, endless):
    """Its functions are known in this process only; one that cannot be C is refused once, and one JAX program serves all."""
    made, programs, counts = [], [], []
    trace = native._made
    monkeypatch.setattr(native, "_made", lambda *given: made.append(1) or trace(*given))

    def build(parameters):
        programs.append(1)
        return Turning(parameters["gain"], endless)

    u, y = np.full((30, 2), 0.6), np.zeros((30, 1))
    for gain in (0.5, 0.8):
        _, x = run_built(build, {"gain": gain}, u, y, np.isfinite(y), carry=np.zeros(2), backend="auto")
        want = np.zeros(2)
        for row in x:
            want = gain * want + 0.6
            while endless and want[0] > 1.0:
                want = 0.5 * want
            np.testing.assert_allclose(row, want, rtol=1e-12)
        counts.append(len(programs))
    assert len(made) == 1 and counts[0] == counts[1]
    run_built(build, {"gain": np.full(2, 0.5)}, u, y, np.isfinite(y), carry=np.zeros(2), backend="auto")
    assert len(made) == 2  # another shape


class Strange(EKF):
    """A method of another package."""

    name = "strange"
