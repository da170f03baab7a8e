"""The C files that go on board, compiled for a vehicle as a library that ctypes calls."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import pytest

import rotorwatch
from rotorwatch.export_diagnoser import settings

FOLDER = Path(rotorwatch.__file__).parent / "embedded_c"
WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Werror")
# Without their library: what is undefined, or beyond an array, ends the process.
SANITIZERS = ("-fsanitize=undefined,bounds", "-fsanitize-undefined-trap-on-error")


def config(B, dt=0.05, output_hz=50, **more):
    """rw_config.h of a vehicle of effectiveness B (4, n); more: settings by name."""
    values = settings(B, dt) | {"OUTPUT_HZ": output_hz, **more}
    return "".join(f"#define RW_{name} {value}\n" for name, value in values.items())


def doubles(array):
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def library(folder, sources, driver, B, single=False, compiler="gcc", **settings):
    """The named sources and a driver, as a library. Skips where there is no such compiler."""
    found = shutil.which(compiler)
    if found is None:
        pytest.skip(f"{compiler} is not installed")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rw_config.h").write_text(config(B, **settings))
    (folder / "driver.c").write_text(driver)
    flags = [
        *WARNINGS,
        *(SANITIZERS if compiler == "gcc" else ()),
        "-O1",
        "-fPIC",
        "-shared",
        *(["-DROTORWATCH_FLOAT"] if single else []),
    ]
    files = [*(str(FOLDER / name) for name in sources), str(folder / "driver.c")]
    target = folder / "onboard.so"
    command = [found, *flags, f"-I{folder}", f"-I{FOLDER}", *files, "-lm", "-o", str(target)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(target))
