"""From samples to events: one way for logs, links and boards.

front/        samples -> ticks, and what the estimator announces -> events
estimator/    the default estimator: ticks in, losses and evidence out
trim/         what the trim of a whole flight shows that no tick does
engine.py     these joined: samples in, events out
feed.py       many samples in one call
definition.py  all of these, one definition: run as machine code, or by Python as they stand
diagnoser.py  a vehicle's engine, as Python has it
motion/       the front over a whole log
host/         Python around the estimator: run over ticks, its losses in words, what healthy flights teach it
"""
