"""Healthy flights: learned from, and compared with.

baselines.py      judged before they teach, and held against the flight that they are to judge
whole_flight.py   damage that was there at take-off, by comparison with them
population.py     damage that was there at take-off, by what healthy vehicles of any build need
outputs.py        outputs near their limits, and rotors that work unequally, by what healthy vehicles do
learned.py        what they say of a vehicle: trim, noise and gains of the default method
calibrate.py      the same, of flights that are judged first
"""
