"""Losses in the blind time after take-off, found after the flight with the gains and noise that it shows.

The estimator learns a vehicle's trim, gains and noise in the blind time and so takes a rotor that fails there as normal. After the flight
gains and noise are known. The same estimator then runs again over the first seconds of each hop, assessing from the end of the first second
in the air on, with the biases open as for any multirotor. Nothing else differs: a loss announced there is a regular event.

Four conditions are physics. Damage by a knock looks like any loss, and the motion after it is the knock's: the second pass ends there, and
where the vehicle is upset. A loss lasts: one that ends before the second pass does was a gust, or the end of ground effect. A hop that
hovers at less than half of the command of another is on the ground. And while the rotors give clearly less thrust than carries the vehicle
later, the ground carries the rest, and takes torques as well: the second pass begins when they carry all of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.bindings.learning import dynamics
from rotorwatch.engine.bindings.program import estimate
from rotorwatch.engine.estimator import hypotheses
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.ground_contact import on_ground
from rotorwatch.engine.motion.tick_table import ASSESS, GROUND, LEARN, READY_S, Ticks
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.witnesses.witness import Stage, View, Witness, adding

SOURCE = Source(event_rows.HINDSIGHT, 3)
LOOK_S = 7.0  # beyond the blind time: long enough to announce a loss at its end, and to show that it lasts
REST_S = 20.0  # of flight after the blind time, to learn gains and noise without it
LEAST = 0.05  # lower end of a loss: after a few seconds the trim of a healthy rotor is not known better
STANDS = 0.5  # of the hover command of another hop: no vehicle drops so much weight in flight


def beginnings(ticks: Ticks, ground: np.ndarray | None = None) -> Ticks | None:
    """The first ticks of each hop once it is clear of the ground, all assessed: its blind time and LOOK_S more, up to a knock or an upset;
    None without any. A hop without ticks after its blind time is left out: nothing shows that an event in it lasted. ground (T,): ticks in
    which the ground carries a part; None: by `on_ground`."""
    ground = on_ground(ticks) if ground is None else ground
    stops = ticks.upset if ticks.contact is None else ticks.upset | ticks.contact
    keep, restart = np.zeros(len(ticks.time), bool), np.zeros(len(ticks.time), bool)
    for flying, blind in _hops(ticks):
        clear = int(np.argmin(np.append(ground[flying[:blind]], False)))
        look = flying[clear:][ticks.time[flying[clear:]] < ticks.time[flying[blind]] + LOOK_S]
        stopped = np.flatnonzero(stops[look])
        if clear < blind and (not stopped.size or stopped[0] > blind - clear):
            keep[look[: stopped[0]] if stopped.size else look] = True
            restart[look[0]] = True
    return _cut(ticks, keep, restart, ASSESS)


def rest(ticks: Ticks) -> Ticks | None:
    """The ticks of each hop from its blind time on, for REST_S, to learn from; None when there are none."""
    keep, restart = np.zeros(len(ticks.time), bool), np.zeros(len(ticks.time), bool)
    for flying, blind in _hops(ticks):
        keep[flying[blind : blind + round(REST_S / ticks.dt)]] = True
        restart[flying[blind]] = True
    return _cut(ticks, keep, restart, LEARN)


def _hops(ticks: Ticks) -> list[tuple[np.ndarray, int]]:
    """(ticks in the air, number of blind ones) of every hop that is airborne and continues after its blind time."""
    first = np.flatnonzero(ticks.restart)
    hops = []
    for start, end in zip(first, [*first[1:], len(ticks.time)]):
        flying = np.flatnonzero(ticks.mode[start:end] > GROUND) + start
        seen = np.flatnonzero(ticks.mode[flying] != LEARN)
        if seen.size and ticks.hover[start] >= STANDS * ticks.hover[first].max():
            hops.append((flying, int(seen[0])))
    return hops


def _cut(ticks: Ticks, keep: np.ndarray, restart: np.ndarray, mode: int) -> Ticks | None:
    """The ticks `keep` (T,), all of one mode; None when there is none."""
    if not keep.any():
        return None
    return replace(ticks, restart=restart, mode=np.full(len(ticks.time), mode, np.int32)).part(keep)


def find(carry, ticks: Ticks, B: np.ndarray, ground: np.ndarray | None = None) -> tuple[Event, ...]:
    """Losses that began in the blind time of a hop and last; `detected_s` is the end of the second pass, `live` is False.

    carry: the last of the first pass over `ticks`; B (4, n): effectiveness."""
    again = beginnings(ticks, ground)
    if again is None:
        return ()
    _, out = estimate(again, B, dynamics(carry, B))
    if not out.announced.any() and float(out.statistic.max()) > -hypotheses.CLEAR:
        # As likely as the disturbances, but not ten times: a loss in the blind time is part of the noise learned there, as disturbances
        # that explain it. The noise is learned again without it.
        later, _ = estimate(rest(ticks) or again, B)
        _, out = estimate(again, B, dynamics(later, B))
    starts = again.time[again.restart]
    ends = np.append(again.time[np.flatnonzero(again.restart)[1:] - 1], again.time[-1])
    losses = []
    for event in event_rows.read(out, again, B):
        hop = max(int(np.searchsorted(starts, event.detected_s, "right")) - 1, 0)
        later = ticks.time[(ticks.mode == ASSESS) & (ticks.time >= starts[hop])]
        least = max(low for low, _ in event.interval)
        if event.end_s is None and event.onset_s < later[0] and (least > LEAST or event.alternatives):
            extra = {**event.extra, "live": False}
            losses.append(replace(event, detected_s=float(ends[hop]), extra=extra, source=SOURCE))
    return tuple(losses)


def _claims(view: View) -> tuple[Event, ...]:
    if view.known or view.learned is None or view.table is None:  # healthy flights would have shown it at once
        return ()
    return find(view.learned, view.table, view.B, view.ground)


def _due(air: Spans, now: float, looked_s: float) -> bool:
    """Whether a flight has lasted long enough, or ended, since the last look."""
    return any(looked_s < min(start + READY_S + REST_S, end) <= now for start, end in air)


WITNESSES = (Witness("hindsight", Stage.CLAIMS, 20, adding(_claims), due=_due),)
