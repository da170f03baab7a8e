"""What an installation takes: `python benchmarks/install.py [--clone] SOURCE...` (wheels or folders of sources), where pip is installed.

For a wheel, a row each for pip, uv, uvx and `pipx run`, of those that are here. The wheel and what it needs are fetched first, into a
folder; from it each tool installs with empty caches, without a network and with no compiler in reach, as under `env -i HOME PATH LANG`.
A sample is then assessed twice, and the demo is run. uv and uvx do not compile Python's files as they install: their first verdict pays
for it. Times are by the clock, with the processor's time in brackets; a busy computer makes the first longer than the second.

A folder of sources is installed by pip with the compiler that is here. Of pip's installations the largest packages are listed, without
pip and setuptools, which the empty environment has. --clone: it is not installed, but assesses from where it lies, as after `git clone`, in
this environment: the first verdict compiles machine code and Python's files; several folders take turns, --rounds times.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

LARGEST = 12
PYTHON = getattr(sys, "_base_executable", sys.executable)  # not an environment's own, which may have more than a new one
# What scripts that tools make call, besides Python.
COMMON = "sh", "dirname", "realpath"
SAMPLE = Path(__file__).resolve().parents[1] / "src/rotorwatch/samples/hexax_m3_mul0.80_square_wind.bin.xz"
FOUND = "FAULT FOUND"


class Took(NamedTuple):
    """Seconds by the clock, and of the processor."""

    wall: float
    cpu: float

    def __str__(self) -> str:
        return f"{self.wall:.1f} ({self.cpu:.1f})"


def megabytes(folder: Path) -> float:
    """Size of a folder's files, or of a file."""
    files = folder.rglob("*") if folder.is_dir() else [folder]
    return sum(f.stat().st_blocks * 512 for f in files if f.is_file() and not f.is_symlink()) / 1e6


def timed(*command: str | Path, env: dict[str, str], said: str = "") -> Took:
    """What a command takes. It has to end with exit code 0 or, where something has to be said, to say it."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False, env=env)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
    if said not in done.stdout or (done.returncode and not said):
        raise SystemExit(f"{' '.join(map(str, command))} failed: {done.stdout[-500:]}{done.stderr[-500:]}")
    return Took(wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def fetched(wheel: Path, folder: Path) -> None:
    """The wheel and all that it needs, in a folder; by the settings of pip that are here. Printed: what a network has to bring."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--dest", str(folder)]
    took = timed(*command, wheel, env=dict(os.environ))
    files = list(folder.iterdir())
    print(f"{wheel.name}: {len(files)} files, {sum(map(megabytes, files)):.0f} MB to fetch; here in {took.wall:.1f} s")
    timed(*command, "pip", env=dict(os.environ))  # pipx renews its own


