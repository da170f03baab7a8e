"""Commands and the motion that they caused, as tables, before any estimator runs. Causal throughout.

air_spans.py    flights: intervals in the air
turning.py      angular rates from the attitude where there is no gyro
missed.py       repeated outputs where the log missed the next ones
allocation.py   commands to the thrust of each rotor; rotors that cannot be distinguished
mixing.py       the mixer and the clock of the outputs, by the rate controller's demand
samples.py      signals in the definitions' form
overrides.py    outputs that deviate from the mixer
knocks.py       knocks: motion that rotors cannot cause
tick_table.py   the tick table: commands and motion at one rate
ground_contact.py  ticks in which the ground carries a part of the vehicle
inertial.py     gyro, attitude and the controller's rates, compared
order.py        the order of the outputs, by the motion that follows them
trust.py        consistency tests of the log
"""
