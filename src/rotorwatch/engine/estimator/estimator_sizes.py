"""Array sizes of the estimator on a computer, derived from its maximum number of rotors; flight controllers use their own."""

from rotorwatch.engine.intake import sizes as front

ROTORS, PAIRS, HYPOTHESES, PLACES = front.ROTORS, front.PAIRS, front.HYPOTHESES, front.PLACES
PLANT_STATES = 22
STATES = PLANT_STATES + front.ROTORS  # plant states and the loss of each rotor
PRODUCTS = STATES * (STATES + 1) // 2  # elements of a covariance matrix's lower triangle
DIRECTIONS = 6 + front.ROTORS  # directions of a jump: steps of the axes, model errors, losses
CROSSES = DIRECTIONS * (DIRECTIONS + 1) // 2  # elements of an information matrix's lower triangle
SLOTS = 48  # onset times in the bank
RING = 64  # ticks whose residuals are kept
