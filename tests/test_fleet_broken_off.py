"""What breaks off in the middle: a killed client, a full disk, a database that goes away. The tables end up as if nothing had happened."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fleet_client import FLIGHTS, entry, fill
from rotorwatch.errors import StoreError
from rotorwatch.fleet import Store

sa = pytest.importorskip("sqlalchemy")
KILLS = 3
CLIENT = Path(__file__).parent / "fleet_client.py"


def tables(url: str) -> dict:
    with Store(url) as store:
        return {name: list(store.rows(name)) for name in store._t.metadata.tables}


@pytest.fixture(params=["sqlite", "postgresql"])
def urls(request, tmp_path):
    if request.param == "sqlite":
        return str(tmp_path / "one.db"), str(tmp_path / "two.db")
    server = request.getfixturevalue("server")
    return server.url(), server.url()


def begin_and_kill(chance, *words):
    """A client that works on a store, killed after some lines of its output, with one flight more at most."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    client = subprocess.Popen([sys.executable, CLIENT, *words], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert client.stdin is not None and client.stdout is not None
    lines = chance.randint(3, 18)
    client.stdin.write(bytes(lines))
    client.stdin.flush()
    for _ in range(lines):
        client.stdout.readline()
    time.sleep(chance.uniform(0.0, 0.01))
    client.send_signal(signal.SIGKILL)
    client.wait()
    client.stdin.close()
    client.stdout.close()


@pytest.mark.skipif(os.name != "posix", reason="kills by signal")
def test_killed_at_random_moments(urls):
    whole, killed = urls
    with Store(whole) as store:
        fill(store)
    chance = random.Random(5)
    counts = []
    for _ in range(KILLS):
        begin_and_kill(chance, killed)
        with Store(killed) as store:
            counts.append(store.count())
    assert 0 < counts[0] < counts[1] < counts[2] < FLIGHTS
    with Store(killed) as store:
        fill(store)
    assert tables(killed) == tables(whole)


@pytest.mark.skipif(os.name != "posix", reason="kills by signal")
def test_a_deletion_killed_at_random_moments(urls, tmp_path, monkeypatch):
    """Of every flight row and report are there, or neither is."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))  # where the reports of a database lie
    url, chance = urls[0], random.Random(7)
    with Store(url) as store:
        fill(store)
        store.reports.folder.mkdir(parents=True)
        for row in store.flights(limit=None):
            store.reports.path(row["hash"]).write_text("a report")
    counts = [FLIGHTS]
    for _ in range(KILLS):
        begin_and_kill(chance, url, "delete")
        with Store(url) as store:
            rows = {row["hash"] for row in store.flights(limit=None)}
            assert {path.name for path in store.reports.folder.iterdir()} == {f"{hash}.html" for hash in rows}
            assert all(store.flight(hash) for hash in rows), "diagnosis and trim are there"
            assert len(list(store.rows("diagnoses"))) == len(list(store.rows("trims"))) == len(rows)
            counts.append(len(rows))
    assert counts == sorted(counts, reverse=True) and 0 < counts[-1] < FLIGHTS


def test_a_full_disk(tmp_path):
    url = str(tmp_path / "full.db")
    with Store(url) as store:
        store.add(entry(0))

        @sa.event.listens_for(store._database.engine, "begin")
        def full(connection):
            pages = connection.exec_driver_sql("PRAGMA page_count").scalar()
            connection.exec_driver_sql(f"PRAGMA max_page_count = {pages}")

        with pytest.raises(StoreError, match=r"disk of the store .* full.*run the same command again") as why:
            fill(store)
        assert "\n" not in str(why.value)
        done = store.count()
        assert 0 < done < FLIGHTS
        sa.event.remove(store._database.engine, "begin", full)
        with store._database.engine.connect() as connection:
            connection.exec_driver_sql("PRAGMA max_page_count = 1073741823")
    with Store(url) as store:
        fill(store)
    with Store(tmp_path / "whole.db") as store:
        fill(store)
    assert tables(url) == tables(str(tmp_path / "whole.db"))


def test_a_database_that_goes_away(server):
    whole, url = server.url(), server.url()
    with Store(whole) as store:
        fill(store)
    with Store(url) as store:
        for k in range(20):
            store.add(entry(k))
        server.stop(signal.SIGQUIT)  # as in a crash
        with pytest.raises(StoreError, match="cannot be reached") as why:
            store.add(entry(20))
        assert "\n" not in str(why.value)
        server.start()
        fill(store)
    assert tables(url) == tables(whole)


def test_the_report_of_a_deletion_that_was_killed_goes_when_the_store_is_opened(tmp_path):
    """Whoever opens it: the flight is gone, and its report must not stay until a page is served."""
    url = tmp_path / "fleet.db"
    with Store(url) as store:
        store.add(entry(0))
        store.add(entry(1))
        store.reports.folder.mkdir()
        gone, there = (store.reports.path(entry(k).hash) for k in range(2))
        for page in (gone, there):
            page.write_text("a report")
        store.reports._settle = lambda aside: None  # as when killed after the commit
        store.delete(entry(0).hash)
        os.replace(there, there.with_suffix(".deleted"))  # as when killed before it
    assert gone.with_suffix(".deleted").exists()
    with Store(url, make=False):
        assert list(there.parent.iterdir()) == [there]


def test_who_reads_waits_for_no_writer_and_needs_no_right_to_write(tmp_path, monkeypatch):
    from rotorwatch.fleet import database as module

    folder = tmp_path / "store"
    with Store(folder / "fleet.db") as store:
        store.add(entry(1))
        monkeypatch.setattr(module, "WAIT_S", 0.05)
        with store._database.writing(), Store(folder / "fleet.db") as other:
            assert other.count() == 1
    if os.name != "posix" or os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    (folder / "fleet.db").chmod(0o444)
    folder.chmod(0o555)
    try:
        with Store(folder / "fleet.db") as store:
            assert store.count() == 1
            with pytest.raises(StoreError, match="cannot be written to"):
                store.add(entry(2))
    finally:
        folder.chmod(0o755)


def test_another_writer_is_waited_for_and_then_named(tmp_path, monkeypatch):
    from rotorwatch.fleet import database as module

    monkeypatch.setattr(module, "WAIT_S", 0.05)
    with Store(tmp_path / "busy.db") as one, Store(tmp_path / "busy.db") as other, one._database.writing():
        with pytest.raises(StoreError, match="busy"):
            other.add(entry(1))
