"""The list of flights of a store, in SQLite and in a real PostgreSQL: filters, orders, deletion, and what an older store gets."""

import hashlib
import json
import os
from itertools import product

import pytest

from rotorwatch.errors import ConfigError, NotInStore, StoreError
from rotorwatch.fleet import Entry, Store, summary
from rotorwatch.fleet.database import Queries
from rotorwatch.fleet.listing import ORDERS

pytest.importorskip("sqlalchemy")


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))  # where the reports of a database lie
    if request.param == "sqlite":
        return str(tmp_path / "fleet.db")
    return request.getfixturevalue("server").url()


def reported(verdict="healthy", loss=0.0, onset=None):
    """An answer with one event, or none."""
    events = [] if onset is None else [{"kind": "loss_of_effectiveness", "rotors": [3], "loss": [loss], "onset_s": onset}]
    return {"verdict": verdict, "events": events, "main_event": None if onset is None else 0, "rotors": []}


def entry(name: str, aircraft="", utc=None, verdict="healthy", loss=0.0, onset=None, duration=60.0, **more) -> Entry:
    return Entry(
        hash=hashlib.sha256(name.encode()).hexdigest(), path=f"/logs/{name}", name=name, size=1, identity=aircraft and f"uid {aircraft}",
        called=aircraft, utc=utc, verdict=verdict, duration_s=duration, diagnosis=reported(verdict, loss, onset), rotors=4, **more,
    )  # fmt: skip


FLIGHTS = (
    entry("a", "Quad B", "2026-05-01T00:00:00Z", "healthy", duration=50.0),
    entry("b", "quad a", "2026-05-01T23:59:59.900Z", "fault", 0.37, 34.2, duration=400.0),
    entry("c", "quad a", "2026-05-02T00:00:00.000Z", "ambiguous", 0.12, 9.0, duration=30.0),
    entry("d", "", None, "fault", 0.8, 2.0, duration=10.0),
    entry("e", "Quad B", "2026-04-30T14:30:30.000Z", "inconclusive", duration=0.0),
    entry("f_%", "Quad B", "2026-05-03T12:00:00.000Z", "fault", duration=100.0),
)


@pytest.fixture
def store(url):
    with Store(url) as store:
        for one in FLIGHTS:
            assert store.add(one)
        yield store


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def listed(request, tmp_path_factory):
    """The same, for tests that only read."""
    lite = request.param == "sqlite"
    url = tmp_path_factory.mktemp("listed") / "fleet.db" if lite else request.getfixturevalue("server").url()
    with Store(url) as store:
        for one in FLIGHTS:
            store.add(one)
        yield store


def names(store, **asked):
    """The names of the flights that are found; `count` finds as many."""
    found = "".join(f["name"][0] for f in store.flights(**asked))
    assert store.count(**{k: v for k, v in asked.items() if k not in ("sort", "limit", "offset")}) >= len(found)
    return found


@pytest.mark.parametrize(
    ("sort", "wanted"),
    [
        ("-date", "fcbaed"),
        ("date", "deabcf"),
        ("-verdict", "fbdcea"),
        ("verdict", "aecdbf"),
        ("-loss", "dbcfae"),
        ("loss", "eafcbd"),
        ("-duration", "bfacde"),
        ("aircraft", "cbfaed"),
        ("-aircraft", "faecbd"),
        ("name", "abcdef"),
    ],
)
def test_flights_are_sorted(listed, sort, wanted):
    assert names(listed, sort=sort) == wanted
    assert names(listed, sort=sort, limit=2, offset=1) == wanted[1:3], "pages are cut after sorting"


