"""How much the look at the trim has room for, on board as well."""

BLOCKS = 80  # of time; a flight that outgrows them has them joined in pairs
RISE_KINDS = 8  # that a course may take from its beginning to its end
ONSETS = 20  # that are tried for each
COURSES = 160
RATIOS = 8  # of the two noises
AMOUNTS_EACH = 40  # of a drift, to each side
AMOUNTS_TURNED = 26  # of these, so many are more than wind or a load turn
LOSSES_EACH = 33  # sizes of a loss
COLUMNS = 17  # a drift, and each rotor
STEADY = 4  # manoeuvres on three axes, and a level
ROWS = 7  # these, and what is to be explained on three axes
