"""Parts of the C library on board, compiled as firmware compiles them, and run over rows of doubles."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import rotorwatch

SOURCES = Path(rotorwatch.__file__).parent / "embedded_c"
DRIVERS = Path(__file__).parent / "embedded_c"
STUBS = Path(__file__).resolve().parents[1] / "embedded" / "stubs"  # of what the export generates
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Werror")
LASTS = 1e300


def config(n: int, dt: float = 0.05, output_hz: int = 50) -> str:
    """rw_config.h of a vehicle with n rotors."""
    hypotheses = 2 * n + n * (n - 1) // 2 + 9
    settings = {
        "ROTORS": n,
        "PLACES": 4,
        "HYPOTHESES": hypotheses,
        "TICK_S": dt,
        "REACH": 64,
        "OPPOSITE_PAIRS": max(1, n // 2),
    }
    settings |= {"OUTPUT_HZ": output_hz, "OVERRIDES": 64, "CONTACTS": 16, "EVENTS": 40, "PENDING": 64}
    settings |= {"MIXER_UNKNOWN": 1, "FLIGHTS": 64, "MOTION_HZ": 2000, "TICKS_BEFORE": 10, "QUEUE": 120}
    return "".join(f"#define RW_{name} {value}\n" for name, value in settings.items())


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
        (folder / "rw_config.h").write_text(config(n, dt))
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


def vehicle_row(vehicle, air, headroom: float = 0.2) -> list[float]:
    """The vehicle and when it flew, as drive_mixer.c reads them."""
    curve, n = vehicle.curve, len(vehicle.rotors)
    known = vehicle.mixer is not None
    mixer = vehicle.mixer if known else np.zeros((n, 4))
    expo = vehicle.extra.get("mixer_expo", curve.expo)
    rests = bool(vehicle.extra.get("rests_at_minimum", False))
    numbers = [curve.u_min, curve.u_max, curve.expo, expo, headroom, known, rests, len(air), *np.ravel(air)]
    return [*np.ravel(vehicle.effectiveness()), *np.ravel(mixer), *map(float, numbers)]
