"""What all tests share: how JAX compiles for them, and a fabricated but complete diagnosis, as the diagnoser would make it."""

import ctypes
import gc
import importlib
import importlib.util
import mmap
import os
import shutil
import sys
from contextlib import suppress
from dataclasses import replace
from importlib import metadata
from pathlib import Path

# Each core runs tests already: a second thread for small matrices only waits, and makes JAX's programs a quarter dearer (NPROC: of XLA).
# Before NumPy and JAX are imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("NPROC", "1")

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.answer import from_takeoff, places
from rotorwatch.answer.conclusion import Evidence, conclude
from rotorwatch.answer.ledger import open_claims
from rotorwatch.base.compiling import running
from rotorwatch.flight.diagnosis import Diagnosis, Event, Trace
from rotorwatch_lab.compiling import native

# Tests run as users run them, and so do the commands that they start: PYTHONUNBUFFERED or COLUMNS of a developer's shell can hide a fault.
# Besides what everyone has, there stays where Python, compilers and temporary files are, and what says how the tests themselves are run.
EVERYONE = "HOME PATH LANG TMPDIR SYSTEMROOT TEMP TMP USERPROFILE LOCALAPPDATA".split()
OF_TESTS = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE", "ROTORWATCH_CACHE", "ROTORWATCH_FULL_LAW", "CI", "XLA_FLAGS", "OPENBLAS_NUM_THREADS")
for _name in [n for n in os.environ if n not in (*EVERYONE, *OF_TESTS, "NPROC") and not n.startswith(("PYTEST_", "PIP_"))]:
    del os.environ[_name]


def _quick_flags():
    """XLA's switches for programs that are compiled in a sixth of the time; a test runs them over a few hundred rows only.

    All but the first are not known to every release, and XLA ends the process at one that it does not know: releases from 0.12 on hold a
    name without knowing it.
    """
    home = importlib.util.find_spec("jaxlib").submodule_search_locations[0]
    flags = ["--xla_backend_optimization_level=0"]
    known = tuple(map(int, metadata.version("jaxlib").split(".")[:2])) < (0, 12)
    others = ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
    for library in Path(home).glob("*.so") if known else ():
        with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            flags += [f for f in others if f not in flags and text.find(f[2:].partition("=")[0].encode()) >= 0]
    return " ".join(flags)


# Before JAX is imported; processes that tests start inherit it.
os.environ.setdefault("XLA_FLAGS", _quick_flags())
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"  # nobody reads where in our files an operation of a program came from

native.BIG, native.QUICK = 0, ("-O0",)  # so are published methods as C

_build = running.Definition.build


def _quickly_built(definition, *place):
    """An engine with other constants flies some hundred ticks: less optimised it is built sooner, and calculates the same bits."""
    with pytest.MonkeyPatch.context() as patch:
        if definition._other:
            patch.setattr(running, "VECTORS", ("-O0", *running.VECTORS[1:]))
        return _build(definition, *place)


running.Definition.build = _quickly_built

