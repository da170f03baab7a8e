"""The front end: samples in, ticks out. One definition for whole logs, for links and for flight controllers (docs/one-definition.md).

In the order of the data: vehicle (what is known of it), airborne (does it fly?), mixer (commands as thrusts), sense (commands and motion
of a tick), contact (knocks), ticks (what the estimator gets). Sizes: how much each of them keeps. Decisions: their thresholds.
"""
