"""From samples to events: the same for logs, links and boards.

front/         samples -> ticks, and announcements of the estimator -> events
estimator/     the default estimator: ticks in, losses and evidence out
trim/          slow changes in the trim of a whole flight
engine.py      these joined: samples in, events out
feed.py        many samples in one call
definition.py  all of these, one definition: run as machine code, or by Python
diagnoser.py   a vehicle's engine in Python, with its checkpoints
window.py      the newest samples of a vehicle
driver.py      plans, feeds and rolls back a diagnoser: the only place that steps the engine
motion/        ticks as tables; whether a log is consistent
host/          Python around the estimator: run over ticks, its losses in words, learning from healthy flights
"""
