"""A store that remembers flights, whose they are, and what all of them together say of every aircraft and rotor.

identity.py         whose flight it is
judge.py            a log judged: what the store keeps of it
tables.py           the tables, and how an older store becomes one of today
store.py            SQLite or PostgreSQL: everything that is written or read goes through here
add.py              logs into the store, and flights judged again
scatter.py          how much healthy flights of an aircraft differ
explain.py          wear, damage and shifted weights: what changed, when, how sure
prognosis.py        when a loss will reach a limit
false_discovery.py  which rotors are named, so that few of them are named wrongly
assess.py           all that, of every aircraft and rotor
pages.py            a fleet as pages
export.py           the store as Parquet files
synthetic.py        a simulated fleet with its truth
score.py            how well the standings agree with it
"""

from rotorwatch.fleet.store import Entry, Store, default_url

__all__ = ["Entry", "Store", "default_url"]
