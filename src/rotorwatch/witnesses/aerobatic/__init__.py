"""Vehicles that never hover: rolls, flips, dives, thrust from idle to full (docs/aerobatic.md). In the order of the data:

response.py    outputs -> angular acceleration: lag of the motors, gain of each axis, damping; what is missing, in windows of 20 ms
judge.py       what is missing over seconds -> which rotor has lost effectiveness
innovation.py  what comes as a surprise in windows of 4 ms, in the motion and in the motors' speeds
desync.py      surprises that a motor makes which gives nothing for 30 to 500 ms
"""
