"""What explains the trim of a whole flight, and what is told of it: losses that grew slowly or only seemed to end, mounts that turned.

blocks.py (ticks -> blocks of time), stretch.py (what is looked at), fit.py (one ratio of the noises), weighing.py (each explanation, a
slice at a time), told.py (growth, mounts, joined with the losses), trim.py (all of it, tick by tick), many.py (many ticks in one call).
"""
