"""Makes the sample of the tutorial "my FPV quad fell": `python tests/make_fpv_sample.py FILE.bbl`.

A flight of rotorwatch_lab/simulation/fpv.py at 500 Hz with motor speeds: motor 3 loses step at 14 s and at 19 s, and stops at 22 s.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from blackbox_writer import PREVIOUS, SIGNED, UNSIGNED, ZERO, Field, betaflight, fly, rows
from rotorwatch_lab.simulation import fpv

FALLS_S, END_S, EVERY, SEED = 22.0, 23.4, 2, 1
WRONG = (fpv.Moment(0, 2, 14.0, 0.12), fpv.Moment(0, 2, 19.0, 0.2), fpv.Moment(0, 2, FALLS_S, 60.0))
POLES = 14
FRD_TO_LOG = np.array([1.0, -1.0, -1.0])  # Betaflight's axes: nose left and up are positive


def made() -> bytes:
    """The log."""
    flight = fpv.fly(1, 32.0, SEED, WRONG, rpm=True)[0]
    part = {name: s.between(0.0, END_S) for name, s in flight.signals.items()}
    n = len(part["motors"]) // EVERY * EVERY
    motors, gyro, wanted, throttle, esc = (part[name].values[:n:EVERY] for name in ("motors", "rates", "rates_wanted", "throttle", "esc"))
    gyro, wanted = (np.round(np.degrees(x) * FRD_TO_LOG).astype(int) for x in (gyro, wanted))
    erpm = np.round(esc[:, :4] * 60.0 / (2.0 * np.pi) * POLES / 2.0 / 100.0).astype(int)
    log = betaflight(more=[Field(f"eRPM[{k}]", 0, ZERO, UNSIGNED, PREVIOUS, SIGNED) for k in range(4)])
    output = np.where(motors > 0.0, np.round(158 + motors * (2047 - 158)), 0).astype(int)
    named = (("motor", output), ("gyroADC", gyro), ("setpoint", wanted), ("eRPM", erpm))
    columns = {f"{name}_{k}": column for name, values in named for k, column in enumerate(values.T)}
    columns |= {"setpoint_3": np.round(1000.0 * throttle[:, 0]), "rcCommand_3": np.round(1000.0 + 1000.0 * throttle[:, 0])}
    count = np.arange(len(output))
    columns |= {"time": 1000 * EVERY * count, "loopIteration": EVERY * count, "accSmooth_2": np.full(len(count), 2048)}
    frames = rows(log, len(count), **columns)
    return fly(log, frames).bytes(end=False)


if __name__ == "__main__":
    Path(sys.argv[1]).write_bytes(made())
