"""Logs of PX4 that Flight Review v2 has made into Parquet tables: read as the ULog is."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from tests.review_tables import convert

import rotorwatch as rw
from rotorwatch import gathering
from rotorwatch.errors import LogError
from rotorwatch_lab.simulation import scenario, simulate


@pytest.fixture(scope="module")
def ulog(tmp_path_factory):
    table = {
        **{"duration_s": 45.0, "autopilot": "px4", "seed": 5, "trajectory": {"altitude_m": 6.0}, "airframe": {"frame": "quad-x"}},
        "faults": [{"kind": "loss", "rotor": 3, "onset_s": 25.0, "strength": 0.4}],
        "logging": {"profile": "default", "esc": True},
    }
    folder = tmp_path_factory.mktemp("px4")
    return simulate(scenario.from_table(table)).write(folder / "flight.ulg", folder / "truth")[0]


@pytest.fixture(scope="module")
def tables(ulog, tmp_path_factory):
    return convert(ulog, tmp_path_factory.mktemp("review") / "0f4c")


def test_the_tables_are_read_as_the_ulog(ulog, tables):
    one, two = rw.read(ulog), rw.read(tables)
    assert two.format == "Flight Review tables" and two.autopilot == "PX4" and two.start_us == one.start_us
    assert set(one.signals) == set(two.signals) and one.parameters == two.parameters and one.vehicle_type == two.vehicle_type
    for name, signal in one.signals.items():
        assert np.array_equal(signal.time, two[name].time) and np.array_equal(signal.values, two[name].values, equal_nan=True), name
    assert one.messages == two.messages and one.facts == two.facts and not two.warnings


def test_the_diagnosis_is_that_of_the_ulog(ulog, tables):
    one, two = (rw.diagnose(rw.read(path)).to_dict() for path in (ulog, tables))
    assert one["verdict"] == "fault" and one["events"] == two["events"] and one["rotors"] == two["rotors"]


def test_a_folder_of_them_is_a_folder_of_logs(ulog, tables, tmp_path):
    """Flight Review keeps the ULog beside its tables: that is one log."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for file in tables.iterdir():
            (tmp_path / name / file.name).write_bytes(file.read_bytes())
        (tmp_path / name / "log.ulg").write_bytes(ulog.read_bytes())
    assert [path.name for path in gathering.Gathered([tmp_path])] == ["a", "b"]


def test_a_bucket_of_them_is_a_bucket_of_logs(ulog, tables, tmp_path):
    """Behind an address, as Flight Review's storage is: a folder of tables is one log, and is fetched."""
    fsspec = pytest.importorskip("fsspec")
    system = fsspec.filesystem("memory")
    for name in ("a", "b"):
        for file in tables.iterdir():
            system.pipe(f"/review/{name}/{file.name}", file.read_bytes())
        system.pipe(f"/review/{name}/log.ulg", ulog.read_bytes())
    system.pipe("/review/c.ulg", ulog.read_bytes())
    try:
        found = list(gathering.Gathered(["memory://review/"]))
        assert found == ["memory:///review/a/", "memory:///review/b/", "memory:///review/c.ulg"]
        assert list(gathering.Gathered([found[0]])) == found[:1]
        with gathering.fetched(found[0]) as here:
            assert here.name == "a" and rw.read(here).parameters and not (here / "log.ulg").exists()
        answers = {answer.path: answer for answer in rw.diagnose_many(["memory://review/"], jobs=1)}
        assert {answer.diagnosis.verdict for answer in answers.values()} == {"fault"} and len(answers) == 3
    finally:
        system.rm("/review", recursive=True)


def untimed(path):
    pq.write_table(pq.read_table(path).drop(["timestamp"]), path)


@pytest.mark.parametrize(
    "damage, says",
    [
        (lambda f: (f / "metadata.json").unlink(), "metadata.json is missing"),
        (lambda f: (f / "metadata.json").write_text("{"), "metadata.json is damaged"),
        (lambda f: (f / "metadata.json").write_text("[1]"), "metadata.json is damaged"),
        (lambda f: (f / "vehicle_local_position.parquet").write_bytes(b"PAR1" + bytes(50)), "vehicle_local_position.parquet: this Parquet"),
        (lambda f: untimed(f / "battery_status.parquet"), "battery_status.parquet: a table needs a column timestamp"),
    ],
)  # fmt: skip
def test_what_is_left_of_damaged_tables_is_read(tables, tmp_path, damage, says):
    folder = tmp_path / "log"
    folder.mkdir()
    for file in tables.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    damage(folder)
    flight = rw.read(folder)
    assert any(says in warning for warning in flight.warnings) and len(flight["gyro"]) > 1000


def test_values_of_other_types_in_the_metadata_are_left_out(tables, tmp_path):
    folder = tmp_path / "log"
    folder.mkdir()
    for file in tables.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    about = json.loads((folder / "metadata.json").read_text())
    about |= {"start_timestamp_us": "x", "logged_messages": {"a": 1}, "tagged_logged_messages": [1, {"timestamp_us": None}], "ver_hw": 3}
    about["parameters"] |= {"SIM_FAULT": 1.0, "TEXT": "a", "NONE": None}
    (folder / "metadata.json").write_text(json.dumps(about))
    flight = rw.read(folder)
    assert not {"SIM_FAULT", "TEXT", "NONE"} & set(flight.parameters) and "ver_hw" not in flight.facts


def test_tables_without_samples_are_refused_in_a_sentence(tmp_path):
    (tmp_path / "vehicle_attitude.parquet").write_bytes(b"PAR1")
    with pytest.raises(LogError, match=r"vehicle_attitude\.parquet: this Parquet table is damaged"):
        rw.read(tmp_path)
