"""How many rotors, samples and spells the definitions have room for on a computer; rw_config.h has a flight controller's own numbers."""

ROTORS = 16
HALF_SECOND = 4096  # samples of gyro or accelerometer in half a second
FLIGHTS = 256  # that have ended and not been asked for
