"""The laboratory of rotorwatch: published methods, a simulator, and experiments that measure what `rotorwatch.diagnose` finds.

It uses rotorwatch by its public modules alone (`rotorwatch.toolkit` and those named in docs/architecture.md), and adds to it by the entry
points that any package can use (`rotorwatch.base.discovery`). The extra `rotorwatch[research]` brings what it needs.

estimators/         published methods, one a file: states and losses of a plant, step by step
systems/            plants, one a file
maths/              mathematics that several methods share
control/            commands for a vehicle whose rotors are weak or dead
compiling/          steps of estimators run over a table, and as C99
published/          a published method instead of the default one over a log
simulation/         simulated flights and their logs
planning/           questions before a flight: what a vehicle survives, how to find out which rotor is weak
experiments/        losses put into healthy flights, labelled and public flights, papers' experiments; what counts as found (counting.py)
campaign/           thousands of flights, the benchmark of methods, what each constant is worth
commands/           its commands on the command line
estimate.py         published methods over a log, without a decision
methods_page.py     their estimates as a page and a picture
tune.py             noise covariances of a published method from healthy flights
export_c.py         published methods and the control allocation as C99
synthetic_fleet.py  a simulated fleet with known truth
fleet_score.py      standings of the fleet store compared with that truth
"""
