"""Modules of autopilots around the whole diagnoser: as strict as the autopilots' own builds, and their messages add up."""

import re
import shutil
import subprocess

import pytest
from click.testing import CliRunner
from tests import board
from tests.board import EMBEDDED, FRAME, LIBRARY, MODULE, STUBS

from embedded_c_parts import SOURCES, STRICT, compilers, config, front
from rotorwatch import airframes
from rotorwatch.commands import cli
from rotorwatch.flight import vehicle_file

DOCS = EMBEDDED.parent / "docs"
ARM = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16")


def glue(autopilot, folder, *folders, compiler="g++", more=("-fsyntax-only",)):
    """Compile the glue alone against the library in these folders; folder: for what the autopilot would make."""
    found = shutil.which(compiler)
    if found is None:
        pytest.skip(f"{compiler} is not installed")
    a = board.AUTOPILOTS[autopilot]
    (folder / "uORB" / "topics").mkdir(parents=True, exist_ok=True)
    (folder / "uORB" / "topics" / "rotorwatch_verdict.h").write_text(board.topic())
    include = [f"-I{f}" for f in (folder, *folders, *a.folders)]
    board.compile_all([[found, *a.cxx, *more, *include, str(source)] for source in a.sources])


def commands(text):
    """The export-c commands in a text, as lists of words; what stands after them on their line is no part of them."""
    return [line.split() for line in re.findall(r"rotorwatch (export-c -.*? -o [\w./]+)", text)]


SAYS = {
    "ardupilot": [LIBRARY / "AP_RotorDiagnosis.h", DOCS / "ardupilot.md"],
    "px4": [MODULE / "CMakeLists.txt", DOCS / "px4.md"],
    "docs": [DOCS / "export.md"],
}


