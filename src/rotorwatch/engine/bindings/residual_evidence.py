"""Evidence of the estimator that remains after all events are recorded: faults over the threshold that were never announced.

An announcement needs more than a threshold: one hypothesis that beats every disturbance for a while, and a motion that fits it. Beside a
loss that is already known, or with the vehicle at its limits, that may never be met although a second rotor is failing. Its evidence is
then absorbed as a disturbance, and calling the rotor healthy would be wrong. Likewise where the trim is learned again after a contact,
and has changed as by a rotor's loss. Such a period is not an event - which rotor, and how much, remains open - but it is reported.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.engine.bindings.hypothesis_list import Hypotheses
from rotorwatch.engine.estimator import hypotheses, plant
from rotorwatch.engine.motion.tick_table import JUDGE, Ticks
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import CONTACT, EVIDENCE


def _residual_explained(claim: Event, known: Event) -> bool:
    return known.kind == EVIDENCE and known.source.name != RESIDUAL.name


RESIDUAL = Source("residual", 12, _residual_explained)
LASTS_S = 1.0
TRIM_S = 2.0  # averaging time of the trim before and after it was learned again
# Uncertainty of the commanded wrench of trim, in hover thrusts of one rotor, and the share of its change that a rotor must explain.
TRIM_SD = np.array([0.05, 0.05, 0.15, 0.2])
LEAST_TRIM, UNEXPLAINED = 0.2, 0.52


def claim(
    rotors: tuple[int, ...],
    start_s: float,
    end_s: float,
    interval: tuple[tuple[float, float], ...] = (),
    probability: float = 0.5,
    source: Source = RESIDUAL,
) -> Event:
    """Evidence against each of these rotors (1-based), from start to end [s]; interval: of the loss of each, 95 %, where known."""
    return Event(EVIDENCE, rotors, start_s, end_s, end_s, (), interval, probability, source=source)


def find(out, table: Ticks, hyp: Hypotheses, limit: float, events: Sequence[Event], B: np.ndarray | None = None) -> tuple[Event, ...]:
    """Periods of at least LASTS_S, after the first event, in which faults of other rotors than the known ones have more evidence than
    `limit` [nats] and no disturbance explains them clearly better; and, with B (4, n), trims that were learned again and changed as by a
    rotor's loss. None in flights without an event: `answer.unseen` covers these. out: the estimator's stacked outputs."""
    known = [e for e in events if e.means.lasting_fault]
    if not known:
        return ()
    time, n = table.time, out.theta.shape[1]
    members = np.array([[i in who for i in range(n)] for who in hyp.rotors])
    fault = np.asarray(hyp.fault)
    odds = np.asarray(out.log_odds)
    best_fault, best_other = (odds.max(axis=1, where=some, initial=-np.inf) for some in (fault, ~fault))
    over = (best_fault > limit) & (best_fault > best_other - hypotheses.CLEAR)
    over &= (table.mode == JUDGE) & ~table.upset & (time > min(e.detected_s for e in known))
    for e in known:
        for mark in (e.detected_s, e.end_s):
            if mark is not None:
                over &= ~((time >= mark - 0.5) & (time <= mark + plant.USUAL_S))
        over &= ~((time >= e.onset_s) & (time <= e.detected_s))
    over &= ~knocked(time, events)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], over, [False]]).astype(int)))
    found = []
    for a, b in zip(edges[::2], edges[1::2]):
        if (b - a) * table.dt < LASTS_S:
            continue
        near = (odds[a:b] > best_fault[a:b, None] - hypotheses.CLEAR) & fault
        weight = near.sum(axis=0) @ members.astype(float)
        own = np.zeros(n, bool)
        for e in known:
            if e.onset_s <= time[b - 1] and (e.end_s is None or e.end_s >= time[a]):
                own[[r - 1 for r in e.rotors]] = True
        mine = np.flatnonzero((weight > 0.5 * (b - a)) & ~own)
        if mine.size:
            found.append(claim(tuple(int(i) + 1 for i in mine), float(time[a]), float(time[b - 1])))
    if B is not None:
        found += _trims(np.asarray(out.biases), table, known, B)
    return tuple(sorted(found, key=lambda spell: spell.onset_s))


def knocked(time: np.ndarray, events: Sequence[Event]) -> np.ndarray:
    """Return whether a knock among the events explains the evidence at these times [s], which it leaves behind."""
    near = np.zeros(np.shape(time), bool)
    for e in events:
        if e.kind == CONTACT:
            near |= (time >= e.onset_s - 0.5) & (time <= max(e.detected_s, e.end_s or 0.0) + plant.USUAL_S)
    return near


def faint(losses: Sequence[Event], found: Sequence[Event], end_s: float) -> tuple[Event, ...]:
    """Losses that accuse no rotor (`events.accuses`), except those explained by a knock among the events."""
    knocks = [e.onset_s for e in found if e.kind == CONTACT]
    return tuple(
        claim(e.rotors, e.onset_s, end_s if e.end_s is None else e.end_s)
        for e in losses
        if not any(t - 0.5 <= e.onset_s <= t + plant.USUAL_S for t in knocks)
    )


def _trims(biases: np.ndarray, table: Ticks, known: Sequence[Event], B: np.ndarray) -> list[Event]:
    """Times after an event when the vehicle flew on without evaluation, and the commanded wrench of trim, biases (T, 4), had then changed
    along the direction of rotors, columns of B (4, n)."""
    time, judging = table.time, table.mode == JUDGE
    stops = np.flatnonzero(judging[:-1] & ~judging[1:])
    found = []
    for a in stops:
        later = np.flatnonzero(judging[a + 1 :])
        b = a + 1 + (later[0] if later.size else 0)
        if not later.size or table.restart[a + 1 : b + 1].any() or time[a] < min(e.detected_s for e in known):
            continue
        before = judging & (time > time[a] - TRIM_S) & (time <= time[a])
        after = judging & (time >= time[b]) & (time < time[b] + TRIM_S)
        change = biases[after].mean(axis=0) - biases[before].mean(axis=0)
        weighted, columns = change / TRIM_SD, B / TRIM_SD[:, None]
        size = np.maximum(columns.T @ weighted, 0.0) / (columns**2).sum(axis=0)
        left = np.linalg.norm(weighted[:, None] - columns * size, axis=0)
        mine = np.flatnonzero((size > LEAST_TRIM) & (left < UNEXPLAINED * np.linalg.norm(weighted)))
        if mine.size:
            found.append(claim(tuple(int(i) + 1 for i in mine), float(time[a]), float(time[b])))
    return found
