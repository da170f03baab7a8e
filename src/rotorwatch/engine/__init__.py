"""From samples to losses: one way for logs, links and boards.

front/     samples -> ticks, and the estimator's outputs -> events: one definition, in Python and C
motion/    the same over a whole log
estimator/ the default estimator: ticks in, losses and evidence out
default/   the estimator over ticks, its losses in words, what healthy flights teach it
"""
