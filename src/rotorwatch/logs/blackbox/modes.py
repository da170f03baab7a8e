"""Flight modes by name, from the flags of slow frames.

Betaflight and EmuFlight log which boxes of the modes tab are on; of these arming, angle and horizon have had the same bits since 3.0. INAV
logs its active modes (`activeFlightModeFlags`, runtime_config.h). The flags of other firmware are unknown.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.flight import Message
from rotorwatch.logs import series
from rotorwatch.logs.blackbox import assembly, decoder

BOXES = ((1, "Angle"), (2, "Horizon"))
INAV = (
    (9, "Failsafe"), (15, "Turtle"), (8, "Manual"), (7, "Launch"), (4, "Return home"), (11, "Mission"), (12, "Course hold"),
    (5, "Position hold"), (3, "Altitude hold"), (17, "Angle hold"), (0, "Angle"), (1, "Horizon"),
)  # fmt: skip
"""(bit, name), the one that decides what it flies first."""


def messages(session: decoder.Session, first: int) -> list[Message]:
    """A message for each mode that was entered, times from `first` us on; none where the firmware's flags are not known."""
    firmware = assembly.autopilot(session.header)
    if firmware == "INAV":
        name, bits = "activeFlightModeFlags", INAV
    else:
        name, bits = "flightModeFlags", BOXES if firmware in ("Betaflight", "EmuFlight") else ()
    flags = session.slow.columns.get(name)
    if flags is None or not bits or not len(session.time):
        return []
    number = np.full(len(flags), len(bits))
    for k in reversed(range(len(bits))):
        number[(flags.astype(np.int64) >> bits[k][0] & 1) == 1] = k
    time = (session.time[np.clip(session.slow.before, 0, len(session.time) - 1)] - first) * 1e-6
    names = [*(text for _, text in bits), "Acro"]
    value = dict(zip(number.tolist(), flags.tolist()))
    return [Message(t, "mode", names[int(k)], float(value[int(k)])) for t, k in series.changes(time, number)]
