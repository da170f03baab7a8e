"""Code that comes with the package: only of this definition, only for this computer, and enough to judge flights without JAX."""

import hashlib
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.compiling import native, shipped, toolchain
from rotorwatch.compiling.run import run_built
from rotorwatch.default import program, shipping
from rotorwatch.default.plant import lower_rotors
from rotorwatch.flight import vehicle_file
from rotorwatch.front.definition import FRONT
from rotorwatch.logs.blackbox.decoder import BLACKBOX
from rotorwatch.motion.ticks import JUDGE, TICKS_S

SAMPLE = SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"
FRAME, LATER = shipping.Frame(6), shipping.Frame(6, True)

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="needs a C compiler: install gcc or clang"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What a build of the package makes, for hexarotors; the one that came with this installation, if it is of this definition. Code of
    those with coaxial arms is C."""
    if shipped.find(key()) and shipped.source(key(LATER)):
        return shipped.FOLDER
    made = tmp_path_factory.mktemp("built")
    shipping.ship(made, [FRAME, LATER])
    return made


def key(frame=FRAME):
    return native.known_by(program.estimator, program.tick_output, *shipping.example(frame))


def copied(folder, to):
    shutil.copytree(folder, to)
    return to


def test_an_example_is_known_as_vehicles_are():
    """Every frame that rotorwatch knows has a program, whatever its ticks and whatever healthy flights have taught."""
    known = {key(frame) for frame in shipping.FRAMES}
    assert len(known) == len(shipping.FRAMES)
    for name in (
        "ardupilot-quad-x",
        "ardupilot-tri",
        "ardupilot-y6",
        "ardupilot-deca-x",
        "ardupilot-dodecahexa-x",
        "ardupilot-quad-y4",
    ):
        B = airframes.named(name).effectiveness()
        n = B.shape[1]
        assert shipping.Frame(n, lower_rotors(B) is not None) in shipping.FRAMES
        usual = program.parameters(B, TICKS_S[-1])
        learned = {k: np.asarray(usual[k]).tolist() for k in ("x0", "P0", "noise", "noise_weight")}
        for given in (usual, program.parameters(B, TICKS_S[1], learned)):
            assert native.known_by(program.estimator, program.tick_output, given, (n + 15, 4)) in known


def test_the_definition_is_what_the_step_imports_and_nothing_else():
    files = shipping.definition()["files"]
    assert {
        "default/estimator.py",
        "default/bank.py",
        "default/program.py",
        "front/ticks.py",
        "compiling/c99/emit.py",
    } <= set(files)
    assert not [f for f in files if f.startswith(("logs/", "report/", "answer/", "flight/", "live/"))]
    traced = """
