"""Slow changes in the trim over a whole flight: losses that grew slowly or only seemed to end, mounts that turned. One definition for
logs, links and flight controllers (docs/one-definition.md).

drift_sizes.py  capacities
time_blocks.py  ticks -> blocks of time
stretch.py      the blocks that are evaluated
fit.py          their likelihood for one noise ratio
weighing.py     evidence of each explanation, computed in slices
outcome.py      growth and mounts, merged with the losses
trim.py         the whole analysis, tick by tick
many.py         many ticks in one call
"""
