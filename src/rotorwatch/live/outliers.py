"""Output samples that contradict those before and after, and come between two of the autopilot's own: forged samples.

True outputs jump and return, too, but an autopilot sends them in a fixed rhythm: a sample that jumps waits for the next one, and is left
out where both neighbours keep the rhythm without it. All others pass at once; on slow links also those that do not come early.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.flight import Signal

JUMP = 0.05  # of the whole range: a smaller jump points to no rotor
USUAL, WEIGHT = 4.0, 0.05  # a jump in usual steps between samples; weight of the latest step in the average
BEYOND = 0.5  # share of a jump beyond both neighbours
NEAR_S, EARLY = 0.15, 0.7  # after the sample before, in s or in periods: a later one is not held back
EXTRA = 1.5  # periods between both neighbours below which a sample is out of rhythm; two without losses
LOST = 0.25  # of a period, largest weight of a longer pause: samples are lost, the rhythm stays
RANGE = {"us": 1000.0}


class Outliers:
    """Outputs of a vehicle, as they arrive. left_out: number of samples that were."""

    def __init__(self):
        self._before: tuple[float, np.ndarray] | None = None  # (time s, outputs) of the last sample that passed
        self._waits: Signal | None = None
        self._step = self._period_s = 0.0  # averages
        self.left_out = 0

    def take(self, motors: Signal) -> Signal | None:
        """The samples that can be used now; None without any."""
        if self._waits is not None:
            parts = [(signal.time, signal.values, signal.valid) for signal in (self._waits, motors)]
            motors, self._waits = motors.with_arrays(*(np.concatenate(columns) for columns in zip(*parts))), None
        values = np.where(motors.valid, motors.values, 0.0) / RANGE.get(motors.unit, 1.0)
        time, keep = motors.time.tolist(), np.ones(len(motors), bool)
        for k, (now, outputs) in enumerate(zip(time, values)):
            if self._before is not None:
                then, before = self._before
                step, pause = np.abs(outputs - before), now - then
                jumps = step > max(JUMP, USUAL * self._step)
                if pause < max(NEAR_S, EARLY * self._period_s) and jumps.any():
                    if k + 1 == len(time):
                        self._waits, keep[k] = motors.part(slice(k, None)), False
                        break
                    after = values[k + 1]
                    beyond = np.maximum(outputs - np.maximum(before, after), np.minimum(before, after) - outputs)
                    if time[k + 1] - then < EXTRA * self._period_s and (beyond > BEYOND * step)[jumps].all():
                        keep[k] = False
                        self.left_out += 1
                        continue
                self._step += WEIGHT * (float(step.mean()) - self._step)
                period = self._period_s or pause
                self._period_s = period + WEIGHT * min(pause - period, LOST * period)
            self._before = now, outputs
        if keep.all():
            return motors
        return motors.with_arrays(motors.time[keep], motors.values[keep], motors.valid[keep]) if keep.any() else None
