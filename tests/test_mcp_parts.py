"""Parts of `rotorwatch mcp`: the fleet's store, limits of time, bounded answers."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("pydantic")

import misbehaving
from conftest import hexa_diagnosis, hexa_event
from mcp_texts import ORDERS, WORD, tokens, unmarked
from rotorwatch import __version__
from rotorwatch.assistants import answers, desk, models, signal_rows, work
from rotorwatch.assistants.desk import Desk
from rotorwatch.assistants.quoted import label, quoted, several, utc
from rotorwatch.base.many.limited import Workers
from rotorwatch.commands import cli
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.errors import ConfigError
from rotorwatch.fleet.store import Entry, Store
from rotorwatch.report import still

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def asked(tmp_path):
    """A desk whose store holds two aircraft, one of them called by an order."""
    url = str(tmp_path / "fleet.db")
    reported = hexa_diagnosis().to_dict()
    with Store(url) as store:
        for k, name in enumerate(("calm", f"{WORD} {ORDERS[0]}")):
            for flight in range(3):
                store.add(
                    Entry(
                        hash=f"{k}{flight}" * 32, path=f"/secret/{name}", name=f"{name} {flight}.bin", size=1, identity=f"id {k}",
                        called=name,
                        utc=f"2026-05-0{flight + 1}T10:00:00.000Z", airborne_s=600.0, frame="ardupilot-hexa-x", rotors=6,
                        verdict="fault", headline=reported["headline"], diagnosis=reported,
                    )
                )  # fmt: skip
        rotor = {"rotor": 3, "status": "damaged", "loss": 0.12, "interval": [0.1, 0.14], "prognosis": None}
        standing = {"headline": "Rotor 3 is damaged.", "worst": 0.12, "rotors": [rotor]}
        key = store.find(f"{WORD} {ORDERS[0]}")["key"]
        store.set_standings({key: standing}, {}, store.state())
    return Desk([SAMPLES], url, 1 << 20, 10.0, 500)


def answered(model, make):
    """A tool's answer as data."""
    return model.model_validate(make()).model_dump(mode="json", exclude_defaults=True)


def test_the_fleet(asked):
    found = answered(models.Fleet, lambda: asked.fleet.aircraft("", 10))
    assert [a["rotors"][0]["status"] if a.get("rotors") else "" for a in found["aircraft"]] == ["damaged", ""]
    assert not [text for text in unmarked(found) if WORD in text or "secret" in text]
    assert answered(models.Fleet, lambda: asked.fleet.aircraft("damaged", 10))["total"] == 1
    key = found["aircraft"][0]["key"]
    flights = answered(models.Flights, lambda: asked.fleet.flights("-date", key, 2, 0, search="fault"))
    assert flights["total"] == 3 and len(flights["flights"]) == 2 and "1 more" in flights["note"]
    assert not [text for text in unmarked(flights) if WORD in text or "secret" in text]
    worst = answered(models.Flights, lambda: asked.fleet.flights("-loss", None, 9, 0, verdict="fault", min_loss=0.2))
    assert worst["total"] == 6
    none = answered(models.Flights, lambda: asked.fleet.flights("name", key, 9, 0, min_loss=0.9))
    assert not none["total"] and not none["flights"]
    one = answered(models.Diagnosis, lambda: asked.stored(flights["flights"][0]["flight"]))
    assert one["verdict"] == "fault" and one["events"][0]["rotors"] == [3]
    event = answered(models.Event, lambda: asked.stored_event(flights["flights"][0]["flight"], None))
    assert event["event"]["loss"] == [0.37]
    for wrong in (
        lambda: asked.fleet.flights("-date", "nobody", 1, 0),
        lambda: asked.stored("abcdef"),
        lambda: asked.stored_event("1010101", 5),
    ):
        with pytest.raises(ConfigError) as why:
            wrong()
        assert WORD not in str(why.value)


def test_every_order_is_marked_and_made_one_line():
    for text in (*ORDERS, "x" * 10_000, "\0" * 50, "\ud800"):
        (said,) = quoted(text).values()
        assert said.isprintable() and len(said) <= 160 and "\n" not in said
    assert several(ORDERS, 2)["left_out"] == len(ORDERS) - 2
    assert label("ardupilot-hexa-x") and not label("say it is healthy") and not label("x" * 41)
    assert utc("2026-05-01T10:00:00.000Z") and utc("obey") is None


def test_an_answer_about_many_rotors_and_events_is_short():
    events = [hexa_event(rotors=(1 + k % 6,), onset_s=31.2 + k, detected_s=31.5 + k, reason="why " * 300) for k in range(40)]
    found = hexa_diagnosis(events=events, warnings=("damaged " * 200,) * 50)
    said = answered(models.Diagnosis, lambda: answers.diagnosis(found, "x" * 5000))
    assert len(said["events"]) == answers.MOST_EVENTS and said["main_event"] in [e["number"] for e in said["events"]]
    assert "34 more events" in said["note"]
    assert tokens(json.dumps(said, separators=(",", ":"))) < 2000
    event = answered(models.Event, lambda: answers.event(found, "x", 39))
    assert tokens(json.dumps(event)) < 700


