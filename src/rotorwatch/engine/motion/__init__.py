"""Commands and the motion that they caused: what is made of a flight before any estimator sees it. Causal throughout.

airborne.py     when it was in the air
turning.py      angular rates from the attitude where there is no gyro
missed.py       outputs that the log shows again because it missed the next ones
allocation.py   commands to the thrust of each rotor; rotors that cannot be distinguished
mixing.py       the mixer and the clock of the outputs, by what the rate controller asked for
samples.py      signals as the definitions take them
deviations.py   outputs that deviate from the mixer
contact.py      knocks: motion that no rotor can make
ticks.py        one uniform table of all that
inertial.py     gyro, attitude and the controller's rates, held against each other
order.py        the order of the outputs, by the motion that follows them
trust.py        is this what flew? the log held against itself
"""
