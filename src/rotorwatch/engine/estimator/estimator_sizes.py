"""How many rotors the estimator has room for on a computer, and what follows from that; a flight controller has its own numbers."""

from rotorwatch.engine.intake import sizes as front

ROTORS, PAIRS, HYPOTHESES, PLACES = front.ROTORS, front.PAIRS, front.HYPOTHESES, front.PLACES
PLANT_STATES = 23
STATES = PLANT_STATES + front.ROTORS  # ... and the loss of each rotor
PRODUCTS = STATES * (STATES + 1) // 2  # of two states
DIRECTIONS = 6 + front.ROTORS  # in which a jump may go: steps of the axes, errors of the model, losses
CROSSES = DIRECTIONS * (DIRECTIONS + 1) // 2  # of two directions
SLOTS = 48  # onset times that are looked at
RING = 64  # ticks whose residuals are kept