# JAX's tracing makes so many small objects that looking for cycles among all of them takes a third of its time.
gc.set_threshold(50_000, 20, 50)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session):
    """Of two workers with the whole suite before them one loads the tests from the last to the first: half of what Python and pytest make
    of the sources has been made by the other when it comes to them."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    if worker.endswith(("1", "3", "5", "7", "9")) and list(session.config.args) == session.config.getini("testpaths"):
        for path in sorted(Path(__file__).parent.glob("test_*.py"), reverse=True):
            with suppress(Exception, pytest.skip.Exception):  # collection comes to it once more, and tells
                importlib.import_module(path.stem)


def pytest_collection_finish():
    """What has been imported and collected by now stays, and is not looked through again."""
    gc.collect()
    gc.freeze()


def pytest_addoption(parser):
    parser.addoption("--thorough", action="store_true", help="also what is marked thorough: every case, however long it takes")


def _whole(config):
    return config.getoption("thorough") or any("::" in arg for arg in config.args)


def pytest_collection_modifyitems(config, items):
    """Without --thorough, of a test with @pytest.mark.thorough(keep=N) only N cases run, spread over all; none where N is left out.

    A test that is named on the command line (FILE::TEST) runs whole.
    """
    if _whole(config):
        return
    cases = {}
    for item in items:
        if item.get_closest_marker("thorough"):
            cases.setdefault(item.nodeid.split("[")[0], []).append(item)
    left_out = set()
    for found in cases.values():
        keep = found[0].get_closest_marker("thorough").kwargs.get("keep", 0)
        kept = {round(k * (len(found) - 1) / max(1, keep - 1)) for k in range(keep)}
        left_out |= {item for k, item in enumerate(found) if k not in kept}
    items[:] = [item for item in items if item not in left_out]
    if left_out:
        config.hook.pytest_deselected(items=list(left_out))


_trials = 0.3


def pytest_configure(config):
    global _trials
    _trials = 1.0 if _whole(config) else _trials


def trials(most):
    """How many examples of a property are tried: so many with --thorough."""
    return max(1, round(_trials * most))


@pytest.fixture(scope="session")
def amount(request):
    """amount(usual, thorough): the one or the other, of what a test tries many of."""
    return lambda usual, thorough: thorough if _whole(request.config) else usual


MAPS = 20_000
GROWN = 1 << 30  # bytes


@pytest.fixture(autouse=True, scope="module")
def _what_files_leave_behind_goes():
    """Compiled programs, and what only a look through everything finds, go where memory has grown since the last time.

    Files share what is compiled until then: what every one of them traces and loads again takes a tenth of the whole time. A loaded
    program holds some 20 memory maps, of which a process may have 65,530: beyond that JAX dies without a word.
    """
    yield
    global _held
    if _in_memory() > _held + GROWN or _maps() > MAPS:
        if "jax" in sys.modules:
            sys.modules["jax"].clear_caches()
        gc.collect()
        if hasattr(_C, "malloc_trim"):  # glibc keeps what was freed: 1.2 of 1.7 GB after test_laws.py
            _C.malloc_trim(0)
        _held = _in_memory()


_C = ctypes.CDLL(None) if os.name == "posix" else None


def _maps():
    reported = Path("/proc/self/maps")
    return len(reported.read_bytes().splitlines()) if reported.exists() else 0


def _in_memory():
    reported = Path("/proc/self/statm")
    return int(reported.read_text().split()[1]) * mmap.PAGESIZE if reported.exists() else 0


_held = _in_memory()


@pytest.fixture(scope="module")
def server():
    """A PostgreSQL server of the tests' own (postgres_server.py)."""
    pytest.importorskip("psycopg")
    from postgres_server import Server

    server = Server()
    yield server
    server.close()


