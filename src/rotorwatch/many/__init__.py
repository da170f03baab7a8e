"""One way to do many things: the same function over many items, here, in processes of this computer, or on a Dask cluster.

spread.py         `run`, `in_order`, `ordered`: what everybody calls; they choose between the three
result_cache.py   values of finished items in a folder, for a call that is broken off
done.py           what comes back, and errors that travel
processes.py      processes of this computer, by the standard library alone
cluster.py        the workers of a Dask scheduler (the extra `cluster`)
gathering.py      which logs a call is about: files, folders, patterns, addresses
diagnose_many.py  `diagnose` of every one of them
"""

from rotorwatch.many.done import Done
from rotorwatch.many.spread import in_order, ordered, processors, run, useful_jobs

__all__ = ["Done", "in_order", "ordered", "processors", "run", "useful_jobs"]
