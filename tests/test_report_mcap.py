"""The diagnosis as an MCAP file, read back by Foxglove's library, check sums and all."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

import rotorwatch as rw
from conftest import hexa_diagnosis
from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError, LogError
from rotorwatch.report import mcap_file

LAYOUT = Path(__file__).parents[1] / "docs" / "foxglove-layout.json"


@pytest.fixture(scope="module")
def diagnosis():
    found = hexa_diagnosis()
    return hexa_diagnosis(flight={**found.flight, "utc_start": "2026-11-21T07:40:36.000Z", "boot_s": 12.0})


@pytest.fixture(scope="module")
def file(diagnosis, tmp_path_factory):
    path = tmp_path_factory.mktemp("mcap") / "out.mcap"
    diagnosis.to_mcap(path)
    return path


def messages(path):
    """Topic -> [(ns, message)], and topic -> schema."""
    found, schemas = {}, {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
            schemas[channel.topic] = schema.name, schema.encoding, json.loads(schema.data)
            assert channel.message_encoding == "json"
    return found, schemas


def test_every_tick_is_there_with_its_values(diagnosis, file):
    found, _ = messages(file)
    trace, start = diagnosis.trace, 1_795_246_836_000_000_000  # 2026-11-21 07:40:36 UTC
    time = np.array([m["time_s"] for _, m in found["/rotorwatch/losses"]])
    assert np.allclose(time, trace.time, atol=1e-6)
    assert np.allclose([(t - start) * 1e-9 for t, _ in found["/rotorwatch/losses"]], trace.time, atol=1e-6)
    for k in range(6):
        rows = [m[f"rotor_{k + 1}"] for _, m in found["/rotorwatch/losses"]]
        for name, values in (("loss", trace.loss), ("lower", trace.lower), ("upper", trace.upper)):
            assert np.allclose([r[name] for r in rows], values[:, k], rtol=1e-5)
    for k, axis in enumerate(("roll", "pitch", "yaw", "thrust")):
        assert np.allclose([m[axis] for _, m in found["/rotorwatch/residuals"]], trace.residual[:, k], rtol=1e-5)
        assert np.allclose([m[f"{axis}_sd"] for _, m in found["/rotorwatch/residuals"]], trace.residual_sd[:, k], rtol=1e-5)
    assert np.allclose([m["rotor_3"] for _, m in found["/rotorwatch/motors"]], trace.command[:, 2], rtol=1e-5)
    assert np.allclose([m["common_mode"] for _, m in found["/rotorwatch/evidence"]], trace.evidence["common mode"], rtol=1e-5)
    assert {m["threshold"] for _, m in found["/rotorwatch/evidence"]} == {6.0}


def test_events_verdict_and_log(diagnosis, file):
    found, schemas = messages(file)
    events = [(m["moment"], m["time_s"], m["rotors"]) for _, m in found["/rotorwatch/events"]]
    assert events == [("onset", 31.2, [3]), ("announced", 31.56, [3])]
    ((at, verdict),) = found["/rotorwatch/verdict"]
    assert verdict["headline"] == diagnosis.headline and verdict["rotors"][2]["status"] == "degraded"
    assert at == found["/rotorwatch/losses"][0][0]
    log = [(m["level"], m["message"]) for _, m in found["/rotorwatch/log"]]
    assert (4, "error: crash check") in log and any("rotor 3" in text and level == 4 for level, text in log)
    assert all(m["timestamp"]["sec"] * 10**9 + m["timestamp"]["nsec"] == t for t, m in found["/rotorwatch/log"])
    assert schemas["/rotorwatch/log"][0] == "foxglove.Log"
    phases = [m["phase"] for _, m in found["/rotorwatch/state"]]
    assert phases == ["on the ground", "learning what healthy means for this flight", "assessed", "on the ground"]


def test_schemas_name_every_field(file):
    found, schemas = messages(file)
    for topic, rows in found.items():
        name, encoding, schema = schemas[topic]
        assert encoding == "jsonschema" and schema["type"] == "object" and schema["title"] == name
        assert {key for _, m in rows for key in m} <= set(schema["properties"]), topic
    assert set(schemas["/rotorwatch/losses"][2]["properties"]["rotor_2"]["properties"]) == {"loss", "lower", "upper"}


def test_the_answer_and_the_clock_are_in_the_file(diagnosis, file):
    with file.open("rb") as stream:
        reader = make_reader(stream)
        (attached,) = reader.iter_attachments()
        (about,) = reader.iter_metadata()
    assert attached.name == "diagnosis.json" and attached.data.decode() == diagnosis.to_json()
    assert about.name == "rotorwatch" and about.metadata["clock"] == "UTC" and about.metadata["verdict"] == "fault"


@pytest.mark.parametrize("flight, first, clock", [({"boot_s": 12.0}, 12.0, "autopilot's start"), ({}, 0.0, "first record")])
def test_without_utc_times_are_the_autopilots(tmp_path, flight, first, clock):
    found = hexa_diagnosis()
    hexa_diagnosis(flight={**found.flight, **flight}).to_mcap(tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_summary().statistics.message_start_time == pytest.approx(first * 1e9, abs=1e6)
        assert clock in next(iter(reader.iter_metadata())).metadata["clock"]


def test_values_that_are_not_known_are_left_out(diagnosis, tmp_path):
    trace = diagnosis.trace
    command = trace.command.copy()
    command[:5] = np.nan
    rw.Diagnosis.to_mcap(hexa_diagnosis(trace=type(trace)(**{**vars(trace), "command": command})), tmp_path / "out.mcap")
    found, schemas = messages(tmp_path / "out.mcap")
    assert len(found["/rotorwatch/motors"]) == len(trace.time) - 5
    assert "rotor_6" in schemas["/rotorwatch/motors"][2]["properties"]


def test_a_flight_that_was_not_assessed_has_its_verdict(tmp_path):
    hexa_diagnosis(trace=None, events=()).to_mcap(tmp_path / "out.mcap")
    assert set(messages(tmp_path / "out.mcap")[0]) == {"/rotorwatch/verdict", "/rotorwatch/log"}


def test_all_of_it_or_nothing(diagnosis, tmp_path, monkeypatch):
    path = tmp_path / "out.mcap"
    path.write_bytes(b"before")
    monkeypatch.setattr(mcap_file, "_ticks", lambda trace: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        diagnosis.to_mcap(path)
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]
    with pytest.raises(ConfigError, match="there is no folder"):
        diagnosis.to_mcap(tmp_path / "nowhere" / "out.mcap")


def test_a_diagnosis_is_no_flight(file):
    with pytest.raises(LogError, match="a diagnosis that rotorwatch wrote, not a flight"):
        rw.read(file)


def test_the_layout_shows_topics_and_fields_that_are_there(file):
    schemas = messages(file)[1]
    layout = json.loads(LAYOUT.read_text())

    def panels(node):
        return [node] if isinstance(node, str) else [*panels(node["first"]), *panels(node["second"])]

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    text = json.dumps(layout)
    for topic in ("losses", "evidence", "residuals", "motors", "state", "log", "verdict"):
        assert f"/rotorwatch/{topic}" in text
    for panel in layout["configById"].values():
        for path in panel.get("paths", ()):
            topic, _, fields = path["value"].partition(".")
            about = schemas[topic][2]
            if fields[:7] in ("rotor_7", "rotor_8", "best_pa"):  # octas; the trace made for tests has no pairs
                continue
            for field in fields.split("."):
                about = about["properties"][field]


def test_the_command_writes_a_file_for_each_log(tmp_path, monkeypatch):
    import rotorwatch.diagnose
    import rotorwatch.logs

    monkeypatch.setattr(rotorwatch.logs, "read", lambda path, progress=None: path)
    monkeypatch.setattr(rotorwatch.diagnose, "diagnose", lambda flight, **options: hexa_diagnosis())
    logs = [tmp_path / "a.bin", tmp_path / "b.bin"]
    for log in logs:
        log.write_bytes(b"x")
    done = CliRunner().invoke(cli.cli, ["diagnose", str(logs[0]), "--mcap", str(tmp_path / "one.mcap")])
    assert done.exit_code == 1 and "MCAP file written to" in done.output and (tmp_path / "one.mcap").exists()
    done = CliRunner().invoke(cli.cli, ["diagnose", *map(str, logs), "--mcap", str(tmp_path / "all"), "--quiet"])
    assert done.exit_code == 1 and {p.name for p in (tmp_path / "all").iterdir()} == {"a.mcap", "b.mcap"}
