"""From an empty computer to an answer on your own log: `python tests/newcomer.py [LOG]`. The time of every step is printed.

Everything happens in a temporary folder, in an environment with HOME, PATH and LANG only, as under `env -i`, and with empty caches. The log
(a sample if none is given) is copied there under a name with a space. The exit code is 0 when the log was assessed and the whole took less
than two minutes, else 1.

By default what git knows of this checkout is copied and installed with pip, as the README says; that builds machine code. --wheel FILE
installs a wheel instead. --shared needs no network: it builds a wheel of the copy with the packages of this Python, takes machine code of
the same sources that was built before, and lets the new environment see this Python's packages in place of fetching them.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "src/rotorwatch/samples/hexax_m3_mul0.80_square_wind.bin.xz"
PYTHON = getattr(sys, "_base_executable", sys.executable)
MOST_S = 120.0
ANSWERS = (0, 1, 3)  # exit codes of a verdict


class Walk:
    """Steps in a folder, each printed with its time."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.environment = {name: os.environ[name] for name in ("HOME", "PATH", "LANG") if name in os.environ}
        # Where packages come from is a matter of this computer; what it keeps of them is not used.
        self.environment |= {name: value for name, value in os.environ.items() if name.startswith("PIP_")}
        self.environment |= {"PIP_NO_CACHE_DIR": "1", "ROTORWATCH_CACHE": str(folder / "cache")}
        self.began = time.perf_counter()

    def step(self, what: str, *words: str | Path, codes: tuple[int, ...] = (0,), **environment: str) -> str:
        """What a command prints. Ends the walk where it fails."""
        began = time.perf_counter()
        done = subprocess.run(
            list(map(str, words)), cwd=self.folder, env=self.environment | environment, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        self.took(what, began)
        if done.returncode not in codes:
            raise SystemExit(f"{' '.join(map(str, words))} failed:\n{done.stdout}{done.stderr}".rstrip())
        return done.stdout

    def took(self, what: str, began: float) -> None:
        print(f"{time.perf_counter() - began:7.1f} s  {what}", flush=True)


def copy(folder: Path) -> None:
    """What git knows of this checkout, or would: no more than a clone has, and what is changed as it is now."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, check=True
    )  # fmt: skip
    for name in os.fsdecode(listed.stdout).split("\0"):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


def install(walk: Walk, wheel: Path | None, shared: bool) -> Path:
    """The command line of rotorwatch in a new environment."""
    source = walk.folder / "checkout"
    if wheel is None:
        began = time.perf_counter()
        copy(source)
        walk.took("a copy of the checkout", began)
    place = walk.folder / ".venv"
    python = place / "bin" / "python"
    if not shared:
        walk.step("a new environment", PYTHON, "-m", "venv", place)
        what = wheel or f"{source}[report]"
        walk.step("installed", python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", what)
        return place / "bin" / "rotorwatch"
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    if wheel is None:
        kept = {name: os.environ[name] for name in ("ROTORWATCH_CACHE",) if name in os.environ}
        walk.environment.pop("ROTORWATCH_CACHE")  # there lies the machine code that this Python's installation has built
        words = ["wheel", "--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", walk.folder, source]
        walk.step("a wheel of it", *pip, *words, **kept)
        walk.environment["ROTORWATCH_CACHE"] = str(walk.folder / "cache")
        (wheel,) = walk.folder.glob("*.whl")
    walk.step("a new environment", PYTHON, "-m", "venv", "--without-pip", place)
    walk.step("installed", *pip, "--python", python, "install", "--no-deps", "--no-index", wheel)
    site = next(place.glob("lib/python*/site-packages"))
    (site / "shared.pth").write_text(sysconfig.get_path("purelib"))
    return place / "bin" / "rotorwatch"


def main() -> int:
    """Every step; see the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", nargs="?", type=Path, default=SAMPLE, metavar="LOG", help="your own flight log")
    parser.add_argument("--wheel", type=Path, help="install this wheel, not the checkout")
    parser.add_argument("--shared", action="store_true", help="use the packages of this Python; no network is needed")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        walk = Walk(Path(name))
        program = install(walk, options.wheel and options.wheel.resolve(), options.shared)
        log = walk.folder / f"my own {options.log.name}"
        shutil.copy(options.log, log)
        said = walk.step("rotorwatch --version", program, "--version")
        if not options.shared:
            walk.step("rotorwatch demo", program, "demo")
        walk.step("rotorwatch info LOG", program, "info", log)
        answer = walk.step("rotorwatch diagnose LOG", program, "diagnose", log, codes=ANSWERS)
        whole, used = time.perf_counter() - walk.began, resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"\n{answer.strip()}\n")
    print(f"{said.strip()}: from nothing to this answer in {whole:.1f} s; at most {MOST_S:.0f} s are wanted")
    print(f"of the processor {used.ru_utime + used.ru_stime:.1f} s; load of the computer {os.getloadavg()[0]:.1f}")
    return 0 if whole < MOST_S else 1


if __name__ == "__main__":
    sys.exit(main())
