"""Scenarios, and the logs written of simulated flights: what other tools and our own readers find in them."""

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import example, given, settings
from hypothesis import strategies as st

import rotorwatch as rw
from conftest import trials
from rotorwatch import airframes
from rotorwatch.base.backend import jax
from rotorwatch.commands.cli import cli
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import open_score, open_world
from rotorwatch_lab.simulation import helicopter, logbook, scenario, simulate
from rotorwatch_lab.simulation.logged import in_order
from rotorwatch_lab.simulation.prepare import frame_numbers, plan, vehicle
from rotorwatch_lab.simulation.write_dataflash import write_dataflash
from rotorwatch_lab.simulation.write_ulog import write_ulog

SCENARIOS = sorted((Path(__file__).resolve().parents[1] / "docs" / "scenarios").glob("*.toml"))
HEXA = next(path for path in SCENARIOS if path.stem == "hexa-loss")
FAULT = {"kind": "loss", "rotor": 3, "onset_s": 25.0, "strength": 0.4}
WITHIN = {"motors": 1e-6, "battery": 1e-5, "position": 1e-5}  # single precision of what the log holds


def table(autopilot="ardupilot", frame="hexa-x", **tables):
    rest = {"duration_s": 45.0, "autopilot": autopilot, "seed": 5, "trajectory": {"altitude_m": 6.0}, "faults": [FAULT]}
    return {**rest, "airframe": {"frame": frame}, **tables}


@cache
def made(autopilot):
    return simulate(scenario.from_table(table(autopilot, logging={"profile": "default", "esc": True})))


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    paths = {}
    for autopilot, name in (("ardupilot", "one.bin"), ("px4", "one.ulg")):
        paths[autopilot] = made(autopilot).write(folder / name, folder / name)
    return paths


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_our_readers_find_what_was_written(logs, autopilot):
    flight, found = made(autopilot).flight, rw.read(logs[autopilot][0])
    assert found.warnings == () and found.autopilot == flight.autopilot
    assert set(found.signals) == set(flight.signals)
    assert found.parameters == pytest.approx(dict(flight.parameters), rel=1e-6)
    for name, asked in flight.signals.items():
        got = found.signals[name]
        if autopilot == "px4" and name == "gyro" and len(got) != len(asked):
            continue  # the reader prefers the other topic when it is faster
        assert got.unit == asked.unit and got.columns == asked.columns, name
        assert np.allclose(got.time, asked.time, rtol=0, atol=2e-6), name
        wanted = asked.values
        if name == "attitude":
            wanted = wanted * np.sign(np.sum(wanted * got.values, axis=1, keepdims=True))
        assert np.allclose(got.values, wanted, rtol=2e-7, atol=WITHIN.get(name, 2e-6)), name
    assert [(m.kind, m.value) for m in found.messages if m.kind in ("armed", "landed")][-4:] == [
        *(("armed", 1.0), ("landed", 0.0), ("landed", 1.0), ("armed", 0.0))
    ]


def test_records_follow_each_other_in_time_whatever_they_are_of():
    """Of equal stamps those of the earlier table come first, single records last; some tables are empty."""
    one = np.array([b"aaaa", b"bbbb", b"cccc"], "V4")
    two, none = np.array([(7, 1.0), (8, 2.0)], [("n", "u1"), ("x", "<f4")]), np.zeros(0, "V9")
    tables = [(np.array([1, 5, 5]), one), (np.zeros(0, int), none), (np.array([0, 5]), two)]
    alone = [(5, b"end\0"), (0, b"begin")]
    first, second = (two[k : k + 1].tobytes() for k in range(2))
    wanted = [first, b"begin", b"aaaa", b"bbbb", b"cccc", second, b"end\0"]
    assert in_order(tables, alone) == b"".join(wanted)
    assert in_order([], [(2, b"b"), (1, b"a")]) == b"ab" and in_order([], []) == b""


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_campaign_answers_from_memory_what_diagnose_answers_to_the_file(logs, autopilot, monkeypatch):
    path, (one, numbers, record) = (logs[autopilot][0], (made(autopilot).scenario, made(autopilot).plan, made(autopilot).record))
    data = logbook.log(one, numbers, record)
    assert data == path.read_bytes()
    row, answer = open_world._row(7, one, numbers, record), rw.diagnose(path)
    wanted = open_score.assessed(one, answer)
    assert {key: row[key] for key in wanted} == wanted and answer.events
    assert (row["verdict"], row["headline"]) == (answer.verdict, answer.headline)
    assert row["airborne_s"] == answer.flight["airborne_s"][1] - answer.flight["airborne_s"][0]
    monkeypatch.setattr(logbook, "log", lambda *_: b"nothing")
    damaged = open_world._row(7, one, numbers, record)
    assert damaged["verdict"] == "error" and damaged["headline"] == f"flight-7{path.suffix}: not a flight log of a known kind"


