"""The C files that go on board, compiled for a vehicle as a library that ctypes calls."""

import ctypes
import shutil
import subprocess

import pytest

from embedded_c_parts import SOURCES, STRICT, front
from rotorwatch.export.export_diagnoser import rates, settings

# Without their library: what is undefined, or beyond an array, ends the process.
SANITIZERS = ("-fsanitize=undefined,bounds", "-fsanitize-undefined-trap-on-error")


def doubles(array):
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def library(folder, sources, driver, B, single=False, compiler="gcc", dt=0.05):
    """The named sources and a driver, as a library. Skips where there is no such compiler."""
    found = shutil.which(compiler)
    if found is None:
        pytest.skip(f"{compiler} is not installed")
    folder.mkdir(parents=True, exist_ok=True)
    values = settings(B, dt) | rates(50.0, 400.0, 400.0)
    front(folder, "".join(f"#define RW_{name} {value}\n" for name, value in values.items()))
    (folder / "driver.c").write_text(driver)
    flags = [*STRICT, *(SANITIZERS if compiler == "gcc" else ()), "-O1", "-fPIC", "-shared", *(["-DROTORWATCH_FLOAT"] if single else [])]
    files = [*(str(folder / name) for name in sources), str(folder / "driver.c")]
    target = folder / "onboard.so"
    command = [found, *flags, f"-I{folder}", f"-I{SOURCES}", *files, "-lm", "-o", str(target)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(target))
