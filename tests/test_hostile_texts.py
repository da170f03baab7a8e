"""Names and texts from outside are shown, not obeyed: no control character of a log or of a file name reaches a terminal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rotorwatch import logs
from rotorwatch.base.files import printable
from rotorwatch.commands import cli
from rotorwatch.flight import Flight, Message
from rotorwatch_lab.simulation.write_dataflash import write_dataflash

SAMPLE = cli.SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"
EVIL = "\x1b]0;x\x07\x9b31m\r\n::error::x"
NAME = "a\x1b]0;x\x07\n::error file=x::\u202egol.bin"


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    """A log whose name and texts are full of commands for terminals and workflows."""
    flight = logs.read(SAMPLE)
    evil = [Message(t, "text", "calm") for t in (1.0, 20.0)]
    for message in evil:
        object.__setattr__(message, "text", EVIL)
    texts = sorted([*flight.messages, *evil], key=lambda m: m.time)
    hostile = replace(flight, messages=tuple(texts), name="x")
    object.__setattr__(hostile, "firmware", "ArduCopter V4.5.7" + EVIL)
    path = tmp_path_factory.mktemp("hostile") / NAME
    write_dataflash(hostile, path)
    return path


def test_texts_from_outside_are_printable(log):
    flight = logs.read(log)
    reported = [flight.name, flight.firmware, *flight.parameters, *flight.warnings, *(m.text for m in flight.messages)]
    assert all(map(str.isprintable, reported))
    assert any("::error::x" in text for text in reported)


def test_what_can_be_seen_stays_as_it_is():
    assert printable("Flug über Köln 日本 (2).bin") == "Flug über Köln 日本 (2).bin"
    assert printable("a\x1b[0m\udc80\n") == r"a\x1b[0m\udc80\n"
    assert Message(0.0, "text", "a\x07").text == r"a\x07"
    assert list(Flight("f", "ArduPilot", {}, 0.0, parameters={"A\x1b[2J": 1.0}).parameters) == [r"A\x1b[2J"]
    assert Flight("f", "ArduPilot", {}, 0.0, parameter_changes=((0.0, "A\n", 1.0),)).parameter_changes[0][1] == r"A\n"


def commands(log: Path, folder: Path) -> list[list[str]]:
    missing = str(log.with_name("no\x1b[2J\n::error::x.bin"))
    store = str(folder / "fleet.db")
    return [
        ["info", str(log)],
        ["info", missing],
        ["diagnose", str(log)],
        ["diagnose", str(log), missing, "--jobs", "1"],
        ["diagnose", str(log), "--markdown", "-"],
        ["diagnose", str(log), missing, "--jobs", "1", "--markdown", "-", "--identify"],
        ["fleet", "add", str(log), "--store", store],
        ["fleet", "list", "--store", store],
        ["watch", str(log), "--speed", "max"],
    ]


def test_no_command_of_a_log_reaches_a_terminal(log, tmp_path, run):
    for words in commands(log, tmp_path):
        _, *reported = run(*words)
        said = "".join(reported)
        assert said.strip(), words
        assert all(line.isprintable() for line in said.splitlines()), (words, said)
        assert not any(line.startswith("::") for line in said.splitlines()), (words, said)