def test_pymavlink_opens_the_dataflash_log(logs):
    DFReader = pytest.importorskip("pymavlink.DFReader")
    log = DFReader.DFReader_binary(str(logs["ardupilot"][0]), zero_time_base=False)
    seen, outputs, pitch = {}, [], []
    while (m := log.recv_msg()) is not None:
        seen[m.get_type()] = seen.get(m.get_type(), 0) + 1
        if m.get_type() == "RCOU":
            outputs.append([m.C1, m.C6, m.C7])
        if m.get_type() == "RATE":
            pitch.append(np.radians(m.P))
    flight = made("ardupilot").flight
    assert seen["RCOU"] == 450 and seen["IMU"] == 1125 and seen["PARM"] == len(flight.parameters) and seen["ESC"] == 6 * 450
    assert np.array_equal(np.array(outputs)[:, :2], flight["motors"].values[:, [0, 5]])
    assert np.allclose(pitch, flight["rates"].values[:, 1], atol=1e-6)
    assert log.params["FRAME_CLASS"] == 2 and log.params["SERVO6_FUNCTION"] == 38


def test_pyulog_opens_the_ulog(logs):
    from pyulog import ULog

    log = ULog(str(logs["px4"][0]))
    assert not log.file_corruption and not log.dropouts
    flight = made("px4").flight
    motors = log.get_dataset("actuator_motors").data
    assert np.allclose([motors[f"control[{k}]"] for k in range(6)], flight["motors"].values.T, atol=1e-6)
    assert np.isnan(motors["control[6]"]).all()
    imu = log.get_dataset("sensor_combined").data
    assert len(imu["timestamp"]) == 9000 and (np.diff(imu["timestamp"].astype(int)) > 0).all()
    assert log.initial_parameters["CA_ROTOR_COUNT"] == 6 and log.msg_info_dict["sys_name"] == "PX4"
    assert log.get_dataset("esc_status").data["esc[5].esc_rpm"].max() > 1000


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_the_log_does_not_hold_the_truth(logs, autopilot):
    log, about, series = logs[autopilot]
    text = log.read_bytes().decode("latin-1").lower()
    assert not re.findall(r"truth|theta|loss|(?<!de)fault|sim_", text)
    reported = json.loads(about.read_text())
    assert reported["faults"][0]["rotor"] == 3 and reported["largest_loss"] == [0, 0, 0.4, 0, 0, 0] and reported["crashed_s"] is None
    columns = np.genfromtxt(series, delimiter=",", names=True)
    began = columns["time_s"][np.argmax(columns["loss_3"] > 0.1)]
    assert began == pytest.approx(25.0, abs=0.03) and columns["loss_3"][-1] == 0.4 and columns["loss_2"].max() == 0


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_the_diagnosis_finds_the_fault(logs, autopilot):
    answer = rw.diagnose(logs[autopilot][0])
    assert answer.verdict == "fault", answer.reason
    event = next(e for e in answer.events if e.kind == "loss_of_effectiveness")
    assert event.rotors == (3,) and event.onset_s == pytest.approx(25.0, abs=0.3) and event.detected_s < 27.0
    assert event.loss[0] == pytest.approx(0.4, abs=0.06)


