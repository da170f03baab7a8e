"""The store of a fleet: flights, their aircraft, maintenance, and every aircraft's standing. All reads and writes go through here; every
write is one atomic transaction."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rotorwatch.base import optional
from rotorwatch.errors import ConfigError, NotInStore, StoreError
from rotorwatch.fleet import condition, listing, summary
from rotorwatch.fleet.address import data_file
from rotorwatch.fleet.report_files import Reports

SHOWN = (
    "hash", "ordinal", "path", "name", "size", "aircraft", "identity", "utc", "clock_us", "count", "duration_s",
    "airborne_s", "autopilot", "firmware", "frame", "rotors", "build", "verdict", "headline", "version", "loss", "onset_s",
)  # fmt: skip
NOT_OF_ENTRY = ("ordinal", "aircraft", "loss", "onset_s")
COLUMNS = ", ".join(f"f.{name}" for name in SHOWN) + ", a.name AS aircraft_name"
FLIGHTS = "FROM flights f LEFT JOIN aircraft a ON a.key = f.aircraft"
# Frame, rotors, build and firmware are those of the flight that was added last.
AIRCRAFT = """
SELECT a.key, a.name, coalesce(s.flights, 0) AS flights, s.first, s.last, coalesce(s.airborne_s, 0.0) AS airborne_s,
    coalesce(f.frame, '') AS frame, coalesce(f.rotors, 0) AS rotors, coalesce(f.build, '') AS build,
    coalesce(f.firmware, '') AS firmware, t.seen, t.standing
