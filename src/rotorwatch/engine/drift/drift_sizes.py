"""Capacities of the trim analysis, on computers and on board."""

BLOCKS = 80  # blocks of time; when a flight exceeds them, they are joined in pairs
RISE_KINDS = 8  # durations of a change, from its beginning to its end
ONSETS = 20  # onsets tried for each
COURSES = 160
RATIOS = 8  # ratios of the two noises
AMOUNTS_EACH = 40  # amounts of a drift, in each direction
AMOUNTS_TURNED = 26  # those of them larger than wind or a load cause in yaw
LOSSES_EACH = 33  # sizes of a loss
COLUMNS = 17  # a drift, and each rotor
STEADY = 4  # manoeuvres on three axes, and a level
ROWS = 7  # these, and the data on three axes
