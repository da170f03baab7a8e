"""Losses that grew in a step: a rotor that lost a part of its thrust first, and most of it later.

An event has one onset and one size, that of its end. Where the estimate stood at a clearly smaller size before, by the live estimate two
seconds after the announcement, "lost 100 % at 30 s" would be wrong: the event then tells both sizes and when the step was.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.witnesses.witness import Events, Stage, View, Witness

GREW = 0.25  # of the thrust: twice the scatter of the estimate over a flight of rough air
STANDS_S, SETTLES_S = 3.0, 2.0  # the first size stood for at least that; after the announcement the estimate settles
STEP_S = 3.0  # between both sizes; a slower growth is no step


def _reported(view: View, event: Event) -> Event:
    table, out = view.table, view.out
    early, late = event.extra.get("loss_2s", ()), event.loss
    known = event.kind == LOSS and len(event.rotors) == 1 and len(early) == 1 and not event.alternatives
    if not known or {"gives", "grew_until_s"} & set(event.extra) or late[0] - early[0] < GREW or table is None or out is None:
        return event
    theta = out.theta[:, event.rotors[0] - 1]
    lasts = (table.time > event.detected_s + SETTLES_S) & (table.time <= (np.inf if event.end_s is None else event.end_s))
    time, theta = table.time[lasts], theta[lasts]
    if not time.size:
        return event
    above = theta > 0.5 * (early[0] + late[0])
    step = int(np.argmax(above))
    before = time < time[step] - STEP_S
    if not above[step] or time[step] - time[0] < STANDS_S + STEP_S or above[step:].mean() < 0.9:
        return event
    first = float(median(theta[before]))
    if late[0] - first < GREW or np.abs(theta[before] - first).max() > 0.5 * GREW:
        return event
    reason = f"{event.reason}; until {time[step]:.1f} s it lacked {100.0 * first:.0f} %"
    return replace(event, reason=reason, extra={**event.extra, "first_loss": first, "stepped_s": float(time[step])})


def _hear(view: View, events: Events) -> Events:
    return tuple(_reported(view, e) for e in events) if view.hovers else events


WITNESSES = (Witness("stepped losses", Stage.EVENTS, 90, _hear, needs=("motors",)),)