FROM aircraft a
LEFT JOIN (
    SELECT aircraft, count(*) AS flights, min(nullif(utc, '')) AS first, max(utc) AS last, sum(airborne_s) AS airborne_s,
        max(ordinal) AS latest FROM flights GROUP BY aircraft
) s ON s.aircraft = a.key
LEFT JOIN flights f ON f.ordinal = s.latest
LEFT JOIN standings t ON t.aircraft = a.key
ORDER BY a.ordinal
"""
# Whether an aircraft has flights, or entries by users.
NEEDED = """SELECT 1 WHERE EXISTS (SELECT 1 FROM flights WHERE aircraft = :key)
    OR EXISTS (SELECT 1 FROM services WHERE aircraft = :key)
    OR (SELECT count(*) FROM identities WHERE aircraft = :key) > 1"""
FIELDS = (  # of an aircraft
    "key name identities flights first last airborne_s frame rotors build firmware verdicts new state standing stale".split()
)
# After deletions, no new flight gets a number that a service or a view of the list refers to.
LAST = """SELECT max(last) FROM (SELECT coalesce(max(ordinal), 0) AS last FROM flights
    UNION ALL SELECT coalesce(max(after), 0) FROM services
    UNION ALL SELECT coalesce(max(CAST(value AS INTEGER)), 0) FROM meta WHERE key = 'looked') numbers"""
ALL = 1 << 62  # rows: more than there can be


@dataclass(frozen=True)
class Entry:
    """An assessed flight as stored.

    hash: SHA-256 of the log's bytes, hexadecimal. identity: of its aircraft, or "" when unknown; called: the name of a new aircraft. utc:
    of second 0, ISO 8601, or None; clock_us: the log's own clock then; count: the autopilot's number of the flight, or None. build: alike
    for aircraft that can be compared. diagnosis: as `Diagnosis.to_dict`; trim: its hover, or {}."""

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


class Store:
    """An open store; created or upgraded where needed. url: a file name (SQLite), sqlite:///FILE or postgresql://...; None: `default_url`.
    make: whether a missing file is created. Raises StoreError, or ConfigError for an invalid address."""

    def __init__(self, url: str | os.PathLike | None = None, make: bool = True):
        optional.library("sqlalchemy", "A store of flights")
        from rotorwatch.fleet import tables
        from rotorwatch.fleet.database import Database

        self._t = tables
        self._database = Database(url, make)
        self.url, self.label = self._database.url, self._database.label
        self.reports = Reports(Path(self.label) if self.url.startswith("sqlite") else data_file(), self.has)
        with self._database.reading() as db:
            old = tables.version(db.connection) < len(tables.STEPS)
        if old:  # a reader waits for no writer, and needs no write permission
            with self._database.writing() as db:
                tables.upgrade(db.connection)
        self.reports.settle()

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, kind: Any, why: Any, trace: Any) -> None:
        """Raises StoreError where work failed because of damaged content."""
        try:
            if isinstance(why, (ValueError, TypeError, KeyError, AttributeError, IndexError)):
                from rotorwatch.fleet import damage

                with self._database.reading() as db:
                    place = damage.found(db.connection)
                if place:
                    raise StoreError(
                        f"The store {self.label} is damaged ({place}): restore a backup, or add the logs to a new one."
                    ) from why
        finally:
            self.close()

    # Writing

    def add(self, entry: Entry) -> bool:
        """Store a flight, and its aircraft when it is the first of it; False when the same log is there already."""
        with self._database.writing() as db:
            if db.value("SELECT hash FROM flights WHERE hash = :hash", hash=entry.hash):
                return False
            last = db.value(LAST)
            key = _aircraft_of(db, listing.text(entry.identity), entry.called)
            db.insert("flights", ordinal=last + 1, aircraft=key, **_row(entry))
            db.insert("diagnoses", hash=entry.hash, diagnosis=_json(entry.diagnosis))
            db.insert("trims", hash=entry.hash, trim=_json(entry.trim))
        return True

    def assess_again(self, entry: Entry) -> None:
        """Replace the result of a stored flight; its place, its path and its aircraft stay. Raises StoreError when it is not there."""
        row = {k: v for k, v in _row(entry).items() if k not in ("hash", "path", "name", "size", "identity")}
        columns = ", ".join(f"{name} = :{name}" for name in row)
        with self._database.writing() as db:
            if not db.run(f"UPDATE flights SET {columns} WHERE hash = :hash", hash=entry.hash, **row):
                raise NotInStore(f"The store has no flight {entry.hash[:12]}.")
            for table, column, value in (("diagnoses", "diagnosis", entry.diagnosis), ("trims", "trim", entry.trim)):
                db.run(f"UPDATE {table} SET {column} = :text WHERE hash = :hash", text=_json(value), hash=entry.hash)
            db.run("UPDATE standings SET seen = -1")

    def delete(self, hash: str) -> dict:
        """Remove a flight with its report, and its aircraft where that has no other flight, no service and one identity; returns the row.
        hash: as for `flight`. Raises NotInStore when there is none, or several."""
        row = self.flight(hash)
        if row is None:
            raise NotInStore(f"The store has no flight {listing.text(hash)[:64]}, or several with this prefix.")
        with self.reports.removed(row["hash"]), self._database.writing() as db:
            for table in ("diagnoses", "trims", "flights"):
                gone = db.run(f"DELETE FROM {table} WHERE hash = :hash", hash=row["hash"])
            if not gone:
                raise NotInStore(f"The store has no flight {row['hash'][:12]} any more.")
            db.run("UPDATE standings SET seen = -1")
            if row["aircraft"] and not db.value(NEEDED, key=row["aircraft"]):
                for table, column in (("standings", "aircraft"), ("identities", "aircraft"), ("aircraft", "key")):
                    db.run(f"DELETE FROM {table} WHERE {column} = :key", key=row["aircraft"])
        return {name: row[name] for name in (*SHOWN, "aircraft_name")}

    def rename(self, aircraft: str, name: str) -> None:
        """Rename an aircraft. Raises StoreError when it is unknown or the name is taken."""
        name = listing.text(name).strip()
        if not name:
            raise ConfigError("An aircraft needs a non-empty name.")
        with self._database.writing() as db:
            key = listing.find(db, aircraft)["key"]
            if db.value("SELECT key FROM aircraft WHERE name = :name AND key <> :key", name=name, key=key):
                raise StoreError(f"The name {name} is taken; choose another one.")
            db.run("UPDATE aircraft SET name = :name WHERE key = :key", name=name, key=key)

    def service(self, aircraft: str, rotor: int, what: str, utc: str = "", after: int | None = None) -> dict:
        """Add maintenance: rotor 1-based, 0 the whole aircraft. utc: when, ISO 8601; after: the number (`ordinal`) of the last flight
        before it. Without both: after the aircraft's last flight. Returns the row."""
        with self._database.writing() as db:
            aircraft_row = listing.find(db, aircraft)
            rotors = db.value("SELECT max(rotors) FROM flights WHERE aircraft = :key", key=aircraft_row["key"]) or 0
            if not 0 <= rotor <= rotors:
                raise ConfigError(f"{aircraft_row['name']} has rotors 1 to {rotors}, not {rotor}.")
            last = db.value("SELECT max(ordinal) FROM flights") or 0
            if not utc and after is None:
                columns = "ordinal, utc, count, clock_us"
                flights = list(db.rows(f"SELECT {columns} FROM flights WHERE aircraft = :key", key=aircraft_row["key"]))
                last = listing.in_order(flights)[-1]["ordinal"] if flights else last
            row = {
                "aircraft": aircraft_row["key"],
                "number": _services_of(db, aircraft_row["key"]) + 1,
                "rotor": int(rotor),
                "what": listing.text(what),
                "utc": utc,
                "after": int(last if after is None else after),
            }
            db.insert("services", **row)
        return row

    def merge(self, aircraft: str, other: str) -> None:
        """Merge two aircraft: everything of `other` belongs to `aircraft` from now on (an autopilot was exchanged, say)."""
        with self._database.writing() as db:
            keys = {"into": listing.find(db, aircraft)["key"], "old": listing.find(db, other)["key"]}
            if keys["into"] == keys["old"]:
                raise ConfigError(f"{aircraft} and {other} are one aircraft already.")
            last = _services_of(db, keys["into"])
            db.run("UPDATE services SET aircraft = :into, number = number + :last WHERE aircraft = :old", last=last, **keys)
            for table in ("flights", "identities"):
                db.run(f"UPDATE {table} SET aircraft = :into WHERE aircraft = :old", **keys)
            db.run("DELETE FROM standings")
            db.run("DELETE FROM aircraft WHERE key = :old", old=keys["old"])

    def set_standings(self, found: Mapping[str, Mapping], points: Mapping[str, Mapping], seen: int) -> None:
        """Replace the stored standings (key -> plain data). points: data for plots; seen: `state` of the store that they were computed
        from."""
        with self._database.writing() as db:
            db.run("DELETE FROM standings")
            for key, one in sorted(found.items()):
                db.insert("standings", aircraft=key, seen=seen, standing=_json(one), points=_json(points.get(key, {})))

    def look(self) -> None:
        """Note that the list of aircraft was viewed: flights from now on are new at the next view."""
        with self._database.writing() as db:
            last = db.value("SELECT coalesce(max(ordinal), 0) FROM flights")
            db.run("DELETE FROM meta WHERE key = 'looked'")
            db.insert("meta", key="looked", value=str(last))

    def refuse(self, hash: str, path: str, given: str, why: str) -> None:
        """Remember that a file cannot be assessed. given: the settings apart from its bytes; why: the sentence."""
        row = {"hash": hash, "path": path, "given": given, "why": why}
        with self._database.writing() as db:
            db.run("DELETE FROM refused WHERE hash = :hash", hash=hash)
            db.insert("refused", **{k: listing.text(v) for k, v in row.items()})

    # Reading

    def flights(self, sort: str = listing.NEWEST, limit: int | None = 100, offset: int = 0, **filters: Any) -> list[dict]:
        """Flights: the columns of SHOWN and `aircraft_name`. filters: those of `listing.Filters`; sort: as for `listing.order`, by default
        the newest first (those without a time last). Raises ConfigError, and NotInStore for an unknown aircraft."""
        ordered = listing.order(sort)
        part = {"most": ALL if limit is None else int(limit), "first": int(offset)}
        with self._database.reading() as db:
            where, given = listing.condition(db, listing.Filters(**filters))
            # Databases sort flight numbers several times faster than whole rows.
            page = f"SELECT f.ordinal {FLIGHTS} WHERE {where} ORDER BY {ordered} LIMIT :most OFFSET :first"
            ask = f"SELECT {COLUMNS} {FLIGHTS} WHERE f.ordinal IN ({page}) ORDER BY {ordered}"
            return [_plain(row) for row in db.rows(ask, **given, **part)]

    def count(self, **filters: Any) -> int:
        """Number of flights that `flights` would return."""
        with self._database.reading() as db:
            where, given = listing.condition(db, listing.Filters(**filters))
            return int(db.value(f"SELECT count(*) {FLIGHTS} WHERE {where}", **given))

    def flight(self, hash: str) -> dict | None:
        """A flight by its hash (or a unique prefix of at least 6 digits), with `diagnosis` and `trim`; None when there is none."""
        if not re.fullmatch(r"[0-9a-f]{6,64}", hash):
            return None
        ask = f"""SELECT {COLUMNS}, d.diagnosis, t.trim {FLIGHTS} JOIN diagnoses d ON d.hash = f.hash
            JOIN trims t ON t.hash = f.hash WHERE f.hash >= :least AND f.hash <= :most LIMIT 2"""
        with self._database.reading() as db:
            rows = [_plain(row) for row in db.rows(ask, least=hash, most=hash + "g")]
        return rows[0] | {k: json.loads(rows[0][k]) for k in ("diagnosis", "trim")} if len(rows) == 1 else None

    def has(self, hash: str) -> bool:
        """True if a log with these bytes is in the store."""
        with self._database.reading() as db:
            return bool(db.value("SELECT hash FROM flights WHERE hash = :hash", hash=hash))

    def refused(self, hash: str, given: str) -> str:
        """The reason why a file with these bytes could not be assessed with the same settings (`refuse`); empty where unknown."""
        with self._database.reading() as db:
            return db.value("SELECT why FROM refused WHERE hash = :hash AND given = :given", hash=hash, given=given) or ""

    def paths(self) -> set[str]:
        """Paths and addresses of all logs in the store, and of files that could not be assessed."""
        with self._database.reading() as db:
            return {row["path"] for row in db.rows("SELECT path FROM flights UNION SELECT path FROM refused")}

    def aircraft(self) -> list[dict]:
        """All aircraft in order of addition: key, name, identities, flights, first and last utc (or None), frame, rotors, build,
        airborne_s, verdicts (number of each), new (those since the last `look`; none before the first), state (one of `condition.STATES`),
        standing (or None; `stale` when flights came since)."""
        with self._database.reading() as db:
            total = _state(db)
            rows = [dict(row) for row in db.rows(AIRCRAFT)]
            verdicts, new = _verdicts(db, 0), {}
            if looked := db.value("SELECT value FROM meta WHERE key = 'looked'"):
                new = _verdicts(db, int(looked))
            known: dict[str, list[str]] = {}
            for row in db.rows("SELECT identity, aircraft FROM identities ORDER BY identity"):
                known.setdefault(row["aircraft"], []).append(row["identity"])
        for row in rows:
            row |= {"identities": known.get(row["key"], []), "verdicts": verdicts.get(row["key"], {})}
            row["new"] = new.get(row["key"], {})
            row |= {"airborne_s": float(row["airborne_s"]), "last": row["last"] or None}
            row["stale"] = row.pop("seen") != total
            row["standing"] = json.loads(row["standing"]) if row["standing"] else None
            row["state"] = condition.state(row["standing"], row["verdicts"])
        return [{name: row[name] for name in FIELDS} for row in rows]

    def find(self, aircraft: str) -> dict:
        """key and name of an aircraft by key, name or identity. Raises StoreError with similar names."""
        with self._database.reading() as db:
            return listing.find(db, aircraft)

    def aircraft_names(self) -> list[dict]:
        """Every aircraft, in order of names: key, name and number of flights. Faster than `aircraft`, for selection lists."""
        ask = """SELECT a.key, a.name, count(f.aircraft) AS flights FROM aircraft a LEFT JOIN flights f ON f.aircraft = a.key
            GROUP BY a.key, a.name ORDER BY lower(a.name), a.name"""
        with self._database.reading() as db:
            return [dict(row) for row in db.rows(ask)]

    def services(self, aircraft: str | None = None) -> list[dict]:
        """Maintenance in order of addition: aircraft (key), number, rotor (0: all), what, utc or None, after."""
        with self._database.reading() as db:
            where, given = listing.of_aircraft(db, aircraft)
            return [_plain(r) for r in db.rows(f"SELECT * FROM services f WHERE {where} ORDER BY aircraft, number", **given)]

    def trims(self, aircraft: str | None = None) -> Iterator[dict]:
        """Every flight of a known aircraft, in order of addition, with `trim`: the input to histories."""
        columns = "f.hash, f.ordinal, f.aircraft, f.utc, f.clock_us, f.count, f.airborne_s, f.rotors, f.frame, f.build, f.verdict, f.name"
        with self._database.reading() as db:
            where, given = listing.of_aircraft(db, aircraft)
            ask = f"""SELECT {columns}, t.trim FROM flights f JOIN trims t ON t.hash = f.hash
                WHERE f.aircraft IS NOT NULL AND {where} ORDER BY f.ordinal"""
            for row in db.rows(ask, **given):
                yield _plain(row) | {"trim": json.loads(row["trim"])}

    def standing(self, aircraft: str) -> dict | None:
        """The last computed standing of an aircraft; None without one."""
        return self._worked_out(aircraft, "standing")

    def points(self, aircraft: str) -> dict:
        """Plot data of an aircraft's flights (assess.py); empty when nothing was computed."""
        return self._worked_out(aircraft, "points") or {}

    def _worked_out(self, aircraft: str, column: str) -> dict | None:
        with self._database.reading() as db:
            key = listing.find(db, aircraft)["key"]
            text = db.value(f"SELECT {column} FROM standings WHERE aircraft = :key", key=key)
        return json.loads(text) if text else None

    def state(self) -> int:
        """Number of flights and services: standings with another number are out of date."""
        with self._database.reading() as db:
            return _state(db)

    def rows(self, table: str) -> Iterator[dict]:
        """All rows of a table by its name, in order of its primary key, as stored: for exports and comparisons."""
        order = ", ".join(column.name for column in self._t.metadata.tables[table].primary_key.columns)
        with self._database.reading() as db:
            yield from map(dict, db.rows(f"SELECT * FROM {table} ORDER BY {order}"))


