"""Python around the compiled definitions (docs/methods/default.md, docs/one-definition.md).

plant_rows.py            the plant's inputs as arrays
hypothesis_list.py       the hypotheses of a vehicle
program.py               the default estimator over ticks
default.py               the same as an interchangeable method
learning.py              noise and gains from healthy flights
event_rows.py            the definitions' losses and events, in words
unexplained_evidence.py  evidence that no event explains
explaining.py            explanations of one change, compared
shipping.py              machine code for the package
"""