def hexa_trace(duration=60.0, rate=50.0, rotors=6, onset=31.2, detected=31.56, loss=0.37, seed=1):
    """A hovering hexa whose rotor 3 weakens at `onset`; noise as on a calm day."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 1 / rate)
    size = (time.size, rotors)
    estimate = 0.012 * np.abs(np.cumsum(rng.standard_normal(size), axis=0) / np.sqrt(rate * 20))
    width = np.full(size, 0.02)
    after = time > detected
    estimate[after, 2] = loss + 0.006 * rng.standard_normal(after.sum())
    width[after, 2] = 0.02 + 0.12 * np.exp(-(time[after] - detected) / 0.8)
    command = 0.42 + 0.012 * rng.standard_normal(size)
    command[after, 2] += 0.16
    command[time < 4.0] = 0.0
    sd = np.tile([0.006, 0.006, 0.004, 0.02], (time.size, 1))
    residual = sd * rng.standard_normal((time.size, 4))
    residual[(time > onset) & (time < onset + 2), :] += [0.05, 0.09, -0.02, -0.06]
    growth = np.clip((time - onset) * 16, -3, 40)
    evidence = {
        f"rotor {k}": (growth if k == 3 else np.clip(growth * 0.3 - k, -6, 4)) + rng.standard_normal(time.size)
        for k in range(1, rotors + 1)
    }
    evidence["common mode"] = np.full(time.size, -2.0) + rng.standard_normal(time.size)
    return Trace(
        time=time,
        loss=estimate,
        lower=np.clip(estimate - width, 0, 1),
        upper=np.clip(estimate + width, 0, 1),
        residual=residual,
        residual_sd=sd,
        command=command,
        evidence=evidence,
        blind=((4.0, 7.5, "learning what healthy means for this flight"),),
        airborne=((4.0, duration - 2.0),),
        threshold=6.0,
        attitude=5.0 * rng.standard_normal((time.size, 3)),
        wanted=4.0 * rng.standard_normal((time.size, 3)),
        messages=((3.5, "armed", "armed"), (4.0, "mode", "LOITER"), (33.0, "error", "crash check"), (40.0, "mode", "LAND")),
        **hexa_context(time, duration),
    )


def hexa_context(time, duration=60.0):
    """It climbs to 12 m, flies 40 m east, 20 m north, and comes down; with a battery that sags and a vibration that grows."""
    up = np.interp(time, [4.0, 10.0, duration - 12.0, duration - 2.0], [0.0, 12.0, 12.0, 0.0])
    east = np.interp(time, [10.0, 25.0], [0.0, 40.0])
    north = np.interp(time, [25.0, 40.0], [0.0, 20.0])
    flying = (time >= 4.0) & (time <= duration - 2.0)
    battery = np.stack([16.6 - 0.02 * time, np.where(flying, 21.0, 0.4)], axis=1)
    vibration = np.where(flying, 1.0 + 0.02 * time, 0.05)[:, None] * [0.5, 0.6, 1.4]
    return {
        "position": np.stack([north, east, -up], axis=1),
        "ground_speed": np.hypot(np.gradient(north, time), np.gradient(east, time)),
        "battery": battery,
        "vibration": vibration,
    }


HEXA = airframes.named("ardupilot-hexa-x").rotors


def hexa_event(**changes):
    """Rotor 3 lost 37 % at 31.2 s."""
    event = Event(
        kind="loss_of_effectiveness",
        rotors=(3,),
        onset_s=31.2,
        detected_s=31.56,
        end_s=None,
        loss=(0.37,),
        interval=((0.33, 0.41),),
        probability=0.998,
        reason="Roll and pitch torque fell short of the commands as a weaker rotor 3 would make them.",
    )
    return replace(event, **changes)


def hexa_diagnosis(events=None, whole_flight=None, doubts=(), evidence=(), assessed_s=46.0, population=None, **changes):
    """The answer to these events of a hexa X in 60 s; by default to one, the loss of rotor 3. changes: of the Diagnosis made of it."""
    events, air = (hexa_event(),) if events is None else events, ((4.0, 58.0),)
    compared = (*from_takeoff.claims(whole_flight, from_takeoff.FLIGHTS, air), *from_takeoff.claims(population, from_takeoff.VEHICLES, air))
    seen = Evidence(
        events, 6, hidden=np.full(6, 0.04), assessed_s=assessed_s, claims=open_claims((*compared, *evidence), events),
        places=places.names(HEXA), hops=air, comparable=whole_flight is None,
    )  # fmt: skip
    end = conclude(seen, doubts)
    whole = Diagnosis(
        flight={
            "name": "hexa.bin",
            "format": "ArduPilot DataFlash",
            "autopilot": "ArduPilot",
            "frame": "ardupilot-hexa-x",
            "rotors": 6,
            "duration_s": 60.0,
            "airborne_s": (4.0, 58.0),
            "profile": "commands 50 Hz, gyro 100 Hz",
        },
        verdict=end.verdict,
        reason=end.reason,
        rotors=end.rotors,
        events=end.events,
        common_mode={"thrust_shift": 0.01, "interval": [-0.02, 0.04], "unit": "hover thrusts of one rotor"},
        baseline="the first 8 s of this flight",
        assumptions=("Thrust curve: MOT_THST_EXPO 0.65.", "Mass and inertia unknown: gains identified in flight."),
        warnings=("The log ends in the air.",),
        timing={"read_s": 0.12, "estimate_s": 1.31, "total_s": 1.43},
        comparison=({"detector": "ardupilot-thrust-loss", "rotor": 3, "time_s": 33.4, "reason": "sinking for 1 s"},),
        whole_flight=whole_flight,
        trace=hexa_trace(),
        headline=end.headline,
        main=end.main,
        advice=end.advice,
        story=end.story,
        fit_to_fly=end.fit_to_fly,
        causes=end.causes,
    )
    return replace(whole, **changes)


def against_healthy(**more):
    """The answer to a hexa whose rotor 3 is weaker than in three healthy flights. more: of that comparison."""
    facts = {
        "verdict": "fault", "reason": "rotor 3 lost thrust", "flights": 3, "loss": [0.0, 0.02, 0.3, 0.0, 0.0, 0.05],
        "interval": [(0.0, 0.05)] * 2 + [(0.2, 0.4)] + [(0.0, 0.1)] * 3, "shift": [0.1, -0.02, 0.0], "shift_sd": [0.02, 0.02, 0.01],
        "causes": [{"rotors": [3], "probability": 0.9}, {"kind": "centre_of_mass", "rotors": [], "probability": 0.06},
                   {"rotors": [1], "probability": 0.04}], "common": 0.1,
    }  # fmt: skip
    return hexa_diagnosis(whole_flight={"rotors": [3]} | facts | more)


@pytest.fixture
def fault():
    return hexa_diagnosis()


@pytest.fixture
def healthy():
    return hexa_diagnosis(events=(), warnings=())


@pytest.fixture
def run(capsys):
    """run(*arguments) of the real command line: (exit code, output, errors)."""
    from rotorwatch.commands import cli

    def call(*argv):
        with pytest.raises(SystemExit) as leave:
            cli.main([str(a) for a in argv])
        out, err = capsys.readouterr()
        return leave.value.code, out, err

    return call


@pytest.fixture(scope="session")
def chromium():
    """The browser that pages are tested in: without a window of its own, where there is one: it takes a third of the time."""
    found = next(filter(None, map(shutil.which, ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"))), None)
    if found is None and os.environ.get("CI"):
        pytest.fail("no Chromium found; pages must be checked in a browser here (apt-get install chromium-headless-shell)")
    if found is None:
        pytest.skip("no Chromium found (apt-get install chromium-headless-shell)")
    return found
