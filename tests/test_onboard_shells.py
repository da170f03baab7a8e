"""Modules of autopilots around the whole diagnoser: they compile against stubs of the autopilots' headers, and their messages add up."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

from embedded_c_parts import SOURCES, STRICT, compilers, config, front
from rotorwatch import airframes
from rotorwatch.commands import cli
from rotorwatch.flight import vehicle_file

EMBEDDED = Path(__file__).resolve().parents[1] / "embedded"
PX4 = EMBEDDED / "px4" / "diagnoser"
SHELLS = {
    "px4": PX4 / "RotorWatchDiagnoser.cpp",
    "ardupilot": EMBEDDED / "ardupilot" / "AP_RotorDiagnosis" / "AP_RotorDiagnosis.cpp",
}
GLUE_FLAGS = (
    "-std=c++14",
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Werror",
    "-DROTORWATCH_FLOAT",
    "-fsyntax-only",
    "-Wdouble-promotion",
    "-Wfloat-equal",
    "-Werror=overflow",
    "-fsingle-precision-constant",
)
TYPES = {"uint8": "uint8_t", "uint16": "uint16_t", "uint64": "uint64_t", "float32": "float"}


def message():
    """Constants and fields of the uORB message: (type, name, value or None, how many)."""
    found = []
    for line in (PX4 / "msg" / "RotorwatchVerdict.msg").read_text().splitlines():
        line = line.partition("#")[0].strip()
        if not line:
            continue
        match = re.fullmatch(r"(\w+?)(?:\[(\d+)\])? (\w+)(?:\s*=\s*(\d+))?", line)
        assert match and match[1] in TYPES, line
        found.append((match[1], match[3], match[4], match[2]))
    return found


def topic():
    """The header that PX4 makes of it."""
    lines = ["#pragma once", "#include <cstdint>", "struct rotorwatch_verdict_s {"]
    for kind, name, value, many in message():
        if value is not None:
            lines.append(f"\tstatic constexpr {TYPES[kind]} {name} = {value};")
        else:
            lines.append(f"\t{TYPES[kind]} {name}{f'[{many}]' if many else ''};")
    return "\n".join([*lines, "};", ""])


def glue_compiles(autopilot, made, *folders):
    """Compile the glue against the library in these folders; made: a folder for what the autopilot would make."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed")
    (made / "uORB" / "topics").mkdir(parents=True)
    (made / "uORB" / "topics" / "rotorwatch_verdict.h").write_text(topic())
    include = [f"-I{folder}" for folder in (made, *folders, EMBEDDED / "stubs")]
    subprocess.run([compiler, *GLUE_FLAGS, *include, str(SHELLS[autopilot])], check=True)


def commands(text):
    """The export-c commands in a text, as lists of words; what stands after them on their line is no part of them."""
    found = re.findall(r"rotorwatch (export-c -.*? -o [\w.]+)", text)
    return [line.split() for line in found]


SAYS = {
    "ardupilot": EMBEDDED / "ardupilot" / "AP_RotorDiagnosis" / "AP_RotorDiagnosis.h",
    "px4": PX4 / "CMakeLists.txt",
    "docs": EMBEDDED.parent / "docs" / "export.md",
}


@pytest.mark.parametrize("place", SAYS)
def test_documented_commands_write_what_the_glue_compiles_with(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    vehicle_file.write(airframes.named("ardupilot-quad-x"), tmp_path / "mine.toml")
    said = commands(SAYS[place].read_text())
    whole = [words for words in said if "--diagnoser" in words]
    assert len(whole) == 1
    for words in said:
        done = CliRunner().invoke(cli.cli, words)
        assert done.exit_code == 0, (words, done.output, done.exception)
    header = (tmp_path / whole[0][-1] / "rw_config.h").read_text()
    value = {name: float(x) for name, x in re.findall(r"#define RW_(RECENT|MOTION_HZ) (\d+)", header)}
    assert value["RECENT"] >= value["MOTION_HZ"] / 2, (
        "half a second of outputs has room at the rate at which the glue feeds them"
    )
    for autopilot in SHELLS if place == "docs" else (place,):
        glue_compiles(autopilot, tmp_path / autopilot, tmp_path / whole[0][-1])


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("rotors", [4, 8])
@pytest.mark.parametrize("autopilot", SHELLS)
def test_shells_compile(autopilot, rotors, tmp_path):
    front(tmp_path, config(rotors))
    glue_compiles(autopilot, tmp_path, tmp_path, SOURCES)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize(
    ("prefix", "names"),
    [
        ("VERDICT_", ("NOT_JUDGED", "HEALTHY", "FAULT", "AMBIGUOUS")),
        ("KIND_", ("LOSS", "OUTPUT_OVERRIDE", "CONTACT", "TURNED_MOUNT")),
        ("NEWS_", ("ANNOUNCED", "CHANGED", "WITHDRAWN")),
    ],
)
def test_numbers_of_the_message_are_those_of_the_library(prefix, names, tmp_path):
    said = {key: int(value) for _, key, value, _ in message() if value is not None and key.startswith(prefix)}
    said.pop(f"{prefix}NONE", None)
    header = front(tmp_path, config(4)).with_suffix(".h").read_text()
    defined = {name: int(value) for name, value in re.findall(r"#define RW_(\w+) (\d+)$", header, re.M)}
    wanted = {f"{prefix}{name}": defined[name] for name in names}
    assert {key.replace("LOSS_OF_EFFECTIVENESS", "LOSS"): value for key, value in said.items()} == wanted


def test_log_records_have_a_format_for_every_label():
    text = SHELLS["ardupilot"].read_text()
    records = re.findall(r'Write\("(\w{4})", "([\w,]+)", "(\w+)"', text)
    assert [name for name, _, _ in records] == ["RWLS", "RWEV"]
    for _, labels, formats in records:
        assert len(labels.split(",")) == len(formats) and len(labels) <= 64


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("precision", [(), ("-DROTORWATCH_FLOAT",)])
@pytest.mark.parametrize("rotors", [3, 8, 12])
def test_no_warning_whatever_the_number_of_rotors(tmp_path, rotors, precision):
    made = front(tmp_path, config(rotors))
    include = [f"-I{folder}" for folder in (tmp_path, SOURCES, EMBEDDED / "stubs")]
    for compiler in compilers():
        for source in (made, *sorted(SOURCES.glob("rw_*.c"))):
            subprocess.run([compiler, *STRICT, *precision, "-fsyntax-only", *include, str(source)], check=True)