def _aircraft_of(db: Any, identity: str, called: str) -> str | None:
    """The key of the aircraft with that identity, created when new; None without one."""
    if not identity:
        return None
    if known := db.value("SELECT aircraft FROM identities WHERE identity = :identity", identity=identity):
        return known
    key = hashlib.sha256(identity.encode()).hexdigest()[:12]
    taken = {row["name"] for row in db.rows("SELECT name FROM aircraft")}
    last = db.value("SELECT max(ordinal) FROM aircraft") or 0
    wanted = name = listing.text(called or identity)
    number = 1
    while name in taken:
        number += 1
        name = f"{wanted} ({number})"
    db.insert("aircraft", key=key, name=name, ordinal=last + 1)
    db.insert("identities", identity=identity, aircraft=key)
    return key


def _verdicts(db: Any, after: int) -> dict[str, dict[str, int]]:
    """Number of flights of each aircraft by verdict, of those with a larger number."""
    counts: dict[str, dict[str, int]] = {}
    where = "WHERE ordinal > :after" if after else ""  # for all flights the index suffices
    ask = f"SELECT aircraft, verdict, count(*) AS many FROM flights {where} GROUP BY aircraft, verdict ORDER BY verdict"
    for row in db.rows(ask, **({"after": after} if after else {})):
        counts.setdefault(row["aircraft"], {})[row["verdict"]] = row["many"]
    return counts


