"""A store of flights and their aircraft, and the analysis of every aircraft and rotor over all its flights.

flight_result.py    a log assessed, as a store entry
summary.py          an answer as a line of a list
tables.py           the tables, and the upgrade of older stores
address.py          the store's location
database.py         SQLite or PostgreSQL: transactions, and errors as sentences
listing.py          filters and orders of lists of flights
report_files.py     the reports of flights, kept next to the store
damage.py           the damaged row of a store, when work on it has failed
store.py            flights and aircraft: all reads and writes go through here
add.py              logs into the store, once or as they come; its flights assessed again
scatter.py          scatter of healthy flights
attribution.py      changes of an aircraft: wear, damage, shifted weights, each with its evidence
prognosis.py        time at which a wearing rotor reaches a limit
false_discovery.py  the rotors of a whole fleet that are named
condition.py        whether an aircraft may fly, by its rotors and its flights
assess.py           all of that together: the standing of every aircraft
compare.py          two flights side by side
fleet_pages.py      the standings as pages
publish.py          flights and aircraft on an MQTT broker
csv_export.py       the store as Parquet files
"""

from rotorwatch.fleet.address import default_url
from rotorwatch.fleet.store import Entry, Store

__all__ = ["Entry", "Store", "default_url"]
