"""From samples to ticks: one definition for logs, links and flight controllers (docs/one-definition.md).

sizes.py       capacities
craft.py       the vehicle: geometry, output range, thrust curve
airborne.py    when it is in the air
mixer.py       outputs against the rate controller's demand
contact.py     knocks: motion that no rotor can make
sense.py       commands and motion of a tick
ticks.py       ticks as the estimator takes them
deviations.py  outputs that deviate from the mixer
front.py       all of it: samples in, ticks out
"""
