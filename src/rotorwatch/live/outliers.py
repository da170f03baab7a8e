"""Outputs of one moment that those before and after it contradict: a forged or damaged sample, by which no rotor is accused.

True outputs that jump stay for a while, against what an autopilot sends in a second. A sample that jumps waits for the next one, all others
pass at once; on slow links only one that comes too early for the autopilot's own rhythm. A true one that is left out is one lost sample.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.flight import Signal

JUMP = 0.05  # of the whole range: less accuses no rotor
USUAL, WEIGHT = (
    4.0,
    0.05,
)  # a jump is so many times the usual step from one sample to the next; weight of the latest in what is usual
BEYOND = 0.5  # of a jump, that is beyond both neighbours
NEAR_S, EARLY = 0.15, 0.7  # after the sample before, in s or in usual periods: one that comes later is not held back
RANGE = {"us": 1000.0}


class Outliers:
    """One vehicle's outputs, as they come. left_out: samples that were."""

    def __init__(self):
        self._before: tuple[float, np.ndarray] | None = None  # (time s, outputs) of the last sample that passed
        self._waits: Signal | None = None
        self._step = self._period_s = 0.0  # usual ones
        self.left_out = 0

    def take(self, motors: Signal) -> Signal | None:
        """The samples that can be used now; None without any."""
        if self._waits is not None:
            parts = [(one.time, one.values, one.valid) for one in (self._waits, motors)]
            motors, self._waits = motors.with_arrays(*(np.concatenate(columns) for columns in zip(*parts))), None
        values = np.where(motors.valid, motors.values, 0.0) / RANGE.get(motors.unit, 1.0)
        time, keep = motors.time.tolist(), np.ones(len(motors), bool)
        for k, (now, own) in enumerate(zip(time, values)):
            if self._before is not None:
                then, before = self._before
                step, near = np.abs(own - before), max(NEAR_S, EARLY * self._period_s)
                jumps = step > max(JUMP, USUAL * self._step)
                if now - then < near and jumps.any():
                    if k + 1 == len(time):
                        self._waits, keep[k] = motors.part(slice(k, None)), False
                        break
                    after = values[k + 1]
                    beyond = np.maximum(own - np.maximum(before, after), np.minimum(before, after) - own)
                    if time[k + 1] - then < 2.0 * near and (beyond > BEYOND * step)[jumps].all():
                        keep[k] = False
                        self.left_out += 1
                        continue
                self._step += WEIGHT * (float(step.mean()) - self._step)
                self._period_s += WEIGHT * (now - then - self._period_s)
            self._before = now, own
        if keep.all():
            return motors
        return motors.with_arrays(motors.time[keep], motors.values[keep], motors.valid[keep]) if keep.any() else None
