"""Where rotorwatch and its methods are tried: one simulator that writes logs, and figures that `diagnose` makes of them.

simulation/    flights and their logs
planning/      questions before a flight: what a vehicle survives, how to find out which rotor is weak
experiments/   losses put into healthy flights, comparisons, the experiments of the papers; what counts as found (counting.py)
campaign/      thousands of flights, the benchmark of methods, what each constant is worth
"""
