"""Exported C where it is meant to fly: Cortex-M7 code of bounded size and stack, and autopilots' skeletons that call it."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from tests import board

from exporting import exported
from rotorwatch.base import discovery
from rotorwatch.base.compiling.body import exact
from rotorwatch.export.export_diagnoser import export_diagnoser
from rotorwatch_lab.export_c import export_c

EMBEDDED = Path(__file__).resolve().parents[1] / "embedded"
ARM = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
# Bytes, also in double precision, where constants weigh twice as much.
TEXT = {"ekf": 12_000, "ukf": 16_000, "tsukf": 16_000}
STACK = 24_000
# What ArduPilot and PX4 ask of a compiler; clang has no constants of single precision.
AUTOPILOTS = ("-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", "-Wfloat-equal", "-Werror=overflow", "-DROTORWATCH_FLOAT")
# Those of PX4's, or ArduPilot's with --Werror, that come on top for C of one's own.
ON_TOP = (
    "-O2", "-fsigned-char", "-fno-strict-aliasing", "-fno-math-errno", "-funsafe-math-optimizations", "-fno-common",
    "-Wcast-align", "-Wpointer-arith",
    "-Wshadow", "-Wundef", "-Winit-self", "-Wuninitialized", "-Warray-bounds", "-Wdisabled-optimization", "-Wmissing-declarations",
    "-Wbad-function-cast", "-Wnested-externs", "-Wstrict-prototypes", "-Wtype-limits", "-Wswitch", "-Wparentheses",
)  # fmt: skip
FRAME = "-Wframe-larger-than=1300"
CONSTANTS = {"gcc": ["-fsingle-precision-constant"], "clang": [], "arm-none-eabi-gcc": ["-fsingle-precision-constant", *ARM[:4]]}
USUAL = ("ekf", "parity", "atsukf")  # products, constants beyond single precision, comparisons for equality


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
    sizes = subprocess.run(["arm-none-eabi-size", f"{name}.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert int(sizes.splitlines()[1].split()[0]) < TEXT[name]
    assert sizes.splitlines()[1].split()[1:3] == ["0", "0"]  # nothing that changes outside of what the caller hands over
    rows = [line.split("\t") for line in (tmp_path / f"{name}.su").read_text().splitlines()]
    assert all(row[2] == "static" for row in rows)
    taken = {row[0].rpartition(":")[2]: int(row[1]) for row in rows}
    kernels = max((size for function, size in taken.items() if not re.search("_(init|step|run)$", function)), default=0)
    assert taken[f"{name}_run"] + taken[f"{name}_step"] + kernels < STACK


def no_warning(folder, *flags):
    """No compiler there is warns with the flags of both autopilots. flags: of the Cortex-M7's alone, which then compiles."""
    files = sorted(str(path) for path in folder.glob("*.c") if path.name != "example.c")
    found = [cc for cc in CONSTANTS if shutil.which(cc)]
    for cc in found:
        more = ["-fsyntax-only"] if cc != "arm-none-eabi-gcc" or not flags else [*flags, "-c"]
        done = subprocess.run([cc, "-std=c99", *AUTOPILOTS, *CONSTANTS[cc], *more, *files], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0 and not done.stderr, f"{cc}: {done.stderr[:2000]}"
    if not found:
        pytest.skip("no C compiler")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in USUAL else pytest.mark.thorough) for n in discovery.estimators() if n != "default"]
)
def test_estimators_meet_the_flags_of_both_autopilots(name, tmp_path):
    program = exported(name)
    (tmp_path / f"{program.name}.h").write_text(program.header)
    (tmp_path / f"{program.name}.c").write_text(program.source)
    no_warning(tmp_path, "-Os", FRAME)


@pytest.mark.thorough
@pytest.mark.parametrize("vehicle", ["ardupilot-quad-x", "ardupilot-octa-x"])
def test_the_diagnoser_meets_the_flags_of_both_autopilots(vehicle, tmp_path):
    """With the frames of all of its functions."""
    export_diagnoser(tmp_path, vehicle=vehicle)
    no_warning(tmp_path, *ON_TOP, FRAME)
    no_warning(tmp_path, "-Os", "-UROTORWATCH_FLOAT", "-Wno-double-promotion", FRAME)


def test_times_are_exact_where_constants_are_of_single_precision(tmp_path):
    """A number of seconds is the same with and without the flag that makes constants floats."""
    cc = tool("gcc")
    values = [0.05, 1.5, 1e-9, 9.80665, 0.999999, 60.0, 1e8, 0.7, -0.15]
    lines = "".join(f'    printf("%.17g\\n", {exact(value)});\n' for value in values)
    source = f"#include <stdio.h>\ntypedef double rw_time;\nint main(void)\n{{\n{lines}    return 0;\n}}\n"
    (tmp_path / "times.c").write_text(source)
    subprocess.run([cc, "-std=c99", *AUTOPILOTS, *CONSTANTS["gcc"], "times.c", "-o", "times"], cwd=tmp_path, check=True)
    said = subprocess.run([str(tmp_path / "times")], capture_output=True, text=True, check=True).stdout
    assert [float(word) for word in said.split()] == values


def test_a_cortex_m7_says_what_this_computer_says(project, tmp_path):
    """Run under QEMU, one instruction after the other, in single precision."""
    cc, machine = tool("arm-none-eabi-gcc"), tool("qemu-system-arm")
    core = EMBEDDED / "cortex-m7"
    sources = [str(project / "ekf.c"), str(project / "example.c")]
    single, output = "-DROTORWATCH_FLOAT", str(tmp_path / "m7.elf")
    start = [str(core / "startup.c"), "--specs=rdimon.specs", "-T", str(core / "an500.ld")]
    subprocess.run([cc, *ARM, single, "-Os", *sources, *start, "-lm", "-o", output], check=True)
    board = [machine, "-M", "mps2-an500", "-nographic", "-semihosting", "-kernel", output]
    said = subprocess.run(board, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=True).stdout
    here = str(tmp_path / "here")
    subprocess.run([tool("gcc"), "-std=c99", single, *sources, "-lm", "-o", here], check=True)
    expected = subprocess.run([here], capture_output=True, text=True, check=True).stdout
    numbers, wanted = ([float(word) for word in text.split()[3:]] for text in (said, expected))
    assert said.startswith("status 0") and len(numbers) == 4
    assert numbers == pytest.approx(wanted, abs=2e-6)


@pytest.mark.parametrize(("source", "flags"), [("px4/RotorWatch.cpp", board.PX4_CXX), ("ardupilot/AP_RotorWatch.cpp", board.ARDUPILOT_CXX)])
def test_autopilots_skeletons_compile(source, flags, project):
    stubs = board.STUBS / source.partition("/")[0]
    command = [tool("g++"), *flags, f"-I{project}", f"-I{stubs}", "-fsyntax-only", str(EMBEDDED / source)]
    subprocess.run(command, check=True)
