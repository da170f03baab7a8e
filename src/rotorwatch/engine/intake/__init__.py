"""From samples to ticks: one definition for logs, links and flight controllers (docs/one-definition.md).

sizes.py       capacities
planning.py    division of a flight into ticks, by the rates of its signals
craft.py       the vehicle: geometry, output range, thrust curve
airborne.py    detection of take-off and landing
mixer.py       outputs compared with the rate controller's demand
contact.py     knocks: motion that rotors cannot cause
sense.py       commands and motion of a tick
ticks.py       ticks as the estimator's input
deviations.py  outputs that deviate from the mixer
front.py       the whole front end: samples in, ticks out
"""
