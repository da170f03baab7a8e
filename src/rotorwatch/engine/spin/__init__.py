"""Vehicles that spin and fly on with rotors off: which ones, and since when. One definition for logs, links and flight controllers
(docs/one-definition.md).

subsets.py     the probability of every set of rotors, by the balance of force and torque at any rate
rotors_off.py  these -> rotors that went off, one after the other or at once, and came back
turning.py     when a vehicle spins and flies on, and the events of that
many_ticks.py  many ticks in one call
"""
