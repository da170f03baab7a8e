"""Results of the trim of a flight (engine/drift/): a loss of one rotor that grew or lasts; a turned mount or arm, which costs no thrust
and accuses no rotor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.answer import unseen
from rotorwatch.base.compiling.running import Rows
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.drift import many, trim
from rotorwatch.engine.events.losses import CLEAR
from rotorwatch.engine.motion.tick_table import Ticks
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import TURNED


class Growth(NamedTuple):
    """A loss that has grown, or a step: `engine.drift.outcome.Growth`, with rotors from 1; rows: the same in the definition's form."""

    rotors: tuple[int, ...]
    start_s: float
    end_s: float
    loss: tuple[float, ...]
    interval: tuple[tuple[float, float], ...]
    odds: float
    looked_s: float
    grew: bool
    rows: Rows

    @property
    def certain(self) -> bool:
        """True if it is certainly a single rotor's."""
        return len(self.rotors) == 1 and self.odds > CLEAR


def growth(state: Rows) -> Growth | None:
    """The loss of one rotor that lasts to the end of a flight and is the most likely explanation; None without such."""
    rows = state.part("growth").copy()
    count = int(rows["count"][0])
    if not count:
        return None
    loss, low, high = (tuple(rows[name][0, :count].tolist()) for name in ("loss", "lower", "upper"))
    start, end, odds, looked = (float(rows[name][0]) for name in ("start", "end", "odds", "looked"))
    rotors = tuple(int(k) + 1 for k in rows["rotors"][0, :count])
    return Growth(rotors, start, end, loss, tuple(zip(low, high)), odds, looked, bool(rows["grew"][0]), rows)


def mounts(state: Rows) -> tuple[Event, ...]:
    """The claim that a mount turned, if any."""
    onset, detected, odds, yaw, half = (float(state.part("mount")[name][0]) for name in ("onset", "detected", "odds", "yaw", "half"))
    if odds < CLEAR:
        return ()
    side = "right" if yaw > 0.0 else "left"
    reason = (
        f"since {onset:.1f} s a yaw torque to the {side} of {abs(yaw):.1f} times one rotor's drag torque in hover has been commanded "
        "without the yaw motion to match: more than wind or a load needs. No thrust is missing"
    )
    extra = {"yaw": round(yaw, 3), "yaw_interval": [round(yaw - half, 3), round(yaw + half, 3)]}
    return (Event(TURNED, (), onset, detected, None, (), (), odds / (1.0 + odds), (), reason, extra, event_rows.TRIM),)


def look(out, table: Ticks, B: np.ndarray) -> Rows:
    """The trim analysis of a whole flight. out: the estimator's stacked outputs at the ticks of `table` (theta (T, n), biases (T, 4)); B
    (4, n): effectiveness."""
    state, craft = ENGINE.new(trim.Trim), event_rows.vehicle(B)
    state.set(every=LASTS)
    craft.set(expo_sd=table.curve[1])
    lacking = (out.biases + (table.thrust * out.theta) @ B.T)[:, :3]
    rows = table.time, table.mode.astype(np.int32), unseen.usable(table), lacking, table.thrust
    ENGINE.call(many.pass_on, state, craft, float(table.dt), len(table.time), *map(np.ascontiguousarray, rows))
    ENGINE.call(many.settle, state, craft)
    return state