import sys, numpy as np
from rotorwatch.default import program, shipping
parameters, _ = shipping.example(shipping.Frame(3))
program.estimator(parameters).init()
import rotorwatch.default.estimator
rooms = ("rotorwatch.default.", "rotorwatch.compiling.c99.")
print("\\n".join(m.__file__ for name, m in sys.modules.items() if name.startswith(rooms)))
"""
    done = subprocess.run([sys.executable, "-c", traced], capture_output=True, text=True, check=True)
    used = {Path(line).relative_to(shipped.HOME).as_posix() for line in done.stdout.splitlines()}
    assert used - set(files) <= {"default/shipping.py"}


@pytest.mark.thorough(keep=1)
@needs_compiler
@pytest.mark.parametrize("dt", [TICKS_S[0], TICKS_S[2]])
def test_shipped_code_says_what_the_definition_says(folder, dt):
    """The numbers, against JAX running the definition itself."""
    rng = np.random.default_rng(2)
    B = airframes.named("ardupilot-hexa-x").effectiveness()
    T, n = 400, 6
    thrust = 1.0 + 0.05 * rng.normal(size=(T, n))
    loss = np.where(np.arange(T)[:, None] > 250, [0.0, 0.3, 0.0, 0.0, 0.0, 0.0], 0.0)
    u = np.column_stack([
        thrust, 0.3 * rng.normal(size=(T, 3)), n + 0.1 * rng.normal(size=T), 0.1 * rng.normal(size=(T, 3)),
        0.2 * rng.normal(size=(T, 2)), np.full(T, 2.0), np.full(T, 0.65), np.full(T, 0.3), rng.normal(size=T),
        np.full(T, float(JUDGE)), np.zeros(T),
    ])  # fmt: skip
    y = thrust @ B.T + (thrust * loss) @ B.T + 0.02 * rng.normal(size=(T, 4))
    found = shipped.find(key(), folder)
    assert found is not None
    library = native.Library(found[0], native.Layout(*json.loads(json.dumps(found[1]))))
    parameters, valid = program.parameters(B, dt), np.ones((T, 4), bool)
    own = native.run(library, parameters, program.estimator(parameters).init(), u, y, valid)[1]
    said = run_built(program.estimator, parameters, u, y, valid, program.tick_output, backend="jax")[1]
    assert own.announced.any() == said.announced.any()
    np.testing.assert_allclose(own.theta, said.theta, atol=1e-8)
    np.testing.assert_allclose(own.log_odds, said.log_odds, rtol=1e-7, atol=1e-7)


@needs_compiler
def test_code_of_another_definition_or_computer_never_runs(folder, tmp_path, monkeypatch):
    def reread(change):
        place = copied(folder, tmp_path / str(len(list(tmp_path.iterdir()))))
        told = json.loads((place / shipped.INDEX).read_text())
        change(told, place)
        (place / shipped.INDEX).write_text(json.dumps(told))
        return place

    assert shipped.find(key(), reread(lambda told, _: None))
    other = reread(lambda told, _: told["definition"].update(digest="0" * 64))
    assert shipped.find(key(), other) is None and "another version of the method" in shipped.why_not(other)
    other = reread(lambda told, _: told.update(target="plan9 vax"))
    assert shipped.find(key(), other) is None and "plan9 vax" in shipped.why_not(other)
    gone = reread(lambda told, place: [path.unlink() for path in place.glob("*.so")])
    assert shipped.find(key(), gone) is None
    (gone / shipped.INDEX).write_text("{")
    shipped._index.cache_clear()
    assert shipped.find(key(), gone) is None and "damaged" in shipped.why_not(gone)
    assert shipped.find(key(), tmp_path / "nowhere") is None and "without native code" in shipped.why_not(
        tmp_path / "nowhere"
    )
    # A file of the definition has changed.
    place = reread(lambda told, _: None)
    home = copied(shipped.HOME / "default", tmp_path / "home" / "default").parent
    for name in shipping.definition()["files"]:
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_bytes((shipped.HOME / name).read_bytes())
    monkeypatch.setattr(shipped, "HOME", home)
    assert shipped.find(key(), place)
    shipped._index.cache_clear()
    (home / "default" / "bank.py").write_text((home / "default" / "bank.py").read_text() + "SLOTS = 15\n")
    assert shipped.find(key(), place) is None


def test_a_processor_gets_what_it_runs(tmp_path, monkeypatch):
    about = {"files": ["errors.py"], "digest": shipped.digest(["errors.py"])}
    empty = hashlib.sha256(b"").hexdigest()
    libraries = {"x86-64-v3": ("fast.so", empty), "x86-64": ("any.so", empty)}
    index = {"definition": about, "target": shipped.target(), "programs": {"a": {"libraries": libraries, "layout": []}}}
    (tmp_path / shipped.INDEX).write_text(json.dumps(index))
    for name, _ in libraries.values():
        (tmp_path / name).touch()
    for levels, expected in ((("x86-64-v3", "x86-64"), "fast.so"), (("x86-64",), "any.so"), (("",), None)):
        monkeypatch.setattr(shipped, "levels", lambda levels=levels: levels)
        found = shipped.find("a", tmp_path)
        assert (found and found[0].name) == expected
    assert shipped.whole(tmp_path)
    (tmp_path / "any.so").write_bytes(b"of somebody else")
    monkeypatch.setattr(shipped, "levels", lambda: ("x86-64",))
    shipped._as_built.cache_clear()
    assert shipped.find("a", tmp_path) is None
    assert not shipped.whole(tmp_path)


# What refuses to be imported, as if it were not installed; and the place of the native code.
WITHOUT = """
import sys
import zipfile
from pathlib import Path
class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"jax", "jaxlib", "scipy", "pymavlink", "bokeh", "pandas", "pyarrow", "sqlalchemy", "mcap"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Refused())
from importlib import metadata
real = metadata.version
def version(name):
    if name in ("jax", "scipy"):
        raise metadata.PackageNotFoundError(name)
    return real(name)