def test_frames_and_outputs_are_recognised(logs):
    for autopilot, name in (("ardupilot", "ardupilot-hexa-x"), ("px4", "px4-6-rotors")):
        found = rw.airframes.identify(rw.read(logs[autopilot][0]))
        assert found.name == name
        ours = vehicle(made(autopilot).scenario)
        assert found.mixer == pytest.approx(ours.mixer, abs=1e-7)
        assert found.curve.expo == pytest.approx(ours.curve.expo) and found.curve.u_max == pytest.approx(ours.curve.u_max)


def test_writers_refuse_the_other_autopilot(tmp_path):
    with pytest.raises(ConfigError, match="write a ULog"):
        write_dataflash(made("px4").flight, tmp_path / "x.bin")
    with pytest.raises(ConfigError, match="write a DataFlash"):
        write_ulog(made("ardupilot").flight, tmp_path / "x.ulg")
    with pytest.raises(ConfigError, match=r"x\.ulg: a log of the autopilot ardupilot is a \.bin file"):
        made("ardupilot").write(tmp_path / "x.ulg")


# -- scenarios -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda p: p.stem)
def test_examples_can_be_planned(path):
    asked = scenario.read(path)
    if asked.helicopter:
        found = [helicopter.plan(asked)]
    else:
        found = [plan(asked.with_autopilot(autopilot)) for autopilot in scenario.AUTOPILOTS]
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax().tree.leaves(found))


WRONG = {
    "wnid is not a field of a scenario": {"wnid": {}},
    r"wind.speed is not a field .did you mean speed_m_s..; known are speed_m_s": {"wind": {"speed": 3}},
    r"wind.speed_m_s must lie between 0 and 30, not 99": {"wind": {"speed_m_s": 99}},
    r"wind.speed_m_s must be a number, not 'much'": {"wind": {"speed_m_s": "much"}},
    r"wind must be a table": {"wind": 3},
    r"airframe.frame is missing": {"airframe": {}},
    r"airframe.frame: there is no frame 'hexa-z'; close ones are hexa-x, ": {"airframe": {"frame": "hexa-z"}},
    r"airframe.frame: the rotors of quad-vtail are tilted": {"airframe": {"frame": "quad-vtail"}},
    r"airframe.inertia_kg_m2 must be 3 numbers": {"airframe": {"frame": "quad-x", "inertia_kg_m2": [1, 2]}},
    r"airframe.inertia_kg_m2: no body": {"airframe": {"frame": "quad-x", "inertia_kg_m2": [1.0, 1.0, 3.0]}},
    r"airframe.payload_kg: .* too much": {"airframe": {"frame": "quad-x", "payload_kg": 9.0}},
    r"airframe.ground_effect must be true or false": {"airframe": {"frame": "quad-x", "ground_effect": 1}},
    r"trajectory.kind must be one of hover, .*, not 'loop'": {"trajectory": {"kind": "loop"}},
    r"duration_s is 45, but the way to trajectory.altitude_m and back takes": {"trajectory": {"altitude_m": 40}},
    r"seed must be a whole number": {"seed": 1.5},
    r"name must be a text": {"name": 3},
    r"faults\[1\].rotor is missing": {"faults": [{"kind": "loss", "onset_s": 3.0, "strength": 0.1}]},
    r"faults\[1\].strength is missing: a bias needs one": {"faults": [{"kind": "bias", "rotor": 1, "onset_s": 3.0}]},
    r"faults\[2\].onset_s is 99, not before the end": {"faults": [FAULT, {**FAULT, "onset_s": 99.0}]},
    r"faults\[1\].end_s must lie after": {"faults": [{**FAULT, "end_s": 3.0}]},
    r"faults\[1\].strength must be a share from 0 to 1": {"faults": [{**FAULT, "strength": -0.1}]},
    r"faults must be at most 2": {"faults": [FAULT] * 3},
    r"faults\[2\].rotor is 7, but the frame hexa-x has 6": {"faults": [FAULT, {**FAULT, "rotor": 7}]},
    r"faults\[1\].onset_s is 45, not before the end of the flight at 45": {"faults": [{**FAULT, "onset_s": 45.0}]},
    r"faults\[1\].strength: a stuck has none; leave it out": {"faults": [{**FAULT, "kind": "stuck"}]},
    r"faults\[1\].level: a loss has none; leave it out": {"faults": [{**FAULT, "level": 0.3}]},
    r"faults\[1\].vibration: a loss has none; leave it out": {"faults": [{**FAULT, "vibration": 3.0}]},
    r"faults\[1\].ramp_s: a float has none; leave it out": {"faults": [{"kind": "float", "rotor": 3, "onset_s": 25.0, "ramp_s": 1.0}]},
    r"faults\[1\].duty: only a fault with a period_s has one": {"faults": [{**FAULT, "duty": 0.3}]},
    r"rate_hz must be a multiple of 100, the rate of the record, not 333": {"rate_hz": 333.0},
    r"seed must lie between 0 and 2147483647, not 1e\+99": {"seed": 10**99},
    r"duration_s must be a number, not 9999": {"duration_s": int("9" * 400)},
    r"autopilot must be one of ardupilot, px4": {"autopilot": "betaflight"},
}


