"""Published methods on real flights, evaluated like the default method.

log_plant.py        a flight's ticks as a plant and its table
published.py        a method of the literature over them, with the decisions that all methods share
own.py              the raw output of a method, step by step
helicopter_log.py   the same for a helicopter's log
paper_log.py        a method on the plant of its own paper
decide.py           when an estimate means a fault
origin.py           what a method is and where it comes from
conformal.py        intervals that hold, by factors from flights of known truth
observability.py    observability of the losses, of any plant
"""
