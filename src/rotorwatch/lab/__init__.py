"""Tests of rotorwatch and its methods: a simulator that writes logs, and statistics of the diagnoses of them.

simulation/    flights and their logs
planning/      questions before a flight: what a vehicle survives, how to find out which rotor is weak
experiments/   losses put into healthy flights, comparisons, the experiments of the papers; what counts as found (counting.py)
campaign/      thousands of flights, the benchmark of methods, what each constant is worth
"""