metadata.version = version
from rotorwatch.compiling import shipped
place = Path(sys.argv.pop(1))
find, source, why_not = shipped.find, shipped.source, shipped.why_not
shipped.find, shipped.source = (lambda wanted: find(wanted, place)), (lambda wanted: source(wanted, place))
shipped.why_not = lambda: why_not(place)
from rotorwatch.commands import cli
cli.main(sys.argv[1:])
"""


def without(place, *arguments, **env):
    environment = {k: v for k, v in os.environ.items() if k != "ROTORWATCH_BACKEND"}
    return subprocess.run(
        [sys.executable, "-c", WITHOUT, str(place), *arguments],
        capture_output=True, text=True, check=False, env={**environment, **env},
    )  # fmt: skip


@needs_compiler
def test_flights_are_judged_without_jax_scipy_and_a_compiler(folder):
    done = without(folder, "diagnose", str(SAMPLE), "--json", CC="nonesuch")
    assert done.returncode == 1, done.stderr
    assert json.loads(done.stdout)["verdict"] == "fault"


@pytest.fixture
def y6(tmp_path):
    """A vehicle file that makes the sample's hexarotor one with coaxial arms."""
    vehicle_file.write(airframes.named("ardupilot-y6"), tmp_path / "y6.toml")
    return tmp_path / "y6.toml"


def counted(folder):
    """The compiler, quick and without optimisation; a line in `folder`/count each time that it compiles an estimator."""
    fast, real = folder / "fast", shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    count = f'case "$*" in *estimator.c*) echo built >> {folder}/count;; esac'
    fast.write_text(f'#!/bin/sh\n{count}\nexec {real} "$@" -O0\n')
    fast.chmod(0o755)
    return str(fast)


@needs_compiler
def test_code_of_other_frames_is_compiled_when_one_is_first_met(folder, y6, tmp_path):
    env = {"CC": counted(tmp_path), "ROTORWATCH_CACHE": str(tmp_path / "cache")}
    done = without(folder, "diagnose", str(SAMPLE), "--vehicle", str(y6), **env)
    assert done.returncode in (0, 1, 3)
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        "rotorwatch: Building the estimator for vehicles with 6 rotors on coaxial arms, the first time only"
    )


FIRST_USE = """
import warnings
from rotorwatch.compiling import native, shipped
warnings.showwarning = lambda message, *where: print(message)
c = shipped.Source("somebody", "", "void estimator_run(void) {} void estimator_step(void) {}", ["estimator", [], [], [], 0, 0, 0])
native._compiled(c)
"""


@needs_compiler
def test_code_is_compiled_once_also_where_two_ask_for_it_at_the_same_time(tmp_path):
    """One of them says so, and afterwards nobody has to."""
    env = {**os.environ, "CC": counted(tmp_path), "ROTORWATCH_CACHE": str(tmp_path / "cache")}
    line = [sys.executable, "-c", FIRST_USE]
    both = [subprocess.Popen(line, env=env, stdout=subprocess.PIPE, text=True) for _ in "ab"]
    said = [process.communicate()[0] for process in both]
    assert [process.returncode for process in both] == [0, 0]
    assert sorted(said) == ["", "Building the estimator for somebody, the first time only: about 10 s.\n"]
    assert subprocess.run(line, env=env, check=True, capture_output=True).stdout == b""
    assert (tmp_path / "count").read_text() == "built\n"


@needs_compiler
def test_without_a_compiler_one_sentence_says_what_other_frames_need(folder, y6):
    done = without(folder, "diagnose", str(SAMPLE), "--vehicle", str(y6), CC="nonesuch")
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 2 and "no C compiler (nonesuch)" in line
    assert "vehicles with 6 rotors on coaxial arms" in line and "pip install jax" in line


@needs_compiler
def test_c_that_was_changed_is_not_compiled(folder, tmp_path):
    place = copied(folder, tmp_path / "built")
    assert shipped.source(key(LATER), place)
    (path,) = place.glob(f"{LATER.name}.c.xz")
    shipped.write_source(path, "", "int estimator_run;")
    assert shipped.source(key(LATER), place) is None and not shipped.whole(place)


@pytest.mark.parametrize("portable", [True, False])
def test_wheels_hold_compiled_code_of_all_frames_and_checkouts_of_those_of_the_demo(portable, tmp_path, monkeypatch):
    compiled = {}
    monkeypatch.setattr(
        shipping, "made", lambda frame, marches, folder: (compiled.update({frame: marches}) or frame.name, {})
    )
    monkeypatch.setattr(shipping.os, "cpu_count", lambda: 1)  # in this process
    monkeypatch.setattr(toolchain, "compiler", lambda: "cc")
    monkeypatch.setattr(toolchain, "processor", platform.machine)
    for definition in (FRONT, BLACKBOX):
        monkeypatch.setattr(definition, "ship", lambda folder: None)
    shipping.ship(tmp_path, portable=portable)
    assert {frame for frame, marches in compiled.items() if marches} == set(
        shipping.FRAMES if portable else shipping.FIRST
    )
    assert set(compiled) == set(shipping.FRAMES)


