"""Capacities for rotors, samples and flights on a computer; rw_config.h has a flight controller's own."""

ROTORS = 16
HALF_SECOND = 4096  # samples of gyro or accelerometer in half a second
FLIGHTS = 256  # ended flights that have not been read
MOTION_SAMPLES = 32768  # samples of gyro or accelerometer: three seconds of the fastest and slowest ticks, 0.9 s of usual ones
LEVELS = 8192  # samples of the attitude: those of the last second and a tick
WAITING = 8  # ticks that may wait for their motion
TICKS_BEFORE = 12  # ticks in half a second
SETTLING = 32  # ticks in the first second of a flight
QUEUE = 160  # ticks that wait until it is certain that the vehicle flies: 6 s
PENDING = 256  # samples of outputs that wait for the rate controller's next one
RECENT = 2050  # samples of outputs in half a second, at 4 kHz
OVERRIDES = 64  # stored overrides; beyond, those that ended first are dropped
PLACES = 4  # explanations that the estimator keeps in parallel
PAIRS = 120  # of rotors
HYPOTHESES = 177  # hypotheses of the estimator: rotors, pairs, recoveries, rotors that follow no command, disturbances
REACH = 2048  # stored times of ticks: the estimator's look-back, with a margin
RECORDS = 64  # stored losses; beyond, those that ended first are dropped
TOGETHER = 8  # rotors named in one announcement at most
ALTERNATIVES = 128  # sets of rotors that an event lists as alternatives
CONTACTS = 64  # that are kept, the last ones
FALLS = 32  # the same
EVENTS = 128  # in one list, the last ones
LISTED = 128  # losses, or events: the more
TOLD_EVENTS = 132  # events of which the pilot was told, or will be
