"""The law of the glue: fed recorded samples at the autopilot's rates, it says what `diagnose` says of the flight, in few texts.

A flight in every run; with ROTORWATCH_FULL_LAW=1 those of ../shared/flights whose logs have enough samples to show what a board would have
seen.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests import board

from rotorwatch import logs
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.diagnose import diagnose
from rotorwatch.engine.events.texts import EVERY_S
from rotorwatch.engine.events.words import NOTICE, WARNING
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight.kinds import SUREST

FLIGHTS = Path(__file__).parents[2] / "shared" / "flights"
FULL = bool(os.environ.get("ROTORWATCH_FULL_LAW"))
needs_compiler = pytest.mark.skipif(not (shutil.which("gcc") and shutil.which("g++")), reason="needs gcc and g++")
HEXA = "hexax_m3_mul0.80_square_wind.bin.xz"


def few(flown):
    """No text sooner after another one than promised."""
    times = [time for time, *_ in flown.texts]
    assert len(times) < 2 or np.diff(times).min() >= EVERY_S - 1e-6, flown.texts


@pytest.fixture(scope="module")
def flight():
    return logs.read(SAMPLES / HEXA)


@pytest.fixture(scope="module")
def programs(flight, tmp_path_factory):
    """The programs of the glue of both autopilots, each built once for the vehicle of a sample."""
    made = {}

    def of(autopilot):
        if autopilot not in made:
            folder, what = tmp_path_factory.mktemp(autopilot), board.shown(flight)
            what = board.in_shares(what) if autopilot == "px4" else what
            made[autopilot] = board.build(autopilot, board.library(what, folder / "library"), folder, "-O1")
        return made[autopilot]

    return of


@needs_compiler
@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=pytest.mark.thorough), "ardupilot"])
def test_a_flight_is_reported_as_diagnose_tells_it(autopilot, flight, programs, tmp_path):
    """A rotor that lost a third: one event, one text; a record holds all rotors; nothing is dropped."""
    reported, what = diagnose(flight), board.shown(flight)
    what = board.in_shares(what) if autopilot == "px4" else what
    flown = board.fly(programs(autopilot), what.table, tmp_path)
    assert board.differences(reported, flown) == []
    few(flown)
    assert flown.left == 0, "stopped, it leaves nothing behind"
    assert [severity for _, severity, _ in flown.texts] == [WARNING] and "rotor 3 lost" in flown.texts[0][2]
    assert flown.texts[0][0] - reported.events[0].detected_s < 0.5
    rows = flown.records["RWLS"]
    assert all(row["Drop"] == 0 for row in rows) and len(rows) > 4 * (rows[-1]["TimeUS"] - rows[0]["TimeUS"]) / 1e6
    assert all(np.isnan(rows[-1][f"L{k}"]) == (k > 6) for k in range(1, 13))
    assert abs(rows[-1]["L3"] - reported.events[0].loss[0]) < 0.1
    if autopilot == "ardupilot":
        assert max(row["P"] for row in flown.records["RWEV"]) == pytest.approx(SUREST), "no surer than an answer"


@needs_compiler
def test_memory_and_thread_only_where_it_is_enabled(programs, flight, tmp_path):
    table = board.shown(flight).table
    off, on = (board.fly(programs("ardupilot"), table[:2000], tmp_path, enable) for enable in ("0", "1"))
    assert off.size == (off.size[0], 0) and on.size[1] == 1, "a thread"
    assert off.size[0] <= 64, "bytes that every vehicle has"
    assert not off.records and not off.texts and off.verdict == 0


@needs_compiler
def test_what_is_reported_is_what_was_asked_for(programs, flight, tmp_path):
    table = board.shown(flight).table
    assert board.fly(programs("ardupilot"), table, tmp_path, "1", "0").texts == []
    assert board.fly(programs("ardupilot"), table, tmp_path, "1", "2").texts == []
    assert len(board.fly(programs("ardupilot"), table, tmp_path, "1", str(NOTICE)).texts) == 1


def every_log():
    found = [p for p in sorted(FLIGHTS.rglob("*")) if p.is_file() and p.suffix in (".xz", ".bin", ".ulg")]
    found = [p for p in found if not {"corrupt", "damaged"} & set(p.parts)]
    return found


# Why a log's events differ on board, by its name. Its outputs are those of the log, 10 a second, and what is rebuilt of the controller's:
# where that cannot be trusted - rotors at their limits, outputs that are slewed - a board would have seen more than the log shows.
DIFFERS: dict[str, str] = {
    "px4_q12_m2_15_square_wind.ulg.xz": "a rotor that lost 15 % is found on board and not by diagnose: at the limit of both",
    "px4_q13_m3_20_mission.ulg.xz": "the onset of a loss of 20 % is 0.4 s off",
    "px4_q16_m1_30_aggr_high.ulg.xz": "a loss that comes and goes in aggressive flight: fewer of its spells",
    "px4_q17_m1_50_square.ulg.xz": "at its limit a rotor that lost half is in two spells: 13 % of the outputs are not known",
    "px4_q51_m3_30_m1_20_adjacent.ulg.xz": "of two rotors that lost 30 and 20 % only the weaker one is named",
    "px4_q73_m1_50_slew60_wind.ulg.xz": "slewed outputs: 10 % of them are not known",
}


@needs_compiler
@pytest.mark.skipif(not FULL, reason="many logs: set ROTORWATCH_FULL_LAW=1")
@pytest.mark.parametrize("path", every_log() if FULL else [], ids=lambda p: p.name)
def test_every_log_is_reported_as_diagnose_tells_it(path, tmp_path):
    try:
        flight = logs.read(path)
        name, what, reported = board.autopilot_of(flight), board.shown(flight), diagnose(flight)
    except (RotorwatchError, board.TooFew) as why:
        pytest.skip(str(why))
    program = board.build(name, board.library(what, tmp_path / "library"), tmp_path / "made", "-O1")
    flown = board.fly(program, what.table, tmp_path)
    few(flown)
    if any(e.kind == "loss_of_control" for e in reported.events) or reported.doubts:
        pytest.skip("assessed after the flight")
    found = board.differences(reported, flown)
    if path.name in DIFFERS:
        assert found, "once it is the same it goes from the list"
        pytest.xfail(DIFFERS[path.name])
    assert found == []
