"""The tables of a store, and the numbered steps by which an older store becomes one of today.

Nothing in them hangs on the time of the day, on chance or on a counter of the database: the same logs added in the same order make the
same rows, however often the work was broken off in between. Texts that can be missing are empty, so that both databases sort them alike.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from rotorwatch.errors import StoreError

metadata = sa.MetaData()

meta = sa.Table(
    "meta", metadata, sa.Column("key", sa.Text, primary_key=True), sa.Column("value", sa.Text, nullable=False)
)

aircraft = sa.Table(
    "aircraft",
    metadata,
    # key: made of what it is told apart by. name: what people call it; they may change it.
    sa.Column("key", sa.Text, primary_key=True),
    sa.Column("name", sa.Text, nullable=False, unique=True),
    sa.Column("ordinal", sa.Integer, nullable=False),
)

# By what a log is known to be of an aircraft: serial number, board and calibration, or a name. Several may stand for one aircraft.
identities = sa.Table(
    "identities",
    metadata,
    sa.Column("identity", sa.Text, primary_key=True),
    sa.Column("aircraft", sa.Text, sa.ForeignKey("aircraft.key"), nullable=False, index=True),
)

flights = sa.Table(
    "flights",
    metadata,
    # hash: SHA-256 of the log's bytes. ordinal: which flight of the store it is, in the order in which they were added.
    sa.Column("hash", sa.Text, primary_key=True),
    sa.Column("ordinal", sa.Integer, nullable=False, unique=True),
    sa.Column("path", sa.Text, nullable=False),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("aircraft", sa.Text, sa.ForeignKey("aircraft.key")),
    sa.Column("identity", sa.Text, nullable=False),
    # utc: of second 0, ISO 8601, or empty. clock_us: the log's own clock then. count: the autopilot's number of the flight, or null.
    sa.Column("utc", sa.Text, nullable=False),
    sa.Column("clock_us", sa.BigInteger, nullable=False),
    sa.Column("count", sa.BigInteger),
    sa.Column("duration_s", sa.Float, nullable=False),
    sa.Column("airborne_s", sa.Float, nullable=False),
    sa.Column("autopilot", sa.Text, nullable=False),
    sa.Column("firmware", sa.Text, nullable=False),
    sa.Column("frame", sa.Text, nullable=False),
    sa.Column("rotors", sa.Integer, nullable=False),
    sa.Column("build", sa.Text, nullable=False),
    sa.Column("verdict", sa.Text, nullable=False),
    sa.Column("headline", sa.Text, nullable=False),
    sa.Column("version", sa.Text, nullable=False),
    # What a search looks through, in lower case.
    sa.Column("words", sa.Text, nullable=False),
    # With airborne_s, so that sums over an aircraft read the index alone.
    sa.Index("flights_of_aircraft", "aircraft", "utc", "ordinal", "airborne_s"),
    sa.Index("flights_in_time", "utc", "ordinal"),
    sa.Index("flights_verdicts", "aircraft", "verdict"),
)

# Large texts lie apart: a list of flights never reads them.
diagnoses = sa.Table(
    "diagnoses",
    metadata,
    sa.Column("hash", sa.Text, sa.ForeignKey("flights.hash"), primary_key=True),
    sa.Column("diagnosis", sa.Text, nullable=False),
)
trims = sa.Table(
    "trims",
    metadata,
    sa.Column("hash", sa.Text, sa.ForeignKey("flights.hash"), primary_key=True),
    sa.Column("trim", sa.Text, nullable=False),
)

# Maintenance: rotor 0 is the whole aircraft. It was before the flights from `utc` on; without a time, after flight number `after`.
services = sa.Table(
    "services",
    metadata,
    sa.Column("aircraft", sa.Text, sa.ForeignKey("aircraft.key"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True),
    sa.Column("rotor", sa.Integer, nullable=False),
    sa.Column("what", sa.Text, nullable=False),
    sa.Column("utc", sa.Text, nullable=False),
    sa.Column("after", sa.Integer, nullable=False),
)

# What all flights together say of an aircraft, as it was last worked out. seen: how many flights and services the store held then.
# points: what a picture needs of every flight; it lies apart because it is long.
standings = sa.Table(
    "standings",
    metadata,
    sa.Column("aircraft", sa.Text, sa.ForeignKey("aircraft.key"), primary_key=True),
    sa.Column("seen", sa.Integer, nullable=False),
    sa.Column("standing", sa.Text, nullable=False),
    sa.Column("points", sa.Text, nullable=False),
)


def _first(connection: Any) -> None:
    metadata.create_all(
        connection, tables=[meta, aircraft, identities, flights, diagnoses, trims, services], checkfirst=False
    )


def _standings(connection: Any) -> None:
    metadata.create_all(connection, tables=[standings], checkfirst=False)


STEPS = (_first, _standings)
"""Step k makes version k + 1 of version k. Steps are never changed once stores were made with them."""


def upgrade(connection: Any) -> None:
    """Bring a store, new or old, to today's version, inside the caller's transaction. Raises StoreError for one of a later rotorwatch."""
    version = 0
    if sa.inspect(connection).has_table("meta"):
        found = connection.execute(sa.select(meta.c.value).where(meta.c.key == "version")).scalar()
        if not str(found or 0).isdecimal():
            raise StoreError(
                "The store is damaged (table meta, version): put a copy back, or add the logs to a new one."
            )
        version = int(found or 0)
    if version > len(STEPS):
        raise StoreError(
            f"The store was made by a later version of rotorwatch (tables {version}, known {len(STEPS)}); update rotorwatch."
        )
    for step in STEPS[version:]:
        step(connection)
    if version < len(STEPS):
        connection.execute(meta.delete().where(meta.c.key == "version"))
        connection.execute(meta.insert().values(key="version", value=str(len(STEPS))))