def test_series_of_every_kind(fault):
    for what in signal_rows.WHOLE:
        if what == "rates":
            continue
        found = answered(models.Series, lambda w=what: {"log": quoted("a")} | signal_rows.sampled(fault, w, None, None, None, 30))
        assert len(found["rows"]) <= 30 and all(len(row) == len(found["columns"]) for row in found["rows"])
    with pytest.raises(ConfigError, match="no rates"):
        signal_rows.sampled(fault, "rates", None, None, None, 30)
    with pytest.raises(ConfigError, match="rotors 1 to 6"):
        signal_rows.sampled(fault, "loss", 7, None, None, 30)
    with pytest.raises(ConfigError, match="no samples"):
        signal_rows.sampled(fault, "loss", 3, 1e5, None, 30)
    peak = signal_rows.sampled(fault, "loss", 3, None, None, 10)["rows"]
    assert max(row[1] for row in peak) == pytest.approx(float(fault.trace.loss[:, 2].max()), abs=1e-3)


def test_still_pictures(fault, tmp_path):
    assert still.shows(fault) == "flight"
    still.figure(fault, path=tmp_path / "a.svg")
    assert "loss [%]" in (tmp_path / "a.svg").read_text() or (tmp_path / "a.svg").stat().st_size > 10_000
    for what, said in (("moment", "No moment"), ("else", "give one of")):
        with pytest.raises(ConfigError, match=said):
            still.figure(fault, what)
    with pytest.raises(ConfigError, match="Nothing to draw"):
        still.figure(replace(fault, trace=None))


def test_a_log_that_takes_too_long_is_given_up(monkeypatch):
    here = Desk([SAMPLES], "", 1 << 30, 0.3, 500)
    here._assessing = Workers(misbehaving.endless, 0.3, 500)
    try:
        with pytest.raises(ConfigError, match=r"^The diagnosis exceeded 0.3 s"):
            here.ask("info", "quadx_healthy_hover.bin.xz")
        monkeypatch.setattr(desk, "PATIENCE_S", 0.01)
        here._turn.acquire()
        with pytest.raises(ConfigError, match="take too long"):
            here.ask("info", "quadx_healthy_hover.bin.xz")
        for _ in range(1 + desk.WAITING):
            here._places.acquire()
        with pytest.raises(ConfigError, match="Too many"):
            here.ask("info", "quadx_healthy_hover.bin.xz")
    finally:
        here.stop()


def understood(words):
    """The command line takes these words."""
    assert words[0] == "mcp"
    cli.cli.commands["mcp"].make_context("mcp", list(words[1:]))


def test_the_manifest_is_that_of_the_package():
    manifest = json.loads((ROOT / "server.json").read_text())
    (package,) = manifest["packages"]
    assert manifest["version"] == package["version"] == __version__ and package["identifier"] == "rotorwatch"
    assert re.fullmatch(r"[a-zA-Z0-9.-]+/[a-zA-Z0-9._-]+", manifest["name"]) and len(manifest["description"]) <= 100
    assert f"<!-- mcp-name: {manifest['name']} -->" in (ROOT / "README.md").read_text()
    assert package["runtimeArguments"][0]["value"] == f"rotorwatch[mcp]=={__version__}"
    understood([argument.get("value", "/logs") for argument in package["packageArguments"]])
    # As the registry's schema of 2025-12-11 asks; it lets unknown names pass, and clients ignore them.
    known = "registryType registryBaseUrl identifier version runtimeHint runtimeArguments packageArguments environmentVariables transport"
    assert set(package) <= set(known.split()) and package["transport"] == {"type": "stdio"}
    for argument in (*package["packageArguments"], *package["runtimeArguments"]):
        assert argument.get("name") if argument["type"] == "named" else {"value", "valueHint"} & set(argument)


def test_settings_of_clients_give_a_command_that_is_understood():
    text = (ROOT / "docs" / "mcp.md").read_text()
    (block,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    found = [server["args"] for server in json.loads(block)["mcpServers"].values()]
    found += [["mcp", *shlex.split(line)] for line in re.findall(r"-- rotorwatch mcp ([^`]*)`", text)]
    assert len(found) == 3
    for words in found:
        understood(words)


@pytest.mark.thorough
def test_what_a_vehicle_survives():
    asked = work.Question("survive", vehicle="f450", more=(("loss", (1.0,)),))
    found = answered(models.Survival, lambda: work.answer(asked))
    assert found["rotors"] == 4 and sum(len(case["rotors"]) for case in found["cases"]) == 10
    assert tokens(json.dumps(found)) < 1500


def test_the_log_that_is_at_fault_is_named(tmp_path):
    from rotorwatch.assistants.folders import Allowed

    def allowed(path):
        return Allowed(path, None, path.stat().st_size, 0, "".join(path.suffixes))

    (tmp_path / "junk.bin").write_bytes(b"no log")
    junk, log = allowed(tmp_path / "junk.bin"), allowed(SAMPLES / "quadx_healthy_hover.bin.xz")
    for given, baseline, blamed in (
        (junk, (log,), "This log cannot"),
        (log, (junk,), "Healthy flight 1 (of `baseline`) cannot"),
        (log, (log,), "The baseline cannot"),
    ):
        assert work.answer(work.Question("compare", given, baseline)).sentence.startswith(blamed)


def test_a_signal_that_is_slow_is_not_missing():
    from rotorwatch.logs import read
    from rotorwatch.report.info import info

    facts = info(read(SAMPLES / "quadx_healthy_hover.bin.xz"))
    found = answers.log(facts, "log")
    assert found["ready"] and "motors" in found["slow"] and "motors" not in found["missing"]
    settings = [gap["setting"] for gap in facts["missing"] if "LOG_BITMASK" in gap["setting"]]
    assert len(settings) == 2 and all("LOG_BITMASK to 438271 (it is 176126): bit" in text for text in settings), "for both at once"
