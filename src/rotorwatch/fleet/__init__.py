"""A store that remembers flights, whose they are, and what all of them together say of every aircraft and rotor.

judge.py            a log judged: what the store keeps of it
summary.py          what a list shows of an answer
tables.py           the tables, and how an older store becomes one of today
address.py          where the store lies
database.py         SQLite or PostgreSQL: its transactions, and its errors as sentences
listing.py          which flights a list shows, and in which order
reports.py          the reports of flights, which go with them
damage.py           which row of a store is damaged, when work on it has failed
store.py            what is kept of flights and aircraft: everything that is written or read goes through here
add.py              logs into the store, once or as they come; its flights judged again
scatter.py          how much healthy flights differ
explain.py          what changed in an aircraft: wear, damage, shifted weights, each with its evidence
prognosis.py        when a rotor that wears reaches a limit
false_discovery.py  which rotors of a whole fleet are named
condition.py        whether an aircraft may fly, by its rotors and its flights
assess.py           all of that together: where every aircraft stands
compare.py          two flights next to each other
pages.py            where every aircraft stands, as pages
export.py           the store as Parquet files
"""

from rotorwatch.fleet.address import default_url
from rotorwatch.fleet.store import Entry, Store

__all__ = ["Entry", "Store", "default_url"]
