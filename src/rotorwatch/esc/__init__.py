"""ESC telemetry as a witness: what logged speeds and currents say about a loss of thrust, and about motors that change without one.

telemetry.py   what can be believed of the log's records
ratios.py      the mathematics: lost speed, lost propeller, current; the cause by their probabilities
gone.py        rotors that stand, or lost their propeller
watch.py       motors that became slow or hungry without a loss
witness.py     asks all of them about the events of a flight; without ESC telemetry a flight passes through unchanged
"""
