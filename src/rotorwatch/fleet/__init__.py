"""A store that remembers flights, whose they are, and what all of them together say of every aircraft and rotor.

tables.py     the tables, and how an older store becomes one of today
store.py      SQLite or PostgreSQL: everything that is written or read goes through here
"""

from rotorwatch.fleet.store import Entry, Store, default_url

__all__ = ["Entry", "Store", "default_url"]