@pytest.mark.parametrize("sentence", WRONG)
def test_one_sentence_names_the_field(sentence):
    with pytest.raises(ConfigError, match=sentence):
        plan(scenario.from_table({**table(), **WRONG[sentence]}))


def wrong_values(field):
    """Values that a field does not take: of another kind, out of its range, not finite, too few."""
    if field.choices:
        return ["nonsense", 3, None, []]
    if isinstance(field.default, bool):
        return [1, "yes", None, []]
    if field.low == field.high:
        return [3, True, None, {}]
    if field.numbers:
        good = [field.low] * field.numbers
        return [good[1:], [*good, field.low], field.low, "x", [*good[1:], float("nan")], [*good[1:], field.high * 2 + 1]]
    return [True, "x", None, [], {}, float("nan"), float("inf"), field.low - 1, field.high * 2 + 1]


ALL_FIELDS = [(part, name) for part, fields in scenario.FIELDS.items() for name in fields]


@pytest.mark.parametrize(("part", "name"), ALL_FIELDS, ids=[".".join(f).strip(".") for f in ALL_FIELDS])
def test_every_field_refuses_by_name(part, name):
    for value in wrong_values(scenario.FIELDS[part][name]):
        changed = {part: {**table().get(part, {}), name: value}} if part else {name: value}
        with pytest.raises(ConfigError) as why:
            scenario.from_table({**table(), **changed})
        text = str(why.value)
        assert text.startswith(f"{part}.{name} " if part else f"{name} ") and "\n" not in text and text.endswith("."), text


@pytest.mark.parametrize("name", scenario.FAULT_FIELDS)
def test_every_field_of_a_fault_refuses_by_name(name):
    for value in wrong_values(scenario.FAULT_FIELDS[name]):
        with pytest.raises(ConfigError) as why:
            scenario.from_table({**table(), "faults": [FAULT, {**FAULT, name: value}]})
        assert str(why.value).startswith(f"faults[2].{name} ") and "\n" not in str(why.value)


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 99) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["kind", "frame", "rotor", "x"]), inner, max_size=3),
    max_leaves=6,
)


@given(part=st.sampled_from([*scenario.FIELDS[""], "airframe", "wind", "faults", "sensors", "trajectory", "battery"]), junk=JUNK)
@example(part="duration_s", junk=5)  # the fault of the table begins later
@settings(max_examples=trials(150), deadline=None)
def test_junk_is_a_config_error_or_a_scenario(part, junk):
    try:
        scenario.from_table({**table(), part: junk})
    except ConfigError as error:
        assert part.split(".")[0] in str(error)


def test_frame_numbers():
    assert frame_numbers("hexa-x") == (2, 1) and frame_numbers("octa-coaxial") == (4, 1) and frame_numbers("y6-b") == (5, 10)
    with pytest.raises(ConfigError, match="ArduPilot has no frame niermeyer-hexa"):
        frame_numbers("niermeyer-hexa")


