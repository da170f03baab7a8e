"""Slow changes in the trim of a whole flight: losses that grew slowly or only seemed to end, mounts that turned. One definition for logs,
links and flight controllers (docs/one-definition.md).

drift_sizes.py  capacities
time_blocks.py  ticks -> blocks of time
stretch.py      the blocks that are evaluated
fit.py          their likelihood with one ratio of the noises
weighing.py     each explanation, a slice at a time
outcome.py      growth and mounts, joined with the losses
trim.py         all of it, tick by tick
many.py         many ticks in one call
"""
