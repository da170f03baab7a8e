"""The tables of a store, and the numbered steps that upgrade an older store.

Nothing in them depends on the time of day, on chance or on a counter of the database: the same logs added in the same order make the same
rows, however often the work was interrupted. Texts that can be missing are empty, so that both databases sort them alike.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa

from rotorwatch.errors import StoreError
from rotorwatch.fleet import summary

SOME = 500  # diagnoses read at once
metadata = sa.MetaData()


def _column(name: str, kind: Any = sa.Text, *, nullable: bool = False, **more: Any) -> sa.Column:
    return sa.Column(name, kind, nullable=nullable, **more)


def _of(table: str, key: str, name: str, **more: Any) -> sa.Column:
    """A column that names a row of another table."""
    return sa.Column(name, sa.Text, sa.ForeignKey(f"{table}.{key}"), **more)


meta = sa.Table("meta", metadata, _column("key", primary_key=True), _column("value"))

aircraft = sa.Table(
    "aircraft",
    metadata,
    # key: derived from its identity. name: for users, who may change it.
    _column("key", primary_key=True),
    _column("name", unique=True),
    _column("ordinal", sa.Integer),
)

# Identity of a log's aircraft: serial number, board and calibration, or a name. An aircraft may have several.
identities = sa.Table(
    "identities", metadata, _column("identity", primary_key=True), _of("aircraft", "key", "aircraft", nullable=False, index=True)
)

flights = sa.Table(
    "flights",
    metadata,
    # hash: SHA-256 of the log's bytes. ordinal: number of the flight in the store, in order of addition.
    _column("hash", primary_key=True),
    _column("ordinal", sa.Integer, unique=True),
    _column("path"),
    _column("name"),
    _column("size", sa.BigInteger),
    _of("aircraft", "key", "aircraft"),
    _column("identity"),
    # utc: of second 0, ISO 8601, or empty. clock_us: the log's own clock then. count: the autopilot's number of the flight, or null.
    _column("utc"),
    _column("clock_us", sa.BigInteger),
    _column("count", sa.BigInteger, nullable=True),
    _column("duration_s", sa.Float),
    _column("airborne_s", sa.Float),
    _column("autopilot"),
    _column("firmware"),
    _column("frame"),
    _column("rotors", sa.Integer),
    # words: text for searches, in lower case.
    *(_column(name) for name in ("build", "verdict", "headline", "version", "words")),
    # loss: the worst of the answer, 0 for none. onset_s: of its main event, or null. Both are in the diagnosis, too.
    _column("loss", sa.Float, server_default="0"),
    _column("onset_s", sa.Float, nullable=True),
    # With airborne_s, so that sums over an aircraft read the index alone.
    sa.Index("flights_of_aircraft", "aircraft", "utc", "ordinal", "airborne_s"),
    sa.Index("flights_in_time", "utc", "ordinal"),
    sa.Index("flights_verdicts", "aircraft", "verdict"),
)

# For sorted lists.
SORTED = tuple(
    sa.Index(f"flights_by_{name}", by, flights.c.utc, flights.c.ordinal)
    for name, by in (
        ("loss", flights.c.loss),
        ("duration", flights.c.duration_s),
        ("name", sa.func.lower(flights.c.name)),
        ("gravity", sa.text(f"({summary.GRAVITY.format(verdict='verdict')})")),
    )
)

# Large texts are separate: a list of flights never reads them.
diagnoses = sa.Table("diagnoses", metadata, _of("flights", "hash", "hash", primary_key=True), _column("diagnosis"))
trims = sa.Table("trims", metadata, _of("flights", "hash", "hash", primary_key=True), _column("trim"))

# Maintenance: rotor 0 is the whole aircraft. It was before the flights from `utc` on; without a time, after flight number `after`.
services = sa.Table(
    "services",
    metadata,
    _of("aircraft", "key", "aircraft", primary_key=True),
    _column("number", sa.Integer, primary_key=True),
    _column("rotor", sa.Integer),
    _column("what"),
    _column("utc"),
    _column("after", sa.Integer),
)

# The last computed standing of an aircraft. seen: number of flights and services in the store then.
# points: plot data of every flight, separate because of its length.
standings = sa.Table(
    "standings",
    metadata,
    _of("aircraft", "key", "aircraft", primary_key=True),
    _column("seen", sa.Integer),
    _column("standing"),
    _column("points"),
)

# Files that could not be assessed. given: the version that tried, and its settings; why: the sentence.
refused = sa.Table("refused", metadata, _column("hash", primary_key=True), *(_column(name) for name in ("path", "given", "why")))


def _add(*tables: sa.Table) -> Callable[[Any], None]:
    """A step that adds tables."""
    return lambda connection: metadata.create_all(connection, tables=tables, checkfirst=False)


def _add_losses(connection: Any) -> None:
    """The columns loss and onset_s of flights, computed from the diagnoses, and the indexes for sorting; a new store has them already."""
    if any(column["name"] == "loss" for column in sa.inspect(connection).get_columns("flights")):
        return
    connection.exec_driver_sql("ALTER TABLE flights ADD COLUMN loss FLOAT DEFAULT 0 NOT NULL")
    connection.exec_driver_sql("ALTER TABLE flights ADD COLUMN onset_s FLOAT")
    some = sa.select(diagnoses).order_by(diagnoses.c.hash).limit(SOME)
    into = sa.update(flights).where(flights.c.hash == sa.bindparam("of"))
    last = ""
    while rows := connection.execute(some.where(diagnoses.c.hash > last)).all():
        updates = [{"of": hash} | _worked_out(text) for hash, text in rows]
        connection.execute(into, updates)
        last = rows[-1][0]
    for index in SORTED:
        index.create(connection)


def _rank_again(connection: Any) -> None:
    """Rebuild the index by severity, whose expression ranks the verdicts, after more were added."""
    gravity = next(index for index in SORTED if index.name == "flights_by_gravity")
    connection.exec_driver_sql(f"DROP INDEX IF EXISTS {gravity.name}")
    gravity.create(connection)


def _remember_refused(connection: Any) -> None:
    """Add the table of refused files. Standings contain more since then, and must be computed again."""
    metadata.create_all(connection, tables=[refused])
    connection.execute(sa.update(standings).values(seen=-1))


def _worked_out(text: str) -> dict[str, Any]:
    try:
        answer = json.loads(text)
        return {"loss": summary.worst_loss(answer), "onset_s": summary.onset(answer)}
    except (ValueError, TypeError, AttributeError):  # a damaged row, reported on reading
        return {"loss": 0.0, "onset_s": None}


STEPS = (
    _add(meta, aircraft, identities, flights, diagnoses, trims, services),
    _add(standings),
    _add_losses,
    _rank_again,
    _remember_refused,
)
"""Step k makes version k + 1 of version k. Steps are never changed once stores were made with them."""


def version(connection: Any) -> int:
    """Version of a store's tables: 0 where it has none. Raises StoreError for one of a later rotorwatch."""
    if not sa.inspect(connection).has_table("meta"):
        return 0
    stored = connection.execute(sa.select(meta.c.value).where(meta.c.key == "version")).scalar()
    if not str(stored or 0).isdecimal():
        raise StoreError("The store is damaged (table meta, version): restore a backup, or add the logs to a new one.")
    if int(stored or 0) > len(STEPS):
        raise StoreError(f"The store was made by a later version of rotorwatch (tables {stored}, known {len(STEPS)}); update rotorwatch.")
    return int(stored or 0)


def upgrade(connection: Any) -> None:
    """Upgrade a store, new or old, to the current version, inside the caller's transaction. Raises StoreError for one of a later
    rotorwatch."""
    before = version(connection)
    for step in STEPS[before:]:
        step(connection)
    if before < len(STEPS):
        connection.execute(meta.delete().where(meta.c.key == "version"))
        connection.execute(meta.insert().values(key="version", value=str(len(STEPS))))
