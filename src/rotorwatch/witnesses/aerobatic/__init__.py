"""Vehicles that never hover: rolls, flips, dives, thrust from idle to full (docs/aerobatic.md). In the order of the data:

firmware.py    whose pilots command rates
response.py    outputs -> angular acceleration: motor lag, gain of each axis, damping; residual torque in windows of 20 ms
assess.py       residual torque over seconds -> which rotor has lost effectiveness
innovation.py  innovations of the motion and of the motor speeds in windows of 4 ms
desync.py      innovations that match a motor giving no thrust for 30 to 500 ms
"""

from rotorwatch.flight.kinds import DESYNC, Kind, Span, Weight, Words, register
from rotorwatch.witnesses.aerobatic.firmware import flown_by_rates
from rotorwatch.witnesses.witness import Events, Stage, View, Witness

register(
    Kind(
        5, DESYNC, "motor desync", "a motor lost synchronisation briefly: commanded up, it gave no thrust for 30 to 500 ms, then recovered",
        Weight.FAULT, Span.SPELLS, brief="desynced",
        headline=Words("{motors} desynced {times} at {at}{stopped}."),
        past=Words("desynced at {at}{in_all}", "may have desynced at {at}{in_all}"),
        advice=Words(
            "Do not fly again until {motors} and its ESC have been inspected: motor timing, demag compensation, ESC firmware, PWM "
            "frequency, a worn bearing or loose bell, solder joints{log_speed}."
        ),
    )
)  # fmt: skip


def _hear(view: View, events: Events) -> Events:
    if view.hovers and not flown_by_rates(view.flight):
        return events
    from rotorwatch.witnesses.aerobatic import desync

    slips = desync.find(view.flight, view.vehicle, view.air, events)
    return tuple(sorted((*events, *slips), key=lambda e: e.detected_s))


WITNESSES = (Witness("lost steps", Stage.EVENTS, 20, _hear),)
