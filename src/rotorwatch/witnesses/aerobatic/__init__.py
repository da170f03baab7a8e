"""Vehicles that never hover: rolls, flips, dives, thrust from idle to full (docs/aerobatic.md). In the order of the data:

firmware.py    whose pilots command rates
response.py    outputs -> angular acceleration: lag of the motors, gain of each axis, damping; what is missing, in windows of 20 ms
judge.py       what is missing over seconds -> which rotor has lost effectiveness
innovation.py  what comes as a surprise in windows of 4 ms, in the motion and in the motors' speeds
desync.py      surprises that a motor makes which gives nothing for 30 to 500 ms
"""

from rotorwatch.witnesses.aerobatic.firmware import flown_by_rates
from rotorwatch.witnesses.witness import Events, Stage, View, Witness


def _hear(view: View, events: Events) -> Events:
    if view.hovers and not flown_by_rates(view.flight):
        return events
    from rotorwatch.witnesses.aerobatic import desync

    slips = desync.find(view.flight, view.vehicle, view.air, events)
    return tuple(sorted((*events, *slips), key=lambda e: e.detected_s))


WITNESSES = (Witness("lost steps", Stage.EVENTS, 20, _hear),)