def _services_of(db: Any, key: str) -> int:
    """The number of the last service of an aircraft."""
    return db.value("SELECT max(number) FROM services WHERE aircraft = :key", key=key) or 0


def _state(db: Any) -> int:
    return int(db.value("SELECT (SELECT count(*) FROM flights) + (SELECT count(*) FROM services)"))


def _row(entry: Entry) -> dict:
    """The columns of `flights` except ordinal and aircraft."""
    row: dict[str, Any] = {name: getattr(entry, name) for name in SHOWN if name not in NOT_OF_ENTRY}
    row |= {"loss": summary.worst_loss(entry.diagnosis), "onset_s": summary.onset(entry.diagnosis)}
    row |= {k: listing.text(v) for k, v in row.items() if isinstance(v, str)} | {"utc": entry.utc or ""}
    for kind, names in ((int, ("size", "clock_us", "rotors")), (float, ("duration_s", "airborne_s"))):
        row |= {name: kind(row[name]) for name in names}
    row["count"] = None if entry.count is None else int(entry.count)
    words = (row[k] for k in ("name", "path", "headline", "verdict", "frame", "firmware", "autopilot"))
    return row | {"words": "\n".join(words).lower()}


def _plain(row: Mapping) -> dict:
    return dict(row) | {"utc": row["utc"] or None}


def _json(value: Mapping | Sequence) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))
