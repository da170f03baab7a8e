"""Messages hold no passwords, odd addresses are one sentence, and a damaged store is said to be damaged."""

import sqlite3

import pytest

from rotorwatch.base.files import public
from rotorwatch.fleet.store import Entry, Store
from test_cli import run  # noqa: F401

SECRET = "s3cr3t"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("postgresql://u:s3cr3t@host/db is busy", "postgresql://host/db is busy"),
        ("https://s3cr3t@host/x.bin: nothing is there", "https://host/x.bin: nothing is there"),
        ("http://u:a@s3cr3t@host/x", "http://host/x"),
        ("https://host/x.bin?token=s3cr3t&a=b: nothing", "https://host/x.bin?...: nothing"),
        ("s3://bucket/a@b.bin", "s3://bucket/a@b.bin"),
        ("no address, a@b", "no address, a@b"),
    ],
)
def test_what_only_its_owner_may_know_is_not_shown(text, shown):
    assert public(text) == shown


ODD = [
    ("fleet", "list", "--store", "postgresql://u:s3cr3t@127.0.0.1:abc/db"),
    ("fleet", "list", "--store", "postgresql://u:s3 s3cr3t@[::1/db"),
    ("fleet", "list", "--store", "mysql://u:s3cr3t@h/db"),
    ("fleet", "list", "--store", "postgresql://u:a@s3cr3t@127.0.0.1:1/db"),
    ("fleet", "list", "--store", "postgresql:/u:s3cr3t@h/db"),
    ("fleet", "list", "--store", "~nobody-of-that-name/fleet.db"),
    ("diagnose", "http://u:s3cr3t@[::1/x.bin"),
    ("diagnose", "http://u:s3cr3t@127.0.0.1:1/x.bin?key=s3cr3t"),
    ("watch", "udp:1", "--webhook", "http://u:s3cr3t@127.0.0.1:abc/x"),
    ("watch", "udp:1", "--webhook", "ftp://u:s3cr3t@x"),
    ("watch", "udp:1", "--webhook", "http://[::1"),
    ("watch", "udp:1", "--mqtt", "mqtt://u:s3cr3t@127.0.0.1:abc/x"),
    ("watch", "udp:1", "--mqtt", "http://u:s3cr3t@127.0.0.1/x"),
    ("watch", "udp:14599", "--metrics", "x..y:1"),
    ("watch", "tcp:a..b:5"),
    ("watch", "udpin:" + 300 * "a" + ":1"),
    ("serve", "--host", "a..b", "--token", 20 * "a"),
]


@pytest.mark.parametrize("words", ODD)
def test_odd_addresses_are_one_sentence_without_passwords(run, words):  # noqa: F811
    code, out, err = run(*words)
    assert code == 2 and err.startswith("rotorwatch: ") and SECRET not in out + err
    assert "rotorwatch itself" not in err


@pytest.fixture
def store(tmp_path):
    """A store of one flight."""
    place = tmp_path / "fleet.db"
    reported = {"flight": {}, "verdict": "healthy", "reason": "", "rotors": [], "events": []}
    with Store(place) as made:
        made.add(Entry(64 * "0", "", "a.bin", 1, identity="serial 1", airborne_s=60.0, duration_s=60.0, rotors=4, diagnosis=reported))
    return place


@pytest.mark.parametrize(
    ("change", "commands", "where"),
    [
        ("UPDATE flights SET airborne_s = 'x'", ("assess", "reassess"), "table flights, row 000000000000, airborne_s"),
        ("UPDATE flights SET rotors = 'y'", ("assess",), "table flights, row 000000000000, rotors"),
        ("UPDATE trims SET trim = '{'", ("assess",), "table trims, row 000000000000, trim"),
        ("UPDATE standings SET standing = 'nope'", ("list",), "table standings"),
        ("UPDATE standings SET standing = '{}'", ("show",), "table standings"),
        ("UPDATE meta SET value = 'x'", ("list", "assess"), "table meta, version"),
    ],
)
def test_a_damaged_store_is_said_to_be_damaged(run, store, change, commands, where):  # noqa: F811
    assert run("fleet", "assess", "--store", store, "-q")[0] == 0
    with sqlite3.connect(store) as base:
        base.execute(change)
    for command in commands:
        words = ("fleet", command, *(("serial 1",) if command == "show" else ()), "--store", store)
        code, _, err = run(*words)
        assert code == 2 and "is damaged" in err and where in err, (command, err)


def test_an_error_of_ours_is_not_the_stores(store):
    with pytest.raises(KeyError), Store(store):
        {}["x"]
