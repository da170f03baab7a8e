"""Parts of the C library on board, compiled as firmware compiles them, and run over rows of doubles."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import rotorwatch
from rotorwatch.compiling.translate import Translation
from rotorwatch.export_diagnoser import BOARD, rates, settings
from rotorwatch.front import sizes

SOURCES = Path(rotorwatch.__file__).parent / "embedded_c"
DRIVERS = Path(__file__).parent / "embedded_c"
STUBS = Path(__file__).resolve().parents[1] / "embedded" / "stubs"  # of what the export generates
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Werror")
LASTS = 1e300


def config(n: int, dt: float = 0.05, hz: tuple[float, float, float] = (50.0, 400.0, 400.0), **more: float) -> str:
    """rw_config.h of a vehicle with n rotors. hz: of outputs, gyro and accelerometer; more: settings by name."""
    around = 2.0 * np.pi * np.arange(n) / n
    B = np.stack([np.sin(around), np.cos(around), (-1.0) ** np.arange(n), np.ones(n)])
    values = settings(B, dt) | rates(*hz) | more
    return "".join(f"#define RW_{name} {value}\n" for name, value in values.items())


def front(folder: Path, text: str) -> Path:
    """rw_config.h with this text, and the front end as the export writes it, into a folder; the C of the latter."""
    made = Translation(BOARD, sizes)
    for name, written in (
        ("config.h", text),
        ("front.h", made.header("Of a test.")),
        ("front.c", made.source("rw_front.h")),
    ):
        (folder / f"rw_{name}").write_text(written)
    return folder / "rw_front.c"


def compilers() -> list[str]:
    """C compilers of this computer; skips without one."""
    found = [name for name in ("gcc", "clang") if shutil.which(name)]
    if not found:
        pytest.skip("no C compiler")
    return found


class Part:
    """driver: file in tests/embedded_c; sources: of the library. Compiled with sanitizers when it is first run."""

    def __init__(self, folder: Path, driver: str, sources: tuple[str, ...], n: int, dt: float = 0.05):
        self._folder = folder
        front(folder, config(n, dt, OVERRIDES=64, CONTACTS=16, EVENTS=40))
        self._files = [str(DRIVERS / driver), *(str(SOURCES / name) for name in sources)]

    def _program(self, precision: str) -> Path:
        program = self._folder / precision
        if not program.exists():
            flags = ["-DROTORWATCH_FLOAT"] if precision == "float" else []
            checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", f"-I{self._folder}", f"-I{SOURCES}"]
            command = [compilers()[0], *STRICT, *checks, *flags, *self._files, "-lm", "-o", str(program)]
            subprocess.run(command, check=True)
        return program

    def run(self, rows: list, precision: str) -> list[list[str]]:
        """What was printed: lines of each block."""
        data = np.concatenate([np.ravel(row).astype(float) for row in rows]).tobytes()
        done = subprocess.run([str(self._program(precision))], input=data, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr.decode()[-2000:]
        return [block.splitlines() for block in done.stdout.decode().split("found\n")[1:]]
