"""From samples to events: the same for logs, links and boards.

intake/        samples -> ticks
estimator/     the default estimator: ticks in, losses and evidence out
drift/         slow changes in the trim of a whole flight
spin/          rotors that go off in a vehicle that spins and flies on
events/        announcements of the estimator -> events and texts
engine.py      these joined: samples in, events out
feed.py        many samples in one call
definition.py  all of these, one definition: run as machine code, or by Python
diagnoser.py   a vehicle's engine in Python, with its checkpoints
window.py      the newest samples of a vehicle
driver.py      plans, feeds and rolls back a diagnoser: the only place that steps the engine
motion/        ticks as tables; whether a log is consistent
bindings/      Python around the compiled definitions
"""
