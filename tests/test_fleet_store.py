"""The store of a fleet, in SQLite and in a real PostgreSQL: once by content, all or nothing, and older stores brought up to date."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

import rotorwatch
from rotorwatch import diagnose, logs
from rotorwatch.errors import ConfigError, StoreError
from rotorwatch.fleet import Entry, Store, default_url, flight_result
from rotorwatch.fleet import store as module

SAMPLES = Path(rotorwatch.__file__).parent / "samples"

pytest.importorskip("sqlalchemy")


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path):
    if request.param == "sqlite":
        return str(tmp_path / "fleet.db")
    return request.getfixturevalue("server").url()


def entry(k: int, aircraft: str = "uid A", **more) -> Entry:
    given = {
        "hash": f"{k:064x}", "path": f"/logs/{k}.bin", "name": f"{k}.bin", "size": 1000 + k, "identity": aircraft, "called": aircraft[-1:],
        "utc": f"2026-01-{k:02d}T10:00:00.000Z", "frame": "quad X", "rotors": 4, "verdict": "healthy", "headline": "Nothing found.",
        "version": "0.1.0", "diagnosis": {"verdict": "healthy"}, "trim": {"share": [0.5] * 4}, "airborne_s": 60.0,
    }  # fmt: skip
    return Entry(**(given | more))


def tables(store: Store) -> dict:
    return {name: list(store.rows(name)) for name in store._t.metadata.tables}


def test_the_same_log_counts_once(url):
    with Store(url) as store:
        assert store.add(entry(1)) and store.add(entry(2, "uid B"))
        before = tables(store)
        assert not store.add(entry(1, path="/elsewhere/copy.bin", verdict="fault"))
        assert tables(store) == before
        assert store.has(entry(1).hash) and not store.has(entry(3).hash)
        assert store.count() == 2


def test_flights_are_listed_searched_and_shown(url):
    with Store(url) as store:
        for k in range(1, 6):
            store.add(entry(k, "uid AB"[: 5 + k % 2], headline="100 % of rotor_2" if k == 3 else "Nothing found."))
        store.add(entry(9, "", utc=None, name="no clock.bin"))
        assert [f["name"] for f in store.flights()] == ["5.bin", "4.bin", "3.bin", "2.bin", "1.bin", "no clock.bin"]
        assert [f["name"] for f in store.flights(limit=2, offset=1)] == ["4.bin", "3.bin"]
        assert [f["name"] for f in store.flights(search="rotor_2 HEALTHY")] == ["3.bin"]
        assert store.count(search="rotorx2") == 0  # _ and % are no patterns
        assert store.count(search="100 %") == 1
        named = store.flights(search="no clock")[0]
        assert named["aircraft"] is None and named["aircraft_name"] is None and named["utc"] is None
        one = store.flight(entry(2).hash)
        assert one is not None and one["diagnosis"] == {"verdict": "healthy"} and one["trim"]["share"] == [0.5] * 4
        assert store.flight("ab" * 32) is None and store.flight("'; drop") is None
        assert store.flight("0" * 10) is None  # several begin so


def test_aircraft_are_summed_up_and_named(url):
    with Store(url) as store:
        for k in range(1, 4):
            store.add(entry(k, "uid A" if k < 3 else "uid B", verdict="fault" if k == 2 else "healthy"))
        first, second = store.aircraft()
        assert (first["name"], first["flights"], first["verdicts"]) == ("A", 2, {"fault": 1, "healthy": 1})
        assert first["first"] == "2026-01-01T10:00:00.000Z" and first["last"] == "2026-01-02T10:00:00.000Z"
        assert first["airborne_s"] == 120.0 and first["rotors"] == 4 and first["stale"] and second["flights"] == 1
        store.rename("A", "Old Faithful")
        assert store.find("old faithful") == store.find("uid A") == store.find(first["key"])
        with pytest.raises(StoreError, match="another one"):
            store.rename("B", "Old Faithful")
        with pytest.raises(StoreError, match="Old Faithful"):
            store.find("Old Fathful")
        assert store.count(aircraft="Old Faithful") == 2 and store.count(search="faithful") == 2


def test_an_aircraft_whose_name_is_taken_gets_a_number(url):
    with Store(url) as store:
        store.add(entry(1, "uid A", called="quad"))
        store.add(entry(2, "uid B", called="quad"))
        assert [a["name"] for a in store.aircraft()] == ["quad", "quad (2)"]


def test_maintenance_is_kept(url):
    with Store(url) as store:
        store.add(entry(1))
        store.service("A", 3, "new propeller", "2026-05-01T00:00:00.000Z")
        store.service("A", 0, "new motors")
        assert [(s["rotor"], s["what"], s["utc"], s["after"]) for s in store.services("A")] == [
            (3, "new propeller", "2026-05-01T00:00:00.000Z", 1),
            (0, "new motors", None, 1),
        ]
        with pytest.raises(ConfigError, match="rotors 1 to 4"):
            store.service("A", 5, "new propeller")


def test_maintenance_without_a_time_lies_after_the_last_flight_of_the_aircraft(url):
    """Not after the one that was added last: old logs may be added later."""
    with Store(url) as store:
        for number, day in ((1, "02"), (2, "03"), (3, "01")):
            store.add(entry(number, utc=f"2026-05-{day}T00:00:00.000Z"))
        store.add(entry(4, "uid B"))
        assert [store.service(aircraft, 0, "new motors")["after"] for aircraft in "AB"] == [2, 4]


def test_a_assessment_is_replaced_and_nothing_else(url):
    with Store(url) as store:
        store.add(entry(1))
        store.assess_again(entry(1, "uid Z", path="/other", verdict="fault", version="9", diagnosis={"verdict": "fault"}))
        (found,) = store.flights()
        assert (found["verdict"], found["version"], found["path"], found["aircraft_name"]) == ("fault", "9", "/logs/1.bin", "A")
        with pytest.raises(StoreError, match="no flight"):
            store.assess_again(entry(2))


def test_what_breaks_off_leaves_nothing(url, monkeypatch):
    with Store(url) as store:
        store.add(entry(1))
        before = tables(store)
        monkeypatch.setattr(module, "_json", lambda value: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            store.add(entry(2, "uid B"))
        monkeypatch.undo()
        assert tables(store) == before
        assert store.add(entry(2, "uid B"))
        assert [f["ordinal"] for f in store.flights()] == [2, 1]


def test_texts_that_no_database_keeps(url):
    with Store(url) as store:
        store.add(entry(1, name="a\0b\udcff.bin", diagnosis={"headline": "x\0y"}))
        found = store.flight(entry(1).hash)
        assert found is not None and found["name"] == "ab\\udcff.bin" and found["diagnosis"] == {"headline": "x\0y"}


def test_an_older_store_is_brought_up_to_date(url, monkeypatch):
    from rotorwatch.fleet import tables as t

    steps = t.STEPS
    monkeypatch.setattr(t, "STEPS", steps[:1])
    with Store(url) as old:
        old.add(entry(1))
        with pytest.raises(StoreError):
            old.set_standings({}, {}, 1)  # has no such table
    monkeypatch.setattr(t, "STEPS", steps)
    with Store(url) as new:
        assert new.count() == 1
        key = new.aircraft()[0]["key"]
        new.set_standings({key: {"rotors": []}}, {key: {"hours": [1.0]}}, 1)
        assert new.standing(key) == {"rotors": []} and new.points(key) == {"hours": [1.0]} and not new.aircraft()[0]["stale"]
    monkeypatch.setattr(t, "STEPS", steps[:1])
    with pytest.raises(StoreError, match="update rotorwatch"):
        Store(url)


def test_a_step_that_fails_changes_nothing(url, monkeypatch):
    from rotorwatch.fleet import tables as t

    steps = t.STEPS
    monkeypatch.setattr(t, "STEPS", steps[:1])
    with Store(url) as old:
        old.add(entry(1))
    monkeypatch.setattr(t, "STEPS", (*steps, lambda connection: 1 / 0))
    with pytest.raises(ZeroDivisionError):
        Store(url)
    monkeypatch.setattr(t, "STEPS", steps)
    with Store(url) as new:
        assert new.count() == 1


@pytest.mark.parametrize(
    ("given", "says"),
    [("mysql://host/db", "not a store"), ("", "empty name"), ("postgresql://rw@127.0.0.1:9/none?connect_timeout=1", "cannot be reached")],
)
def test_addresses_that_are_no_stores(given, says):
    with pytest.raises((ConfigError, StoreError), match=says) as why:
        Store(given)
    assert "\n" not in str(why.value)


def test_files_that_are_no_stores(tmp_path):
    (tmp_path / "text").write_text("This is no database at all, but a text of some length." * 100)
    for given, says in ((tmp_path, "folder"), (tmp_path / "text", "not a store")):
        with pytest.raises((ConfigError, StoreError), match=says):
            Store(given)
    with pytest.raises(StoreError, match="fleet add"):
        Store(tmp_path / "new.db", make=False)


def test_the_password_is_never_said():
    with pytest.raises(StoreError) as why:
        Store("postgresql://rw:geheim@127.0.0.1:9/none")
    assert "geheim" not in str(why.value)


def test_where_the_store_lies(monkeypatch, tmp_path):
    monkeypatch.setenv("ROTORWATCH_STORE", "here.db")
    assert default_url() == "here.db"
    monkeypatch.delenv("ROTORWATCH_STORE")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr("sys.platform", "linux")
    assert default_url() == str(tmp_path / "rotorwatch" / "fleet.db")


def test_exports_are_plain(url):
    with Store(url) as store:
        store.add(entry(1))
        assert json.dumps(tables(store))


def test_a_flight_is_kept_as_it_was_diagnosed():
    """A diagnosis made elsewhere is taken as it is, its doubts with it: nothing is assessed twice."""
    flight = logs.read(SAMPLES / "quadx_healthy_hover.bin.xz")
    found = diagnose(flight)
    assert flight_result.of_flight(flight, "h", "p", 1, found=found) == flight_result.of_flight(flight, "h", "p", 1)
    doubted = flight_result.of_flight(flight, "h", "p", 1, found=replace(found, doubts=("Another vehicle flew.", "So it seems.")))
    assert doubted.trim["doubt"] == "Another vehicle flew."
