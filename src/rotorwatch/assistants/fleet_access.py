"""The fleet's store as short answers, in the types of models.py. It is only read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rotorwatch.assistants import answers
from rotorwatch.assistants.quoted import label, quoted, utc
from rotorwatch.errors import ConfigError, StoreError
from rotorwatch.fleet.store import Store
from rotorwatch.flight.diagnosis import Diagnosis

MOST, MOST_ROTORS = 30, 3  # rows of an answer; rotors of an aircraft
NONE = "No fleet store: start the server with --store, as written by `rotorwatch fleet add`."


class Fleet:
    """The store of that address; "" for none. It is opened for each question."""

    def __init__(self, url: str):
        self._url = url

    @contextmanager
    def _open(self) -> Iterator[Store]:
        if not self._url:
            raise ConfigError(NONE)
        with Store(self._url, make=False) as store:
            yield store

    def aircraft(self, search: str, limit: int) -> dict[str, Any]:
        """`Fleet` of models.py. search: words that name, key, frame or state contain."""
        from rotorwatch.fleet import condition

        with self._open() as store:
            aircraft = condition.by_urgency(store.aircraft())
        words = search.lower().split()
        aircraft = [a for a in aircraft if all(word in _text(a) for word in words)]
        rows = [_aircraft(a) for a in aircraft[: min(limit, MOST)]]
        return {"total": len(aircraft), "aircraft": rows, "note": _left(len(aircraft) - len(rows), "aircraft")}

    def flights(self, sort: str, aircraft: str | None, limit: int, offset: int, **filters: Any) -> dict[str, Any]:
        """`Flights` of models.py. sort: one of listing.ORDERS; filters: other fields of listing.Filters."""
        with self._open() as store:
            filters["aircraft"] = self._key(store, aircraft)
            rows = store.flights(sort, limit=min(limit, MOST), offset=offset, **filters)
            total = store.count(**filters)
        left = total - offset - len(rows)
        return {"total": total, "flights": [_flight(row) for row in rows], "note": _left(left, "flights")}

    def flight(self, flight: str) -> tuple[Diagnosis, str]:
        """(the stored diagnosis of a flight, the name of its log). flight: its hash, or at least the first 6 digits."""
        with self._open() as store:
            row = store.flight(flight.lower())
        if row is None:
            raise ConfigError("flight: the store holds no flight, or several, with such a hash; `fleet_flights` lists them.")
        return Diagnosis.from_dict(row["diagnosis"]), row["name"]

    @staticmethod
    def _key(store: Store, aircraft: str | None) -> str | None:
        if aircraft is None:
            return None
        try:
            return store.find(aircraft)["key"]
        except StoreError:  # its sentence contains foreign names
            raise ConfigError("aircraft: no such name or key in the store; `fleet` lists them.") from None


def _left(count: int, what: str) -> str | None:
    return f"{count} more {what}; search for words, or give a larger limit (at most {MOST}) or an offset." if count > 0 else None


def _text(a: Mapping) -> str:
    states = [r["status"] for r in (a["standing"] or {}).get("rotors", ())]
    return " ".join(map(str, (a["name"], a["key"], a["frame"], a["state"], *a["identities"], *states))).lower()


def _aircraft(a: Mapping) -> dict[str, Any]:
    from rotorwatch.fleet.condition import URGENT

    standing = a["standing"] or {}
    unwell = [r for r in standing.get("rotors", ()) if r["status"] in URGENT]
    unwell.sort(key=lambda r: (URGENT[r["status"]], -r["loss"]))
    return {
        "key": a["key"],
        "name": quoted(a["name"], 60),
        "frame": label(a["frame"]),
        "flights": a["flights"],
        "airborne_h": round(a["airborne_s"] / 3600.0, 1),
        "last_utc": utc(a["last"]),
        "state": a["state"],
        "last_verdict": (standing.get("last") or {}).get("verdict"),
        "verdicts": a["verdicts"],
        "new": a["new"],
        "headline": answers.cut(standing.get("headline", "Not assessed yet: run `rotorwatch fleet assess`."), 300),
        "out_of_date": bool(a["stale"]),
        "rotors": [_rotor(r) for r in unwell[:MOST_ROTORS]],
        "rotors_left_out": len(unwell[MOST_ROTORS:]),
    }


def _rotor(r: Mapping) -> dict[str, Any]:
    outlook = r.get("prognosis") or {}
    return {name: r[name] for name in ("rotor", "status", "loss", "interval")} | {
        "outlook": outlook.get("word"),
        "hours_left": outlook.get("hours_left"),
    }


def _flight(row: Mapping) -> dict[str, Any]:
    return {
        "flight": row["hash"][:12],
        "log": quoted(row["name"], 60),
        "aircraft": quoted(row["aircraft_name"], 60) if row["aircraft_name"] else None,
        "utc": utc(row["utc"]),
        "verdict": row["verdict"],
        "headline": answers.cut(row["headline"], 200),
        "frame": label(row["frame"]),
        "duration_s": round(row["duration_s"], 1),
    }
