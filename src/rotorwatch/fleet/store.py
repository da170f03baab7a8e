"""The store of a fleet: flights, their aircraft, maintenance, and where every aircraft stands. Everything that is written or read goes
through here; every write is one transaction, so it is there whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rotorwatch import optional
from rotorwatch.errors import ConfigError, StoreError

CHUNK = 1 << 20
SHOWN = (
    "hash", "ordinal", "path", "name", "size", "aircraft", "identity", "utc", "clock_us", "count", "duration_s",
    "airborne_s", "autopilot", "firmware", "frame", "rotors", "build", "verdict", "headline", "version",
)  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """A judged flight as it goes into the store.

    hash: SHA-256 of the log's bytes, hexadecimal. identity: what tells its aircraft apart, or "" when nothing does; called: the name that
    an aircraft not known yet gets. utc: of second 0, ISO 8601, or None; clock_us: the log's own clock then; count: the autopilot's number
    of the flight, or None. build: alike for aircraft that can be compared. diagnosis: as `Diagnosis.to_dict`; trim: how it hovered, or {}.
    """

    hash: str
    path: str
    name: str
    size: int
    identity: str = ""
    called: str = ""
    utc: str | None = None
    clock_us: int = 0
    count: int | None = None
    duration_s: float = 0.0
    airborne_s: float = 0.0
    autopilot: str = ""
    firmware: str = ""
    frame: str = ""
    rotors: int = 0
    build: str = ""
    verdict: str = ""
    headline: str = ""
    version: str = ""
    diagnosis: Mapping[str, Any] = field(default_factory=dict)
    trim: Mapping[str, Any] = field(default_factory=dict)


def digest(path: str | os.PathLike) -> str:
    """SHA-256 of a log's bytes, hexadecimal; of a log that is a folder, of its files' names and bytes in order. Raises OSError."""
    found = hashlib.sha256()
    for file in sorted(Path(path).iterdir()) if Path(path).is_dir() else [Path(path)]:
        if Path(path).is_dir():
            found.update(f"{file.name}\n{file.stat().st_size}\n".encode("utf-8", "surrogateescape"))
        with open(file, "rb") as data:
            while block := data.read(CHUNK):
                found.update(block)
    return found.hexdigest()


class Store:
    """A store, opened; made or brought up to date where needed. url: a file name (SQLite), sqlite:///FILE or postgresql://...; None:
    `default_url`. make: whether a file that is not there is made. Raises StoreError, or ConfigError for an address that is none."""

    def __init__(self, url: str | os.PathLike | None = None, make: bool = True):
        self._sa = optional.library("sqlalchemy", "A store of flights")
        from rotorwatch.fleet import tables
        from rotorwatch.fleet.database import Database

        self._t = tables
        self._database = Database(url, make)
        self.url, self.label = self._database.url, self._database.label
        with self._database.writing() as connection:
            tables.upgrade(connection)

    def close(self) -> None:
        """Let go of the database."""
        self._database.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, kind: Any, why: Any, trace: Any) -> None:
        """Raises StoreError where work failed because the store holds what it cannot hold."""
        try:
            if isinstance(why, (ValueError, TypeError, KeyError, AttributeError, IndexError)):
                from rotorwatch.fleet import damage

                with self._database.reading() as connection:
                    place = damage.found(connection)
                if place:
                    raise StoreError(
                        f"The store {self.label} is damaged ({place}): put a copy back, or add the logs to a new one."
                    ) from why
        finally:
            self.close()

    # Writing

    def add(self, entry: Entry) -> bool:
        """Put a flight into the store, and its aircraft when it is the first of it; False when the same log is there already."""
        t, sa = self._t, self._sa
        with self._database.writing() as connection:
            if connection.execute(sa.select(t.flights.c.hash).where(t.flights.c.hash == entry.hash)).first():
                return False
            last = connection.execute(sa.select(sa.func.max(t.flights.c.ordinal))).scalar()
            key = self._aircraft_of(connection, entry.identity, entry.called)
            row = _row(entry)
            connection.execute(t.flights.insert().values(ordinal=(last or 0) + 1, aircraft=key, **row))
            connection.execute(t.diagnoses.insert().values(hash=entry.hash, diagnosis=_json(entry.diagnosis)))
            connection.execute(t.trims.insert().values(hash=entry.hash, trim=_json(entry.trim)))
        return True

    def judge_again(self, entry: Entry) -> None:
        """Replace the judgement of a flight that is there; its place, its path and its aircraft stay. Raises StoreError when it is not."""
        t = self._t
        row = {k: v for k, v in _row(entry).items() if k not in ("hash", "path", "name", "size", "identity")}
        with self._database.writing() as connection:
            done = connection.execute(t.flights.update().where(t.flights.c.hash == entry.hash).values(**row))
            if not done.rowcount:
                raise StoreError(f"The store holds no flight {entry.hash[:12]}.")
            connection.execute(
                t.diagnoses.update().where(t.diagnoses.c.hash == entry.hash).values(diagnosis=_json(entry.diagnosis))
            )
            connection.execute(t.trims.update().where(t.trims.c.hash == entry.hash).values(trim=_json(entry.trim)))
            connection.execute(t.standings.update().values(seen=-1))

    def _aircraft_of(self, connection: Any, identity: str, called: str) -> str | None:
        """The key of the aircraft with that identity, made when it is new; None without one."""
        t, sa = self._t, self._sa
        if not identity:
            return None
        identity = _text(identity)
        known = connection.execute(
            sa.select(t.identities.c.aircraft).where(t.identities.c.identity == identity)
        ).scalar()
        if known:
            return known
        key = hashlib.sha256(identity.encode()).hexdigest()[:12]
        count = connection.execute(sa.select(sa.func.count()).select_from(t.aircraft)).scalar()
        wanted = name = _text(called or identity)
        taken = set(connection.execute(sa.select(t.aircraft.c.name)).scalars())
        number = 1
        while name in taken:
            number += 1
            name = f"{wanted} ({number})"
        connection.execute(t.aircraft.insert().values(key=key, name=name, ordinal=count + 1))
        connection.execute(t.identities.insert().values(identity=identity, aircraft=key))
        return key

    def rename(self, aircraft: str, name: str) -> None:
        """Give an aircraft another name. Raises StoreError when it is not known or the name is another's."""
        t, sa = self._t, self._sa
        name = _text(name).strip()
        if not name:
            raise ConfigError("An aircraft needs a name that is not empty.")
        with self._database.writing() as connection:
            key = self._find(connection, aircraft)["key"]
            other = connection.execute(
                sa.select(t.aircraft.c.key).where(t.aircraft.c.name == name, t.aircraft.c.key != key)
            ).first()
            if other:
                raise StoreError(f"Another aircraft is called {name} already; choose another name.")
            connection.execute(t.aircraft.update().where(t.aircraft.c.key == key).values(name=name))

    def service(self, aircraft: str, rotor: int, what: str, utc: str = "", after: int | None = None) -> dict:
        """Note maintenance: rotor 1-based, 0 the whole aircraft. utc: when, ISO 8601; after: the number (`ordinal`) of the last flight
        before it. Without both: after the last flight in the store. Returns the row."""
        t, sa = self._t, self._sa
        with self._database.writing() as connection:
            found = self._find(connection, aircraft)
            rotors = connection.execute(
                sa.select(sa.func.max(t.flights.c.rotors)).where(t.flights.c.aircraft == found["key"])
            ).scalar()
            if not 0 <= rotor <= (rotors or 0):
                raise ConfigError(f"{found['name']} has rotors 1 to {rotors or 0}, no rotor {rotor}.")
            count = connection.execute(
                sa.select(sa.func.max(t.services.c.number)).where(t.services.c.aircraft == found["key"])
            ).scalar()
            last = connection.execute(sa.select(sa.func.max(t.flights.c.ordinal))).scalar() or 0
            row = {
                "aircraft": found["key"],
                "number": (count or 0) + 1,
                "rotor": int(rotor),
                "what": _text(what),
                "utc": utc,
                "after": int(last if after is None else after),
            }
            connection.execute(t.services.insert().values(**row))
        return row

    def merge(self, aircraft: str, other: str) -> None:
        """Make two aircraft one: what was of `other` is of `aircraft` from now on (an autopilot was exchanged, say)."""
        t, sa = self._t, self._sa
        with self._database.writing() as connection:
            kept, gone = self._find(connection, aircraft)["key"], self._find(connection, other)["key"]
            if kept == gone:
                raise ConfigError(f"{aircraft} and {other} are one aircraft already.")
            for table in (t.flights, t.identities):
                connection.execute(table.update().where(table.c.aircraft == gone).values(aircraft=kept))
            last = connection.execute(
                sa.select(sa.func.max(t.services.c.number)).where(t.services.c.aircraft == kept)
            ).scalar()
            connection.execute(
                t.services.update()
                .where(t.services.c.aircraft == gone)
                .values(aircraft=kept, number=t.services.c.number + (last or 0))
            )
            connection.execute(t.standings.delete())
            connection.execute(t.aircraft.delete().where(t.aircraft.c.key == gone))

    def set_standings(self, found: Mapping[str, Mapping], points: Mapping[str, Mapping], seen: int) -> None:
        """Keep what was worked out of the aircraft (key -> plain data), in place of what was. points: what a picture needs; seen: `state`
        of the store that it was worked out of."""
        t = self._t
        with self._database.writing() as connection:
            connection.execute(t.standings.delete())
            rows = [
                {"aircraft": key, "seen": seen, "standing": _json(one), "points": _json(points.get(key, {}))}
                for key, one in sorted(found.items())
            ]
            if rows:
                connection.execute(t.standings.insert(), rows)

    # Reading

    def flights(
        self,
        search: str = "",
        aircraft: str | None = None,
        limit: int | None = 100,
        offset: int = 0,
        newest_first: bool = True,
    ) -> list[dict]:
        """Flights, the newest first (those without a time last): the columns of SHOWN and `aircraft_name`. search: words that must all be
        found in name, path, headline, verdict, frame, firmware or the aircraft's name. aircraft: its key or name."""
        t, sa = self._t, self._sa
        with self._database.reading() as connection:
            where = self._where(connection, search, aircraft)
            order = (t.flights.c.utc, t.flights.c.ordinal)
            ask = (
                sa.select(*(t.flights.c[name] for name in SHOWN), t.aircraft.c.name.label("aircraft_name"))
                .select_from(t.flights.outerjoin(t.aircraft))
                .where(*where)
                .order_by(*(column.desc() for column in order) if newest_first else order)
            )
            if limit is not None:
                ask = ask.limit(int(limit))
            return [_plain(row) for row in connection.execute(ask.offset(int(offset)))]

    def count(self, search: str = "", aircraft: str | None = None) -> int:
        """How many flights `flights` would find."""
        t, sa = self._t, self._sa
        with self._database.reading() as connection:
            where = self._where(connection, search, aircraft)
            return int(connection.execute(sa.select(sa.func.count()).select_from(t.flights).where(*where)).scalar())

    def flight(self, hash: str) -> dict | None:
        """A flight by its hash (or as much of its start as is unique, at least 6 digits), with `diagnosis` and `trim`; None when there is
        none."""
        t, sa = self._t, self._sa
        if not re.fullmatch(r"[0-9a-f]{6,64}", hash):
            return None
        with self._database.reading() as connection:
            ask = (
                sa.select(
                    *(t.flights.c[name] for name in SHOWN),
                    t.aircraft.c.name.label("aircraft_name"),
                    t.diagnoses.c.diagnosis,
                    t.trims.c.trim,
                )
                .select_from(
                    t.flights.outerjoin(t.aircraft).join(t.diagnoses).join(t.trims, t.trims.c.hash == t.flights.c.hash)
                )
                .where(t.flights.c.hash >= hash, t.flights.c.hash <= hash + "g")
                .limit(2)
            )
            rows = connection.execute(ask).all()
        if len(rows) != 1:
            return None
        found = _plain(rows[0])
        return found | {"diagnosis": json.loads(found["diagnosis"]), "trim": json.loads(found["trim"])}

    def has(self, hash: str) -> bool:
        """Whether a log with these bytes is in the store."""
        t, sa = self._t, self._sa
        with self._database.reading() as connection:
            return bool(connection.execute(sa.select(t.flights.c.hash).where(t.flights.c.hash == hash)).first())

    def paths(self) -> set[str]:
        """Paths and addresses of all logs in the store."""
        t, sa = self._t, self._sa
        with self._database.reading() as connection:
            return set(connection.execute(sa.select(t.flights.c.path)).scalars())

    def aircraft(self) -> list[dict]:
        """All aircraft in the order in which they came: key, name, identities, flights, first and last utc (or None), frame, rotors, build,
        airborne_s, verdicts (how many of each), standing (or None; `stale` when flights came since)."""
        t, sa = self._t, self._sa
        f = t.flights.c
        with self._database.reading() as connection:
            total = self._state(connection)
            rows = connection.execute(
                sa.select(t.aircraft.c.key, t.aircraft.c.name).order_by(t.aircraft.c.ordinal)
            ).all()
            sums = {
                row.aircraft: row
                for row in connection.execute(
                    sa.select(
                        f.aircraft,
                        sa.func.count().label("flights"),
                        sa.func.min(sa.func.nullif(f.utc, "")).label("first"),
                        sa.func.max(f.utc).label("last"),
                        sa.func.sum(f.airborne_s).label("airborne_s"),
                        sa.func.max(f.ordinal).label("latest"),
                    ).group_by(f.aircraft)
                )
            }
            verdicts: dict[str, dict[str, int]] = {}
            for key, verdict, count in connection.execute(
                sa.select(f.aircraft, f.verdict, sa.func.count()).group_by(f.aircraft, f.verdict).order_by(f.verdict)
            ):
                verdicts.setdefault(key, {})[verdict] = count
            latest = [row.latest for row in sums.values()]
            kinds = {
                row.aircraft: row
                for start in range(0, len(latest), 500)
                for row in connection.execute(
                    sa.select(f.aircraft, f.frame, f.rotors, f.build, f.firmware).where(
                        f.ordinal.in_(latest[start : start + 500])
                    )
                )
            }
            known: dict[str, list[str]] = {}
            for identity, key in connection.execute(
                sa.select(t.identities.c.identity, t.identities.c.aircraft).order_by(t.identities.c.identity)
            ):
                known.setdefault(key, []).append(identity)
            ask = sa.select(t.standings.c.aircraft, t.standings.c.seen, t.standings.c.standing)
            standing = {row.aircraft: row for row in connection.execute(ask)}
        found = []
        for key, name in rows:
            one, kind, said = sums.get(key), kinds.get(key), standing.get(key)
            found.append(
                {
                    "key": key,
                    "name": name,
                    "identities": known.get(key, []),
                    "flights": one.flights if one else 0,
                    "first": (one.first or None) if one else None,
                    "last": (one.last or None) if one else None,
                    "airborne_s": float(one.airborne_s) if one else 0.0,
                    "frame": kind.frame if kind else "",
                    "rotors": kind.rotors if kind else 0,
                    "build": kind.build if kind else "",
                    "firmware": kind.firmware if kind else "",
                    "verdicts": verdicts.get(key, {}),
                    "standing": json.loads(said.standing) if said else None,
                    "stale": said is None or said.seen != total,
                }
            )
        return found

    def find(self, aircraft: str) -> dict:
        """key and name of an aircraft by key, name or identity. Raises StoreError with the names that come near."""
        with self._database.reading() as connection:
            return self._find(connection, aircraft)

    def services(self, aircraft: str | None = None) -> list[dict]:
        """Maintenance in the order in which it was noted: aircraft (key), number, rotor (0: all), what, utc or None, after."""
        t, sa = self._t, self._sa
        with self._database.reading() as connection:
            ask = sa.select(t.services).order_by(t.services.c.aircraft, t.services.c.number)
            if aircraft is not None:
                ask = ask.where(t.services.c.aircraft == self._find(connection, aircraft)["key"])
            return [_plain(row) for row in connection.execute(ask)]

    def trims(self, aircraft: str | None = None) -> Iterator[dict]:
        """Every flight of an aircraft that is known, in the order in which they were added, with `trim`: what histories are made of."""
        t, sa = self._t, self._sa
        f = t.flights.c
        with self._database.reading() as connection:
            ask = (
                sa.select(
                    f.hash,
                    f.ordinal,
                    f.aircraft,
                    f.utc,
                    f.clock_us,
                    f.count,
                    f.airborne_s,
                    f.rotors,
                    f.frame,
                    f.build,
                    f.verdict,
                    f.name,
                    t.trims.c.trim,
                )
                .select_from(t.flights.join(t.trims))
                .where(f.aircraft.is_not(None))
                .order_by(f.ordinal)
            )
            if aircraft is not None:
                ask = ask.where(f.aircraft == self._find(connection, aircraft)["key"])
            for row in connection.execute(ask):
                found = _plain(row)
                yield found | {"trim": json.loads(found["trim"])}

    def standing(self, aircraft: str) -> dict | None:
        """What was last worked out of an aircraft; None when nothing was."""
        t, sa = self._t, self._sa
        with self._database.reading() as connection:
            key = self._find(connection, aircraft)["key"]
            text = connection.execute(sa.select(t.standings.c.standing).where(t.standings.c.aircraft == key)).scalar()
        return json.loads(text) if text else None

    def points(self, aircraft: str) -> dict:
        """What a picture of an aircraft needs of every flight (assess.py); empty when nothing was worked out."""
        t, sa = self._t, self._sa
        with self._database.reading() as connection:
            key = self._find(connection, aircraft)["key"]
            text = connection.execute(sa.select(t.standings.c.points).where(t.standings.c.aircraft == key)).scalar()
        return json.loads(text) if text else {}

    def state(self) -> int:
        """How many flights and services there are: standings that saw another number are out of date."""
        with self._database.reading() as connection:
            return self._state(connection)

    def rows(self, table: str) -> Iterator[dict]:
        """All rows of a table by its name, in the order of its primary key, as they are kept: for exports and comparisons."""
        of = self._t.metadata.tables[table]
        with self._database.reading() as connection:
            for row in connection.execute(self._sa.select(of).order_by(*of.primary_key.columns)):
                yield dict(row._mapping)

    # Inside

    def _where(self, connection: Any, search: str, aircraft: str | None) -> list:
        t, sa = self._t, self._sa
        where = []
        if aircraft is not None:
            where.append(t.flights.c.aircraft == self._find(connection, aircraft)["key"])
        for word in _text(search).lower().split():
            named = sa.select(t.aircraft.c.key).where(sa.func.lower(t.aircraft.c.name).contains(word, autoescape=True))
            where.append(t.flights.c.words.contains(word, autoescape=True) | t.flights.c.aircraft.in_(named))
        return where

    def _state(self, connection: Any) -> int:
        t, sa = self._t, self._sa
        ask = (sa.select(sa.func.count()).select_from(table) for table in (t.flights, t.services))
        return sum(int(connection.execute(one).scalar()) for one in ask)

    def _find(self, connection: Any, aircraft: str) -> dict:
        t, sa = self._t, self._sa
        wanted = _text(aircraft)
        by = (
            sa.select(t.aircraft).where(t.aircraft.c.key == wanted),
            sa.select(t.aircraft).where(t.aircraft.c.name == wanted),
            sa.select(t.aircraft).join(t.identities).where(t.identities.c.identity == wanted),
            sa.select(t.aircraft).where(sa.func.lower(t.aircraft.c.name) == wanted.lower()),
        )
        for ask in by:
            rows = connection.execute(ask).all()
            if len(rows) == 1:
                return {"key": rows[0].key, "name": rows[0].name}
        import difflib

        names = list(connection.execute(sa.select(t.aircraft.c.name)).scalars())
        near = difflib.get_close_matches(wanted, names, 3, 0.4)
        hint = f"; did you mean {' or '.join(near)}?" if near else "; `rotorwatch fleet list` names them."
        raise StoreError(f"The store knows no aircraft {wanted}{hint}")


def _row(entry: Entry) -> dict:
    """The columns of `flights` but for ordinal and aircraft."""
    row = {name: getattr(entry, name) for name in SHOWN if name not in ("ordinal", "aircraft")}
    row |= {k: _text(v) for k, v in row.items() if isinstance(v, str)}
    row["utc"] = entry.utc or ""
    row |= {"size": int(entry.size), "clock_us": int(entry.clock_us), "rotors": int(entry.rotors)}
    row |= {"duration_s": float(entry.duration_s), "airborne_s": float(entry.airborne_s)}
    row["count"] = None if entry.count is None else int(entry.count)
    words = (row[k] for k in ("name", "path", "headline", "verdict", "frame", "firmware", "autopilot"))
    return row | {"words": "\n".join(words).lower()}


def _plain(row: Any) -> dict:
    found = dict(row._mapping)
    if "utc" in found:
        found["utc"] = found["utc"] or None
    return found


def _text(text: str) -> str:
    """Without what no database keeps: zero bytes, and bytes of file names that are no text."""
    return str(text).replace("\0", "").encode("utf-8", "backslashreplace").decode()


def _json(value: Mapping | Sequence) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))
