"""Vehicles that never hover: rolls, flips, dives, thrust from idle to full (docs/aerobatic.md). In the order of the data:

response.py    outputs -> angular acceleration: motor lag, gain of each axis, damping; residual torque in windows of 20 ms
judge.py       residual torque over seconds -> which rotor has lost effectiveness
innovation.py  innovations of the motion and of the motor speeds in windows of 4 ms
desync.py      innovations that match a motor giving no thrust for 30 to 500 ms
"""
