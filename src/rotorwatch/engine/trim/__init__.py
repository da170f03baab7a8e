"""What explains the trim of a whole flight, and what is told of it: losses that grew slowly or only seemed to end, mounts that turned. One
definition for whole logs, for links and for flight controllers (docs/one-definition.md).

blocks.py    ticks -> blocks of time
stretch.py   the blocks that are looked at
fit.py       how likely they are with one ratio of the noises
weighing.py  each explanation, a slice at a time
told.py      growth and mounts, joined with the losses
trim.py      all of it, tick by tick
many.py      many ticks in one call
sizes.py     how much there is room for
"""