@pytest.mark.parametrize(
    ("filters", "wanted"),
    [
        ({}, "fcbaed"),
        ({"verdict": "fault"}, "fbd"),
        ({"verdict": "fault, ambiguous"}, "fcbd"),
        ({"aircraft": "QUAD A"}, "cb"),
        ({"aircraft": "uid Quad B"}, "fae"),
        ({"aircraft": ""}, "fcbaed"),
        ({"since": "2026-05-01"}, "fcba"),
        ({"until": "2026-05-01"}, "bae"),
        ({"since": "2026-05-01", "until": "2026-05-01"}, "ba"),
        ({"since": "2026-05-01T02:00+02:00", "until": "2026-05-01T00:00Z"}, "a"),
        ({"until": "2026-04-30T14:30"}, "e"),
        ({"until": "2026-04-30T14:30:29"}, ""),
        ({"min_loss": 0.12}, "cbd"),
        ({"min_loss": "0.121"}, "bd"),
        ({"min_duration": 50}, "fba"),
        ({"search": "%"}, "f"),
        ({"search": "_"}, "f"),
        ({"search": "/"}, "fcbaed"),
        ({"search": "fault quad"}, "fb"),
        ({"verdict": "fault", "aircraft": "quad a", "since": "2026-05-01", "min_loss": 0.3, "search": "b"}, "b"),
    ],
)
def test_flights_are_filtered(listed, filters, wanted):
    assert names(listed, **filters) == wanted and listed.count(**filters) == len(wanted)


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"sort": "size"}, "sort size: choose from date, verdict, loss"),
        ({"sort": "f.utc; DROP TABLE flights"}, "choose from"),
        ({"sort": "--date"}, "choose from"),
        ({"sort": ""}, "choose from"),
        ({"verdict": "fault,broken"}, "verdict broken: choose from healthy"),
        ({"since": "last week"}, "since last week: give a day"),
        ({"until": "9999-12-31"}, "until 9999-12-31: give a day"),
        ({"until": "2026-13-01"}, "give a day"),
        ({"min_loss": "10"}, "0.1 for 10 %"),
        ({"min_loss": "nan"}, "0.1 for 10 %"),
        ({"min_loss": -0.1}, "0.1 for 10 %"),
        ({"min_duration": "1 min"}, "seconds, such as 60"),
        ({"verdict": "\x1b[2J" + "x" * 500}, "choose from"),
    ],
)
def test_what_cannot_be_asked_is_one_sentence(listed, asked, says):
    with pytest.raises(ConfigError) as why:
        listed.flights(**asked)
    text = str(why.value)
    assert says in text and text.endswith(".") and len(text) < 200 and text.isprintable()
    assert listed.count() == len(FLIGHTS)


def test_an_aircraft_that_is_not_known_is_not_in_the_store(listed):
    with pytest.raises(NotInStore, match="did you mean quad a"):
        listed.flights(aircraft="quad aa")
    assert [(a["name"], a["flights"]) for a in listed.aircraft_names()] == [("quad a", 2), ("Quad B", 3)]


def test_all_filters_and_orders_go_together(listed):
    given = {"search": "quad", "verdict": "fault", "aircraft": "Quad B", "since": "2026-01-01", "until": "2026-12-31"}
    for way, name in product(("", "-"), ORDERS):
        assert names(listed, sort=way + name, min_loss=0.0, min_duration=60, **given) == "f"


# Deletion


def plain(store):
    return {table: list(store.rows(table)) for table in store._t.metadata.tables if table != "standings"}


def put_report(store, hash, text="a report"):
    store.reports.folder.mkdir(parents=True, exist_ok=True)
    store.reports.path(hash).write_text(text)


def left(store):
    return sorted(path.name for path in store.reports.folder.iterdir())


def test_a_deleted_flight_leaves_nothing(url):
    with Store(url) as store:
        for one in FLIGHTS[:-1]:
            store.add(one)
        before = plain(store)
        last = FLIGHTS[-1]
        store.add(entry("g", "seldom"))
        put_report(store, entry("g").hash)
        put_report(store, last.hash)
        assert store.delete(entry("g").hash[:8])["name"] == "g"
        assert plain(store) == before, "its aircraft had no other flight"
        assert left(store) == [f"{last.hash}.html"], "the reports of others stay"
        with pytest.raises(NotInStore, match="has no flight"):
            store.delete(entry("g").hash)
        for odd in ("", "%", "../" * 20, "0" * 64, "\0"):
            with pytest.raises(NotInStore):
                store.delete(odd)
        assert plain(store) == before
        assert store.add(entry("g", "seldom")), "it can be added again"


def test_an_aircraft_stays_that_people_have_said_something_of(store):
    store.service("quad a", 1, "new propeller")
    store.delete(FLIGHTS[1].hash)
    store.delete(FLIGHTS[2].hash)
    assert store.find("quad a") and len(store.services("quad a")) == 1
    store.add(entry("x", "x"))
    store.merge("x", "Quad B")
    for one in (FLIGHTS[0], FLIGHTS[4], FLIGHTS[5], entry("x")):
        store.delete(one.hash)
    assert store.find("x")["name"] == "x", "two identities were said to be one"


def test_standings_are_out_of_date_after_a_deletion(store):
    key = store.find("quad a")["key"]
    store.set_standings({key: {"rotors": []}}, {}, store.state())
    store.delete(FLIGHTS[0].hash)
    store.add(entry("new", "quad a"))  # as many flights as before
    assert all(a["stale"] for a in store.aircraft())