def test_a_papers_airframe():
    numbers = plan(scenario.from_table(table("px4", "niermeyer-hexa")))
    assert float(numbers.craft.mass) == 2.0 and numbers.craft.thrust_max == pytest.approx([9.0] * 6)
    assert np.diag(numbers.craft.J) == pytest.approx([0.032, 0.032, 0.058])


# -- command line ----------------------------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(cli, ["simulate", *map(str, arguments)])


def test_command_writes_a_log_and_the_truth(tmp_path):
    text = "\n".join(
        [
            *("duration_s = 45.0", "seed = 5", "[airframe]", 'frame = "hexa-x"', "[trajectory]", "altitude_m = 6.0"),
            *("[logging]", "esc = true", "[[faults]]", 'kind = "loss"', "rotor = 3", "onset_s = 25.0", "strength = 0.4"),
        ]
    )  # the same flight as above, by its file
    (tmp_path / "s.toml").write_text(text)
    done = run(tmp_path / "s.toml", "-o", tmp_path / "f.bin", "-q")
    assert done.exit_code == 0, done.output
    assert [Path(p).name for p in done.stdout.split()] == ["f.bin", "f.truth.json", "f.truth.csv"]
    made("ardupilot").write(tmp_path / "g.bin")
    assert (tmp_path / "f.bin").read_bytes() == (tmp_path / "g.bin").read_bytes()


def test_command_refuses_in_one_sentence(tmp_path):
    (tmp_path / "s.toml").write_text('[airframe]\nframe = "hexa-x"\n[wind]\nspeed_m_s = -1\n')
    for arguments, sentence in (
        ((tmp_path / "s.toml", "-o", tmp_path / "f.bin"), "wind.speed_m_s must lie between 0 and 30, not -1."),
        ((tmp_path / "no.toml", "-o", tmp_path / "f.bin"), "Cannot read the scenario"),
        ((HEXA, "-o", tmp_path / "f.csv"), "ends in .bin or .ulg"),
        ((HEXA, "-o", tmp_path / "no" / "f.bin"), "there is no folder"),
    ):
        done = run(*arguments)
        assert isinstance(done.exception, ConfigError) and sentence in str(done.exception)
    assert not list(tmp_path.glob("f.*"))


@pytest.mark.parametrize("taken", ["f.bin", "f.truth.json", "f.truth.csv"])
def test_all_files_are_written_or_none(tmp_path, taken):
    """A name that is a folder's is refused before anything flies, and what lies there stays."""
    (tmp_path / taken).mkdir()
    done = run(HEXA, "-o", tmp_path / "f.bin")
    assert isinstance(done.exception, ConfigError) and f"{taken} is a folder" in str(done.exception)
    assert [path.name for path in tmp_path.iterdir()] == [taken]


def test_a_folder_that_takes_no_files():
    done = run(HEXA, "-o", "/proc/f.bin")
    assert isinstance(done.exception, ConfigError) and "cannot write into /proc (" in str(done.exception)


@pytest.mark.parametrize("frame", airframes.papers())
def test_every_papers_airframe_flies_or_is_refused(frame):
    try:
        asked = scenario.from_table({"airframe": {"frame": frame}})
        numbers = helicopter.plan(asked) if asked.helicopter else plan(asked)
    except ConfigError as why:
        assert str(why).startswith("airframe.frame: ")
    else:
        assert np.isfinite(float(numbers.seed))


def test_the_page_lists_every_field():
    page = (SCENARIOS[0].parents[1] / "simulation.md").read_text()
    for part, fields in {**scenario.FIELDS, "faults": scenario.FAULT_FIELDS}.items():
        for name, field in fields.items():
            row = next(line for line in page.splitlines() if line.startswith(f"| `{name}` |") and line.endswith(f"| {field.about} |"))
            value = row.split("|")[2].strip()
            if isinstance(field.default, (int, float)) and not isinstance(field.default, bool):
                assert float(value) == field.default, (part, name)
            assert (value == "-") == (field.default is None), (part, name)
