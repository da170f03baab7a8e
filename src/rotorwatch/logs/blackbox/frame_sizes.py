"""Sizes of the arrays in the definition of Blackbox frames."""

FIELDS = 256
"""Fields of a frame; INAV's main frames have some 150."""
CYCLE = 4096
"""Loops of the controller between two I frames."""
WIDTH = 5
"""Numbers of an event: main frames before it, kind, time, and two of its own."""
PADDING = 4096
"""Zeros after the last byte: more than the longest frame takes, so that none is read beyond."""