def test_a_report_without_bokeh_is_refused_before_the_work(tmp_path):
    page = tmp_path / "page.html"
    for arguments in (["diagnose", str(SAMPLE), "--report", str(page)], ["demo", "--report", str(page)]):
        done = without(tmp_path, *arguments)
        (line,) = done.stderr.strip().splitlines()
        assert (done.returncode, done.stdout) == (2, "") and "--report needs bokeh, which is not installed" in line
        assert not page.exists()


def test_telemetry_logs_are_read_without_pymavlink(tmp_path):
    log = Path(__file__).parents[2] / "shared" / "flights" / "ardupilot-sitl" / "quadx_m3_mul0.85_tlog.tlog.xz"
    if not log.exists():
        pytest.skip(f"the shared flight {log.name} is not here")
    done = without(tmp_path, "info", str(log), "--json")
    assert done.returncode == 0 and json.loads(done.stdout)["rotors"] == 4, done.stderr


@pytest.mark.parametrize("arguments", [["info", str(SAMPLE)], ["--help"], ["diagnose", "--help"], ["watch", "--help"]])
def test_other_commands_need_neither(arguments, tmp_path):
    done = without(tmp_path, *arguments)
    assert done.returncode == 0, done.stderr


@needs_compiler
def test_healthy_flights_teach_without_either(folder, tmp_path):
    healthy = SAMPLES / "quadx_healthy_hover.bin.xz"
    done = without(folder, "calibrate", str(healthy), "-o", str(tmp_path / "v.toml"), CC="nonesuch")
    if "no native code for such a vehicle" not in done.stderr.lower():  # where only hexarotors were built
        assert done.returncode == 0, done.stderr


def test_without_native_code_one_sentence_says_what_is_missing(tmp_path):
    done = without(tmp_path, "diagnose", str(SAMPLE), CC="nonesuch")
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 2 and "JAX" in line and "pip install" in line
    done = without(tmp_path, "survive", "--vehicle", "ardupilot-quad-x", "--quiet")
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 2 and "pip install" in line and "please report" not in line


def test_asking_the_cache_needs_nothing_but_python(tmp_path):
    """The build of the package asks before anything is installed."""
    code = "import sys; from rotorwatch.default import shipping; print(shipping.kept(False)); print('numpy' in sys.modules)"
    env = {"PYTHONPATH": str(shipped.HOME.parent), "ROTORWATCH_CACHE": str(tmp_path), "PATH": os.environ["PATH"]}
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, check=False, env=env)
    if "no C compiler" in done.stderr:
        pytest.skip("needs a C compiler")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[1] == "False" and toolchain.folder()


def test_a_package_without_native_code_brings_jax(tmp_path):
    """On a computer without a compiler `pip install .` still gives something that runs."""
    root = Path(__file__).parents[1]
    environment = {k: v for k, v in os.environ.items() if k not in ("CC", "ROTORWATCH_SHIP")} | {"PATH": str(tmp_path)}
    line = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        str(tmp_path),
        str(root),
    ]
    subprocess.run(line, env=environment, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as parts:
        names = parts.namelist()
        metadata = parts.read(next(name for name in names if name.endswith("METADATA"))).decode()
    assert not [name for name in names if "compiling/built" in name]
    needed = {
        line.split()[1].split(">")[0]
        for line in metadata.splitlines()
        if line.startswith("Requires-Dist") and ";" not in line
    }
    assert {"jax", "scipy", "numpy"} <= needed


def test_a_cross_compiler_builds_for_its_own_kind_of_processor(tmp_path, monkeypatch):
    fake = tmp_path / "aarch64-linux-gnu-gcc"
    fake.write_text("#!/bin/sh\necho aarch64-linux-gnu\n")
    fake.chmod(0o755)
    toolchain.processor.cache_clear()
    monkeypatch.setenv("CC", str(fake))
    try:
        assert toolchain.processor() == "aarch64"
        assert shipping.levels(portable=True) == shipping.levels(portable=False) == (shipped.BASELINE,)
        assert shipped.target(toolchain.processor()) == f"{sys.platform} aarch64" != shipped.target()
    finally:
        toolchain.processor.cache_clear()


def test_what_changes_pythons_start_is_kept_from_the_build_of_the_code(tmp_path, monkeypatch):
    """Of an isolated build: it would take the sources out of the path where they are installed in place already."""
    spec = importlib.util.spec_from_file_location("hatch_build", Path(__file__).parents[1] / "hatch_build.py")
    assert spec is not None and spec.loader is not None
    build = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build)
    isolated = tmp_path / "site"
    isolated.mkdir()
    (isolated / "sitecustomize.py").touch()
    monkeypatch.setattr(sys, "path", [str(isolated), str(tmp_path)])
    assert build._paths() == [str(tmp_path)]
