"""Comparison with healthy flights.

baselines.py      checks healthy flights before they are used, also against the flight that they are compared with
whole_flight.py   damage present at take-off, by comparison with healthy flights of the build
population.py     damage present at take-off, by comparison with healthy vehicles of any build
outputs.py        outputs near their limits, and rotors with unequal load, by comparison with healthy vehicles
learned.py        trim, noise and gains of a vehicle for the default method
calibrate.py      the same, from flights that are checked first
tune.py           noise covariances of a published method
"""
