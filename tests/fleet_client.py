"""A client of a store that says on standard output what it has added, or with `delete` as second argument deleted; run as a program with
the store's URL, and killed in tests. It goes on by one flight for each byte on standard input, so that none is through before it is killed.
"""

from __future__ import annotations

import sys

from rotorwatch.fleet import Entry, Store

FLIGHTS = 60


def entry(k: int) -> Entry:
    """A fabricated flight of one of seven aircraft."""
    return Entry(
        hash=f"{k:064x}", path=f"/logs/{k}", name=f"{k}.bin", size=k, identity=f"serial {k % 7}", called=f"quad {k % 7}",
        utc=f"2026-01-01T10:{k:02d}:00.000Z", frame="quad X", rotors=4, verdict="healthy", headline="Nothing.", version="1",
        diagnosis={"text": "x" * 2000}, trim={"wrench": [0.1 * k, 1 / 3]},
    )  # fmt: skip


def fill(store: Store, say: bool = False) -> None:
    """Add all flights."""
    for k in range(FLIGHTS):
        if store.add(entry(k)) and say:
            print(k, flush=True)
            may_go_on()


def may_go_on() -> None:
    """Wait for a byte on standard input."""
    if not sys.stdin.buffer.read(1):
        sys.exit()


def empty(store: Store) -> None:
    """Delete all flights, the oldest first."""
    for row in store.flights("date", limit=None):
        store.delete(row["hash"])
        print(row["name"], flush=True)
        may_go_on()


if __name__ == "__main__":
    with Store(sys.argv[1]) as store:
        empty(store) if sys.argv[2:] == ["delete"] else fill(store, say=True)