def test_a_service_stays_before_the_flights_that_come_after_it(store):
    store.service("quad a", 1, "new propeller")
    store.delete(FLIGHTS[-1].hash)
    store.add(entry("new", "quad a"))
    assert store.flight(entry("new").hash)["ordinal"] > store.services("quad a")[0]["after"]


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_killed_deletion_leaves_all_or_nothing(store, monkeypatch, when):
    """Killed before the rows go, or when they have gone."""
    hash = FLIGHTS[1].hash
    put_report(store, hash)

    class Killed(BaseException):
        pass

    def killed(*_):
        raise Killed

    run = Queries.run

    def dying(db, sql, **given):
        if "DELETE FROM flights" in sql:
            raise Killed
        return run(db, sql, **given)

    with monkeypatch.context() as patch:
        patch.setattr(store.reports, "_settle", lambda aside: None)
        if when == "before":
            patch.setattr(Queries, "run", dying)
            with pytest.raises(Killed):
                store.delete(hash)
        else:
            store.delete(hash)
    assert left(store) == [f"{hash}.deleted"]
    store.reports.settle()
    if when == "before":
        assert store.flight(hash)["diagnosis"] and store.reports.path(hash).read_text() == "a report"
    else:
        assert not store.has(hash) and left(store) == []
    assert store.has(FLIGHTS[0].hash)


def test_another_process_that_tidies_up_meanwhile_brings_nothing_back(store, monkeypatch):
    """A server starts on the same store after the report was set aside, before the rows are gone."""
    hash, run = FLIGHTS[1].hash, Queries.run
    put_report(store, hash)

    def tidied(db, sql, **given):
        if "DELETE FROM flights" in sql:
            store.reports.settle()
            assert left(store) == [f"{hash}.html"]
        return run(db, sql, **given)

    monkeypatch.setattr(Queries, "run", tidied)
    store.delete(hash)
    assert left(store) == [] and not store.has(hash)


def test_a_report_that_was_made_again_is_kept(store):
    hash = FLIGHTS[1].hash
    put_report(store, hash, "new")
    aside = store.reports.path(hash).with_suffix(".deleted")
    aside.write_text("old")
    store.reports.settle()
    assert store.reports.path(hash).read_text() == "new" and not aside.exists()


def test_a_report_that_cannot_be_removed_keeps_its_flight(store, monkeypatch):
    put_report(store, FLIGHTS[1].hash)

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(StoreError, match="cannot be removed"):
            store.delete(FLIGHTS[1].hash)
    assert store.has(FLIGHTS[1].hash)


# What a list shows of an answer


@pytest.mark.parametrize(
    ("diagnosis", "loss", "onset"),
    [
        (reported("fault", 0.37, 34.2), 0.37, 34.2),
        ({"events": [{"loss": [0.2, 0.5], "onset_s": 1}, {"loss": None}], "main_event": 0}, 0.5, 1.0),
        ({"rotors": [{"status": "failed", "loss": 0.9}, {"status": "healthy", "loss": 1.0}]}, 0.9, None),
        ({"events": [{"loss": [None, "x", float("nan"), 7.0]}], "main_event": 5}, 1.0, None),
        ({"events": None, "rotors": "x", "main_event": "0"}, 0.0, None),
        ({}, 0.0, None),
    ],
)
def test_the_worst_loss_of_an_answer(diagnosis, loss, onset):
    assert (summary.worst_loss(diagnosis), summary.onset(diagnosis)) == (loss, onset)


def test_an_older_store_gets_losses(url, monkeypatch):
    """A store as version 2 made it: without the columns and their indexes; one row of it is damaged."""
    with Store(url) as store:
        for one in FLIGHTS:
            store.add(one)
        wanted = plain(store)
        with store._database.writing() as db:
            for index in ("loss", "duration", "name", "gravity"):
                db.run(f"DROP INDEX flights_by_{index}")
            for column in ("loss", "onset_s"):
                db.run(f"ALTER TABLE flights DROP COLUMN {column}")
            db.run("UPDATE meta SET value = '2'")
    from rotorwatch.fleet import tables

    monkeypatch.setattr(tables, "SOME", 2)
    with Store(url) as store:
        assert plain(store) == wanted and names(store, sort="-loss") == "dbcfae"
        with store._database.reading() as db:
            assert json.loads(db.value("SELECT value FROM meta WHERE key = 'version'")) == len(tables.STEPS)
    with Store(url) as store, store._database.writing() as db:
        db.run("UPDATE diagnoses SET diagnosis = '{' WHERE hash = :hash", hash=FLIGHTS[1].hash)
        tables._add_losses(db.connection)  # a second time: nothing to do
        assert tables._worked_out("{") == {"loss": 0.0, "onset_s": None}