@pytest.mark.parametrize("place", SAYS)
def test_documented_commands_write_what_the_glue_compiles_with(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    vehicle_file.write(airframes.named("ardupilot-quad-x"), tmp_path / "mine.toml")
    said = [words for path in SAYS[place] for words in commands(path.read_text())]
    whole = [words for words in said if "--diagnoser" in words]
    assert len(whole) == len(SAYS[place])
    for words in said:
        done = CliRunner().invoke(cli.cli, words)
        assert done.exit_code == 0, (words, done.output, done.exception)
    for words in whole:
        header = (tmp_path / words[-1] / "rw_config.h").read_text()
        value = {name: float(x) for name, x in re.findall(r"#define RW_(RECENT|MOTION_HZ|OUTPUT_HZ) (\d+)", header)}
        assert (value["OUTPUT_HZ"], value["MOTION_HZ"]) == (board.OUTPUT_HZ, board.SENSOR_HZ)
        assert value["RECENT"] >= value["OUTPUT_HZ"] / 2, "half a second of outputs has room"
        for autopilot in board.AUTOPILOTS if place == "docs" else (place,):
            glue(autopilot, tmp_path / autopilot, tmp_path / words[-1])


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("rotors", [4, 8, 12])
@pytest.mark.parametrize("autopilot", board.AUTOPILOTS)
def test_no_flag_of_an_autopilot_warns_of_its_glue(autopilot, rotors, tmp_path):
    """Nor of the frames on the stack of a Cortex-M7."""
    front(tmp_path, config(rotors))
    glue(autopilot, tmp_path, tmp_path, SOURCES)
    if shutil.which("arm-none-eabi-g++"):
        output = ("-Os", FRAME, *ARM, "-c", "-o", str(tmp_path / "glue.o"))
        glue(autopilot, tmp_path, tmp_path, SOURCES, compiler="arm-none-eabi-g++", more=output)


@pytest.mark.parametrize("name", ["ardupilot", "px4"])
def test_no_flag_of_an_autopilot_warns_of_the_library(name, tmp_path):
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed")
    made = front(tmp_path, config(6))
    sources = [*sorted(made.parent.glob("rw_*.c")), *sorted(SOURCES.glob("rw_*.c"))]
    include = [f"-I{f}" for f in (tmp_path, SOURCES, STUBS / "px4")]
    board.compile_all([["gcc", *board.AUTOPILOTS[name].c, "-fsyntax-only", *include, str(s)] for s in sources])


@pytest.mark.parametrize(
    "line",
    [
        "return int(motors.thr_lin.batt_voltage_filt);",
        "return int(motors.thr_lin.curve_expo.get());",
        "return AP::ins()._gyro[0].x > 0;",
        "return hal.util->soft_armed;",
        "AP::ahrs().get_quaternion(q); return 0;",  # its answer is not looked at
        'GCS_SEND_TEXT(MAV_SEVERITY_INFO, "%s", 1.0); return 0;',
    ],
)
def test_what_ardupilot_refuses_is_refused(line, tmp_path):
    """Its private members, answers that must be looked at, formats that do not fit."""
    if shutil.which("g++") is None:
        pytest.skip("g++ is not installed")
    headers = ("AP_AHRS/AP_AHRS.h", "AP_InertialSensor/AP_InertialSensor.h", "AP_Motors/AP_Motors.h", "GCS_MAVLink/GCS.h")
    source = (
        "\n".join(f"#include <{name}>" for name in headers)
        + """
extern const AP_HAL::HAL &hal;
int tried(const AP_MotorsMulticopter &motors, Quaternion &q);
int tried(const AP_MotorsMulticopter &motors, Quaternion &q)
{
    LINE
}
"""
    )
    for text, wanted in (("return 0;", True), (line, False)):
        (tmp_path / "tried.cpp").write_text(source.replace("LINE", text))
        command = ["g++", *board.ARDUPILOT_CXX, f"-I{STUBS / 'ardupilot'}", "-c", "tried.cpp", "-o", "tried.o"]
        assert (subprocess.run(command, capture_output=True, cwd=tmp_path).returncode == 0) == wanted


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize(
    ("prefix", "names"),
    [
        ("VERDICT_", ("NOT_ASSESSED", "HEALTHY", "FAULT", "AMBIGUOUS")),
        ("KIND_", ("LOSS", "OUTPUT_OVERRIDE", "CONTACT", "TURNED_MOUNT")),
        ("NEWS_", ("ANNOUNCED", "CHANGED", "WITHDRAWN")),
    ],
)
def test_numbers_of_the_message_are_those_of_the_library(prefix, names, tmp_path):
    said = {key: int(value) for _, key, value, _ in board.message() if value is not None and key.startswith(prefix)}
    said.pop(f"{prefix}NONE", None)
    header = front(tmp_path, config(4)).with_suffix(".h").read_text()
    defined = {name: int(value) for name, value in re.findall(r"#define RW_(\w+) (\d+)$", header, re.M)}
    wanted = {f"{prefix}{name}": defined[name] for name in names}
    assert {key.replace("LOSS_OF_EFFECTIVENESS", "LOSS"): value for key, value in said.items()} == wanted


def test_log_records_fit_into_an_ardupilot_log():
    """A letter for every label; names of 4 letters, formats of 16, labels of 64 together: what a FMT record has room for."""
    text = (LIBRARY / "AP_RotorDiagnosis.cpp").read_text()
    records = re.findall(r'Write\("(\w{1,4})", "([\w,]+)", "(\w+)"', text)
    assert {name for name, _, _ in records} == {"RWLS", "RWEV"}
    for name, labels, formats in records:
        assert len(labels.split(",")) == len(formats) <= 16 and len(labels) <= 64
        assert {f"L{k}" for k in range(1, 13 if name == "RWLS" else 5)} <= set(labels.split(","))
        bytes_of = {"Q": 8, "d": 8, "f": 4, "H": 2, "B": 1}
        assert 3 + sum(bytes_of[letter] for letter in formats) <= 255


def test_what_the_page_adds_to_arducopter_compiles(tmp_path):
    """Each block of docs/ardupilot.md at its place in a vehicle with ArduCopter's tables."""
    if shutil.which("g++") is None:
        pytest.skip("g++ is not installed")
    front(tmp_path, config(4))
    page = DOCS / "ardupilot.md"
    parts = re.split(r"(?m)^`ArduCopter/([\w.]+)`", page.read_text())
    found = {name: re.search(r"```cpp\n(.*?)```", text, re.S) for name, text in zip(parts[1::2], parts[2::2])}
    blocks = {name: block[1] for name, block in found.items() if block and name != "wscript"}
    include, member = blocks["Parameters.h"].strip().split("\n", 1)
    source = f"""
#include <AP_Motors/AP_Motors.h>
#include <AP_Scheduler/AP_Scheduler.h>
{include}
class ParametersG2 {{
public:
    ParametersG2();
    static const struct AP_Param::GroupInfo var_info2[];
{member}
}};
class Copter {{
public:
    ParametersG2 g2;
    AP_MotorsMulticopter *motors;
    static const AP_Scheduler::Task scheduler_tasks[];
    void init_ardupilot();
}};
#define HELI_FRAME 1
#define MULTICOPTER_FRAME 2
#define FRAME_CONFIG MULTICOPTER_FRAME
extern Copter copter;
const AP_Param::GroupInfo ParametersG2::var_info2[] = {{
{blocks["Parameters.cpp"]}
    AP_GROUPEND
}};
const AP_Scheduler::Task Copter::scheduler_tasks[] = {{
{blocks["Copter.cpp"]}
}};
void Copter::init_ardupilot() {{
{blocks["system.cpp"]}
}}
"""
    (tmp_path / "Copter.cpp").write_text(source)
    folders = [f"-I{f}" for f in (tmp_path, SOURCES, LIBRARY.parent, STUBS / "ardupilot")]
    subprocess.run(["g++", *board.ARDUPILOT_CXX, "-fsyntax-only", *folders, str(tmp_path / "Copter.cpp")], check=True)


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("precision", [(), ("-DROTORWATCH_FLOAT",)])
@pytest.mark.parametrize("rotors", [3, 8, 12])
def test_no_warning_whatever_the_number_of_rotors(tmp_path, rotors, precision):
    made = front(tmp_path, config(rotors))
    include = [f"-I{folder}" for folder in (tmp_path, SOURCES)]
    for compiler in compilers():
        for source in (made, *sorted(SOURCES.glob("rw_*.c"))):
            subprocess.run([compiler, *STRICT, *precision, "-fsyntax-only", *include, str(source)], check=True)
