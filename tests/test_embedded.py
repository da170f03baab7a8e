"""Exported C where it is meant to fly: Cortex-M7 code of bounded size and stack, and autopilots' skeletons that call it."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from rotorwatch.export.export_c import export_c

EMBEDDED = Path(__file__).resolve().parents[1] / "embedded"
ARM = (
    "-mcpu=cortex-m7",
    "-mthumb",
    "-mfloat-abi=hard",
    "-mfpu=fpv5-d16",
    "-std=c99",
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Werror",
)
# Bytes, also in double precision, where constants weigh twice as much.
TEXT = {"ekf": 12_000, "ukf": 16_000, "tsukf": 16_000}
STACK = 24_000


def tool(name):
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed")
    return found


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ekf")
    export_c("ekf", folder, vehicle="ardupilot-quad-x", variable_dt=True)
    return folder


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("precision", ["float", "double"])
@pytest.mark.parametrize("name", TEXT)
def test_code_is_small_and_stack_is_bounded(name, precision, tmp_path):
    """The stack: what each function takes, added up along step -> kernel; nothing calls itself, nothing has a variable size."""
    cc = tool("arm-none-eabi-gcc")
    export_c(name, tmp_path)
    flags = [*ARM, "-Os", "-fstack-usage", *(["-DROTORWATCH_FLOAT"] if precision == "float" else [])]
    subprocess.run([cc, *flags, "-c", f"{name}.c"], cwd=tmp_path, check=True)
    sizes = subprocess.run(
        ["arm-none-eabi-size", f"{name}.o"], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout
    assert int(sizes.splitlines()[1].split()[0]) < TEXT[name]
    assert sizes.splitlines()[1].split()[1:3] == [
        "0",
        "0",
    ]  # nothing that changes outside of what the caller hands over
    rows = [line.split("\t") for line in (tmp_path / f"{name}.su").read_text().splitlines()]
    assert all(row[2] == "static" for row in rows)
    taken = {row[0].rpartition(":")[2]: int(row[1]) for row in rows}
    kernels = max((size for function, size in taken.items() if not re.search("_(init|step|run)$", function)), default=0)
    assert taken[f"{name}_run"] + taken[f"{name}_step"] + kernels < STACK


def test_a_cortex_m7_says_what_this_computer_says(project, tmp_path):
    """Run under QEMU, one instruction after the other, in single precision."""
    cc, machine = tool("arm-none-eabi-gcc"), tool("qemu-system-arm")
    core = EMBEDDED / "cortex-m7"
    sources = [str(project / "ekf.c"), str(project / "example.c")]
    single, output = "-DROTORWATCH_FLOAT", str(tmp_path / "m7.elf")
    start = [str(core / "startup.c"), "--specs=rdimon.specs", "-T", str(core / "an500.ld")]
    subprocess.run([cc, *ARM, single, "-Os", *sources, *start, "-lm", "-o", output], check=True)
    board = [machine, "-M", "mps2-an500", "-nographic", "-semihosting", "-kernel", output]
    said = subprocess.run(
        board, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=True
    ).stdout
    here = str(tmp_path / "here")
    subprocess.run([tool("gcc"), "-std=c99", single, *sources, "-lm", "-o", here], check=True)
    expected = subprocess.run([here], capture_output=True, text=True, check=True).stdout
    numbers, wanted = ([float(word) for word in text.split()[3:]] for text in (said, expected))
    assert said.startswith("status 0") and len(numbers) == 4
    assert numbers == pytest.approx(wanted, abs=2e-6)


@pytest.mark.parametrize("source", ["px4/RotorWatch.cpp", "ardupilot/AP_RotorWatch.cpp"])
def test_autopilots_skeletons_compile(source, project, tmp_path):
    command = [tool("g++"), "-std=c++14", "-Wall", "-Wextra", "-Werror", "-DROTORWATCH_FLOAT", f"-I{project}"]
    command += [f"-I{EMBEDDED / 'stubs'}", "-c", str(EMBEDDED / source), "-o", str(tmp_path / "module.o")]
    subprocess.run(command, check=True)
