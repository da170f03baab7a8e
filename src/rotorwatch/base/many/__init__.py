"""A function over many items: in this process, in processes of this computer, or on a Dask cluster.

spread.py         `run`, `in_order`, `ordered`: the interface; they choose between the three
result_cache.py   values of finished items in a folder, to resume an interrupted call
done.py           the result of an item, and errors that can be sent between processes
processes.py      processes of this computer, by the standard library alone
limited.py        a job on untrusted files: processes with limits of time and memory
cluster.py        the workers of a Dask scheduler (the extra `cluster`)
"""

from rotorwatch.base.many.done import Done
from rotorwatch.base.many.spread import in_order, ordered, processors, run, useful_jobs

__all__ = ["Done", "in_order", "ordered", "processors", "run", "useful_jobs"]
