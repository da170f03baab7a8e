"""Parts of the C library on board, compiled as firmware compiles them, and run over rows of doubles."""

from __future__ import annotations

import functools
import shutil
from pathlib import Path

import numpy as np
import pytest

import rotorwatch
from rotorwatch.export.export_diagnoser import definitions, rates, settings

SOURCES = Path(rotorwatch.__file__).parent / "export" / "embedded_c"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Wfloat-equal", "-Wshadow", "-Werror")


def config(n: int, dt: float = 0.05, hz: tuple[float, float, float] = (50.0, 400.0, 400.0), **more: float) -> str:
    """rw_config.h of a vehicle with n rotors. hz: of outputs, gyro and accelerometer; more: settings by name."""
    around = 2.0 * np.pi * np.arange(n) / n
    B = np.stack([np.sin(around), np.cos(around), (-1.0) ** np.arange(n), np.ones(n)])
    values = settings(B, dt) | rates(*hz) | more
    return "".join(f"#define RW_{name} {value}\n" for name, value in values.items())


@functools.cache
def _translated() -> tuple[tuple[str, str], ...]:
    return tuple(definitions().items())


def front(folder: Path, text: str) -> Path:
    """rw_config.h with this text, and the definitions as the export writes them, into a folder; the C of the front end."""
    for name, written in (("rw_config.h", text), *_translated()):
        (folder / name).write_text(written)
    return folder / "rw_front.c"


def compilers() -> list[str]:
    """C compilers of this computer; skips without one."""
    found = [name for name in ("gcc", "clang") if shutil.which(name)]
    if not found:
        pytest.skip("no C compiler")
    return found
