"""Machine code that comes with the package: only of its definitions, only for this computer, and enough to assess flights without JAX."""

import json
import os
import platform
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from rotorwatch.base.compiling import shipped, toolchain
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.engine.bindings import shipping
from rotorwatch.engine.definition import ENGINE
from script_files import loaded

SAMPLE = SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"

needs_compiler = pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="needs a C compiler: install gcc or clang")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What a build of the package makes; what came with this installation, if it is of these definitions."""
    if all(definition._shipped() for definition in shipping.DEFINITIONS):
        return shipped.FOLDER
    made = tmp_path_factory.mktemp("built")
    shipping.ship(made)
    return made


@needs_compiler
def test_code_of_another_definition_or_computer_never_runs(folder, tmp_path, monkeypatch):
    def found(change):
        place = tmp_path / str(len(list(tmp_path.iterdir())))
        shutil.copytree(folder, place)
        reported = json.loads((place / shipped.DEFINITIONS).read_text())
        change(reported["engine"], place)
        (place / shipped.DEFINITIONS).write_text(json.dumps(reported))
        monkeypatch.setattr(shipped, "FOLDER", place)
        return ENGINE._shipped()

    assert found(lambda reported, place: None)
    assert found(lambda reported, place: reported.update(digest="0" * 64)) is None
    assert found(lambda reported, place: reported.update(target="plan9 vax")) is None
    assert found(lambda reported, place: [path.unlink() for path in place.glob("engine*.so")]) is None
    assert found(lambda reported, place: [path.write_bytes(b"of somebody else") for path in place.glob("engine*.so")]) is None
    monkeypatch.setattr(shipped, "FOLDER", tmp_path / "nowhere")
    assert ENGINE._shipped() is None


def test_code_is_of_the_files_of_its_definitions_and_of_what_translates_them():
    made_of = {Path(str(m.__file__)).relative_to(shipped.HOME).as_posix() for m in (*ENGINE.modules, *ENGINE.sizes)}
    assert made_of | {"base/compiling/body.py"} <= set(ENGINE.files)


@pytest.fixture
def fast(tmp_path):
    """A compiler that builds quickly; `count` beside it has a line for each build of the engine."""
    fast, real = tmp_path / "fast", shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    fast.write_text(f'#!/bin/sh\ncase "$*" in *rw_engine.c*) echo built >> {tmp_path}/count;; esac\nexec {real} "$@" -O0\n')
    fast.chmod(0o755)
    return fast


@needs_compiler
def test_a_processor_gets_what_it_runs(fast, tmp_path, monkeypatch):
    """Wheels that are given away hold code for each level of processors."""
    if platform.machine() != "x86_64":
        pytest.skip("one level only")
    monkeypatch.setenv("CC", str(fast))
    monkeypatch.setattr(shipping, "DEFINITIONS", (ENGINE,))
    shipping.ship(tmp_path / "built", portable=True)
    assert {path.name for path in (tmp_path / "built").glob("*.so")} == {"engine-x86-64-v3.so", "engine-x86-64.so"}
    monkeypatch.setattr(shipped, "FOLDER", tmp_path / "built")
    for levels, expected in ((("x86-64-v3", "x86-64"), "engine-x86-64-v3.so"), (("x86-64",), "engine-x86-64.so"), (("",), None)):
        monkeypatch.setattr(shipped, "levels", lambda levels=levels: levels)
        found = ENGINE._shipped()
        assert (found and found.name) == expected


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
from rotorwatch.base.compiling import shipped
shipped.FOLDER = Path(sys.argv.pop(1))
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
def test_flights_are_assessed_without_jax_scipy_and_a_compiler(folder):
    done = without(folder, "diagnose", str(SAMPLE), "--json", CC="nonesuch")
    assert done.returncode == 1, done.stderr
    assert json.loads(done.stdout)["verdict"] == "fault"


@needs_compiler
def test_machine_code_is_made_once_where_none_came(fast, tmp_path):
    """By the first who needs it, in seconds."""
    env = {"CC": str(fast), "ROTORWATCH_CACHE": str(tmp_path / "cache")}
    for _ in range(2):
        assert without(tmp_path / "nowhere", "diagnose", str(SAMPLE), **env).returncode == 1
    assert (tmp_path / "count").read_text() == "built\n"


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
    assert done.returncode == 0, done.stderr


def test_what_needs_more_says_so_in_one_sentence(folder, tmp_path):
    for arguments in (["survive", "--vehicle", "ardupilot-quad-x", "--quiet"], ["diagnose", str(SAMPLE), "--estimator", "ekf"]):
        done = without(folder, *arguments)
        (line,) = done.stderr.strip().splitlines()
        assert done.returncode == 2 and "pip install" in line and "please report" not in line


def test_a_package_without_machine_code_runs_by_python(tmp_path):
    """On a computer without a compiler `pip install .` still gives something that runs, and brings nothing more."""
    root = Path(__file__).parents[1]
    environment = {k: v for k, v in os.environ.items() if k not in ("CC", "ROTORWATCH_SHIP")} | {"PATH": str(tmp_path)}
    line = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(tmp_path), str(root)]
    subprocess.run(line, env=environment, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as parts:
        names = parts.namelist()
        metadata = parts.read(next(name for name in names if name.endswith("METADATA"))).decode()
    assert not [name for name in names if "compiling/built" in name]
    needed = {line.split()[1].split(">")[0] for line in metadata.splitlines() if line.startswith("Requires-Dist") and ";" not in line}
    assert "numpy" in needed and not {"jax", "scipy"} & needed


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
    build = loaded(Path(__file__).parents[1] / "hatch_build.py")
    isolated = tmp_path / "site"
    isolated.mkdir()
    (isolated / "sitecustomize.py").touch()
    monkeypatch.setattr(sys, "path", [str(isolated), str(tmp_path)])
    assert build._paths() == [str(tmp_path)]