def reach(scratch: Path, tool: str, *more: str) -> dict[str, str]:
    """An environment in which a tool, what more it needs, Python and little else is found, and every cache is empty."""
    folder = scratch / f"bin-{tool}"
    folder.mkdir()
    for name in (*COMMON, tool, *more):
        beside = shutil.which(name, path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
        if beside:
            (folder / name).symlink_to(beside)
    (folder / "python3").symlink_to(PYTHON)
    home = scratch / f"home-{tool}"
    home.mkdir()
    return {"HOME": str(home), "PATH": str(folder), "LANG": "C.UTF-8"}


def rows(wheel: Path, scratch: Path) -> list[tuple[str, Took, tuple[Took, ...], float]]:
    """Of each tool that is here: its name, the installation, two verdicts and the demo, and megabytes of what was installed."""
    packages = scratch / "packages"
    fetched(wheel, packages)
    there = ["--no-index", "--find-links", str(packages)]
    found = []

    def row(tool: str, env: dict[str, str], install: list[str | Path], program: list[str | Path], place: Path) -> None:
        took = timed(*install, env=env)
        size = megabytes(place)
        words = ["diagnose", SAMPLE], ["diagnose", SAMPLE], ["demo"]
        found.append((tool, took, tuple(timed(*program, *part, env=env, said=FOUND) for part in words), size))

    venv.create(scratch / "pip", with_pip=True)
    bin_ = scratch / "pip" / "bin"
    site = next((scratch / "pip").glob("lib/python*/site-packages"))
    before = megabytes(site)
    install = [bin_ / "python", "-m", "pip", "install", "-q", *there, "rotorwatch"]
    row("pip", reach(scratch, "pip"), install, [bin_ / "rotorwatch"], site)
    found[0] = (*found[0][:3], found[0][3] - before)
    env = reach(scratch, "uv")
    if "uv" in os.listdir(env["PATH"]):
        place = scratch / "uv"
        timed("uv", "venv", "--python", PYTHON, place, env=env)
        install = ["uv", "pip", "install", "--python", place / "bin" / "python", *there, "rotorwatch"]
        row("uv", env, install, [place / "bin" / "rotorwatch"], place)
        env = reach(scratch, "uvx", "uv")
        line = ["uvx", "--python", PYTHON, *there, "rotorwatch"]
        row("uvx", env, [*line, "--version"], line, Path(env["HOME"]))
    env = reach(scratch, "pipx") | {"PIPX_DEFAULT_BACKEND": "pip"}  # with uv it does the same as uvx
    if "pipx" in os.listdir(env["PATH"]):
        took = timed("pipx", "upgrade-shared", f"--pip-args={' '.join(there)}", env=env)
        print(f"pipx makes its own environment once in its life: {took} s, not counted below")
        line = ["pipx", "run", "--python", PYTHON, f"--pip-args={' '.join(there)}", "rotorwatch"]
        row("pipx run", env, [*line, "--version"], line, Path(env["HOME"]))
    return found


def of_wheel(wheel: Path) -> None:
    """Measure a wheel with every tool, and print the table."""
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        load = os.getloadavg()[0]
        table = rows(wheel, scratch)
        print(f"Python {sys.version.split()[0]}; load of the computer {load:.1f} to {os.getloadavg()[0]:.1f}\n")
        print("| tool | install, s | first `diagnose`, s | second `diagnose`, s | `demo`, s | MB |\n|---|---|---|---|---|---|")
        for tool, took, commands, size in table:
            print(f"| {tool} | {took} | {' | '.join(map(str, commands))} | {size:.0f} |")


def of_sources(source: str) -> None:
    """Measure and print an installation of sources by pip, with the compiler that is here."""
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch) / "env"
        venv.create(place, with_pip=True)
        packages = next(place.glob("lib/python*/site-packages"))
        before = {p.name for p in packages.iterdir()}
        env = {**os.environ, "ROTORWATCH_CACHE": str(Path(scratch) / "cache")}
        took = timed(place / "bin" / "pip", "install", "-q", source, env=env)
        sizes = {p.name: megabytes(p) for p in packages.iterdir() if p.name not in before}
        env = {**env, "ROTORWATCH_CACHE": str(Path(scratch) / "empty"), "CC": "none"}
        verdicts = [timed(place / "bin" / "rotorwatch", "diagnose", SAMPLE, env=env, said=FOUND) for _ in range(2)]
        print(f"{source}: installed in {took} s, {sum(sizes.values()):.0f} MB; verdicts in {verdicts[0]} and {verdicts[1]} s")
        for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:LARGEST]:
            print(f"  {size:6.1f} MB  {name}")


def of_clones(sources: Sequence[str], rounds: int) -> None:
    """Measure and print the first and the second verdict of sources that are not installed, the least of each."""
    took: dict[str, list[tuple[Took, Took]]] = {}
    for source in [*sources] * rounds:
        with tempfile.TemporaryDirectory() as scratch:
            shutil.copytree(Path(source) / "src", Path(scratch) / "src", ignore=shutil.ignore_patterns("built", "__pycache__"))
            env = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
            env |= {"PYTHONPATH": str(Path(scratch) / "src"), "ROTORWATCH_CACHE": str(Path(scratch) / "cache")}
            env |= {"PYTHONPYCACHEPREFIX": str(Path(scratch) / "pyc")}
            first, second = (timed(sys.executable, "-m", "rotorwatch", "diagnose", SAMPLE, env=env, said=FOUND) for _ in range(2))
            took.setdefault(source, []).append((first, second))
    for source, both in took.items():
        first, second = (min(some, key=lambda one: one.cpu) for some in zip(*both, strict=True))
        print(f"{source}: first verdict in {first} s, second in {second} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="SOURCE", help="a wheel, or a folder of sources")
    parser.add_argument("--clone", action="store_true", help="do not install folders of sources")
    parser.add_argument("--rounds", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.clone:
        of_clones(arguments.sources, arguments.rounds)
    for given in [] if arguments.clone else arguments.sources:
        if given.endswith(".whl"):
            of_wheel(Path(given))
        else:
            of_sources(given)
