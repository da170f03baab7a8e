"""Filters and orders of lists of flights. They have the same names in Python, on the command line and in the addresses of the page, and all
become SQL: a store of any size is never read as a whole."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import Any

from rotorwatch.answer.wording import VERDICTS
from rotorwatch.base.choices import meant
from rotorwatch.base.files import one_line
from rotorwatch.errors import ConfigError, NotInStore
from rotorwatch.fleet.summary import GRAVITY

# Sort orders of a list; f: flights, a: aircraft.
ORDERS = {
    "date": "f.utc",
    "verdict": GRAVITY.format(verdict="f.verdict"),
    "loss": "f.loss",
    "duration": "f.duration_s",
    "aircraft": "a.name IS NULL, lower(a.name)",
    "name": "lower(f.name)",
}
NEWEST = "-date"
DAYS = {"today": 0, "yesterday": 1}


@dataclass(frozen=True)
class Filters:
    """Filters of a list; by default all flights match.

    search: words that must all be found in name, path, headline, verdict, frame, firmware or the aircraft's name. verdict: one of VERDICTS,
    or several with commas between. aircraft: its name, key or serial number. since, until: start of the log, in UTC as 2026-05-01 or
    2026-05-01T14:30, that day or minute included; flights without a time are left out. min_loss: of the worst loss, 0 to 1; min_duration:
    of the log [s]. Numbers may be texts."""

    search: str = ""
    verdict: str = ""
    aircraft: str | None = None
    since: str = ""
    until: str = ""
    min_loss: float | str = 0.0
    min_duration: float | str = 0.0


def condition(db: Any, wanted: Filters) -> tuple[str, dict[str, Any]]:
    """The condition for rows of flights f with aircraft a, and its parameters. Raises ConfigError for an invalid value, NotInStore for an
    unknown aircraft."""
    where, given = of_aircraft(db, wanted.aircraft or None)
    parts = [where]

    def add(part: str, **more: Any) -> None:
        parts.append(part)
        given.update(more)

    for k, word in enumerate(text(wanted.search).lower().split()):
        like = "%" + re.sub("([/%_])", r"/\1", word) + "%"
        add(f"(f.words LIKE :word{k} ESCAPE '/' OR lower(a.name) LIKE :word{k} ESCAPE '/')", **{f"word{k}": like})
    if verdicts := dict.fromkeys(filter(None, re.split(r"[\s,]+", wanted.verdict.lower()))):
        if unknown := [one for one in verdicts if one not in VERDICTS]:
            raise ConfigError(f"verdict {_quoted(unknown[0])}{meant(unknown[0], VERDICTS)}: choose from {', '.join(VERDICTS)}.")
        names = {f"verdict{k}": one for k, one in enumerate(verdicts)}
        add(f"f.verdict IN ({', '.join(f':{name}' for name in names)})", **names)
    if wanted.since:
        add("f.utc >= :since", since=moment("since", wanted.since)[0])
    if wanted.until:
        add("f.utc <> '' AND f.utc < :until", until=moment("until", wanted.until)[1])
    if loss := _number("min_loss", wanted.min_loss, 1.0, "a share from 0 to 1, such as 0.1 for 10 %"):
        add("f.loss >= :min_loss", min_loss=loss)
    if duration := _number("min_duration", wanted.min_duration, 1e9, "seconds, such as 60"):
        add("f.duration_s >= :min_duration", min_duration=duration)
    return " AND ".join(parts), given


def order(sort: str) -> str:
    """The SQL of an order by one of ORDERS; - before the name: the largest, most severe or newest first. Ties follow by their dates in the
    same direction, of one name or aircraft the newest first; flights without an aircraft come last. Raises ConfigError."""
    name, falls = sort.removeprefix("-"), sort.startswith("-")
    if name not in ORDERS:
        known = f"{meant(name, ORDERS)}: choose from {', '.join(ORDERS)}"
        raise ConfigError(f"sort {_quoted(sort)}{known}; a leading - reverses the order.")
    way = " DESC" if falls else ""
    if name in ("aircraft", "name"):
        return f"{ORDERS[name]}{way}, f.utc DESC, f.ordinal DESC"
    return f"{ORDERS[name]}{way}, f.utc{way}, f.ordinal{way}"


def of_aircraft(db: Any, aircraft: str | None) -> tuple[str, dict[str, Any]]:
    """The condition on table f for rows of an aircraft, or of all, and its parameters. Raises NotInStore."""
    return ("1 = 1", {}) if aircraft is None else ("f.aircraft = :key", {"key": find(db, aircraft)["key"]})


def find(db: Any, aircraft: str) -> dict[str, Any]:
    """key and name of an aircraft by key, name or identity. Raises NotInStore with similar names."""
    wanted = text(aircraft)
    of_identity = "key IN (SELECT aircraft FROM identities WHERE identity = :wanted)"
    for where in ("key = :wanted", "name = :wanted", of_identity, "lower(name) = :low"):
        given = {"low": wanted.lower()} if ":low" in where else {"wanted": wanted}
        rows = db.rows(f"SELECT key, name FROM aircraft WHERE {where}", **given).all()
        if len(rows) == 1:
            return dict(rows[0])
    names = [row["name"] for row in db.rows("SELECT name FROM aircraft")]
    near = difflib.get_close_matches(wanted, names, 3, 0.4)
    hint = f"; did you mean {' or '.join(near)}?" if near else "; `rotorwatch fleet list` names them."
    raise NotInStore(f"The store has no aircraft {_quoted(wanted)}{hint}")


def moment(name: str, given: str) -> tuple[str, str]:
    """Begin of the day, minute or second that a text denotes, and of the next one, in the store's form; also of `today` and `yesterday`, in
    UTC. name: of the setting, for the error. Raises ConfigError."""
    if (past := DAYS.get(given.strip().lower())) is not None:
        given = (datetime.now(timezone.utc).date() - timedelta(days=past)).isoformat()
    try:
        first = datetime.fromisoformat(given.strip().replace("Z", "+00:00"))
        first = first.replace(tzinfo=timezone.utc) if first.tzinfo is None else first.astimezone(timezone.utc)
        day, fine = len(given.strip()) <= 10, bool(first.second or first.microsecond)
        end = first + (timedelta(days=1) if day else timedelta(seconds=1) if fine else timedelta(minutes=1))
    except (ValueError, OverflowError):
        example = "give a day or time such as 2026-05-01, 2026-05-01T14:30 or yesterday"
        raise ConfigError(f"{name} {_quoted(given)}: {example}.") from None
    return _kept(first), _kept(end)


def text(given: str) -> str:
    """The text without zero bytes and undecodable bytes, which no database stores."""
    return str(given).replace("\0", "").encode("utf-8", "backslashreplace").decode()


def in_order(rows: Iterable[Mapping]) -> list:
    """Flights of an aircraft: by time where all have one, else by the autopilot's count, else in order of addition; one without a time
    keeps its place of addition among those that have one."""
    rows, last, timed = sorted(rows, key=lambda r: r["ordinal"]), "", []
    if not any(r["utc"] for r in rows) and all(r["count"] is not None for r in rows):
        return sorted(rows, key=lambda r: (r["count"], r["clock_us"]))
    for r in rows:
        last = r["utc"] or last
        timed.append((last, r))
    return [r for _, r in sorted(timed, key=lambda x: x[0])]


def _kept(time: datetime) -> str:
    return time.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _number(name: str, given: float | str, most: float, what: str) -> float:
    try:
        value = float(given or 0.0)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= most:
        raise ConfigError(f"{name} {_quoted(str(given))}: give {what}.")
    return value


def _quoted(given: str) -> str:
    return one_line(given, 40)
