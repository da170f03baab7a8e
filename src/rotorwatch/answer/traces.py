"""Time series for the plots of a flight, on the estimator's ticks: estimates, evidence, residuals, commands, attitude, modes and messages,
and those of `context`. Short gaps are interpolated, long ones stay gaps."""

from __future__ import annotations

import numpy as np

from rotorwatch.answer import context
from rotorwatch.answer.wording import rotors
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.bindings.hypothesis_list import Hypotheses
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN, Ticks
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.diagnosis import Trace

LN10 = float(np.log(10.0))
LEAST_ODDS = -3.0
BRIDGE_S = 0.6  # longest gap between samples that is no dropout
KINDS = ("mode", "armed", "landed", "error", "event", "text", "dropout")


def compose(
    flight: Flight, out, table: Ticks, hyp: Hypotheses, B, air, ready_s: float, limit: float, found=(), spells=(), states=()
) -> Trace:  # fmt: skip
    """The Trace of an assessed flight. out: the estimator's stacked outputs; limit: its threshold in nats; B (4, n):
    effectiveness; found: events; spells: of evidence that no event explains (`unexplained_evidence`); states: of the rotors at the end."""
    assessing = table.mode == ASSESS
    sd = event_rows.sd_of(out.theta, out.theta_sd, B)
    spread = np.where(out.theta > 0, WITHIN_95 * sd, WITHIN_95 * np.where(assessing[:, None], out.detectable, 0.0))
    odds = {name: out.log_odds[:, i] for i, name in enumerate(hyp.names) if hyp.kinds[i] in ("single", "disturbance")}
    odds["best pair"] = out.log_odds.max(axis=1, where=np.array(hyp.kinds) == "pair", initial=-np.inf)
    blind = [(a, min(a + ready_s, b), "learning after take-off") for a, b in air]
    first = np.logical_or.reduce([(table.time >= a) & (table.time < a + ready_s) for a, _ in air] or [table.mode < 0])
    for start, end in _spans(table.time, (table.mode == LEARN) & ~first):
        blind.append((start, end, "learning after a contact"))
    for start, end in _spans(table.time, table.upset & (table.mode > 0)):
        blind.append((start, end, "upset: hover physics does not hold"))
    for spell in spells:
        blind.append((spell.onset_s, spell.end_s, f"evidence against {rotors(spell.rotors)} that no event explains"))
    lower, upper = np.clip(out.theta - spread, 0, 1), np.clip(out.theta + spread, 0, 1)
    _open(lower, upper, table.time, found, spells)
    for k, state in enumerate(states):  # the undetected loss, as in the rotor table
        if state.since_takeoff is not None and not (out.theta[:, k] > 0.0).any():
            upper[assessing, k] = np.maximum(upper[assessing, k], state.since_takeoff[1])
    time, seen = table.time, np.ones(table.time.size, bool) if table.seen is None else table.seen
    measured = np.any(table.valid, axis=1, keepdims=True)
    actual, wanted = (angles(flight, name, time) for name in ("attitude", "attitude_wanted"))
    return Trace(
        time, out.theta, lower, upper,
        _bridged(time, np.where(measured, out.innovation, np.nan)), np.sqrt(out.innovation_var),
        _bridged(time, np.where(seen[:, None], table.thrust * table.hover[:, None], np.nan)),
        {k: np.maximum(v / LN10, LEAST_ODDS) for k, v in odds.items()}, tuple(blind), tuple(air), limit / LN10,
        actual, wanted, _messages(flight, float(time[-1])), *(_held(signal, time) for signal in rates(flight)),
        **context.gather(flight, time, air),
    )  # fmt: skip


def _open(lower: np.ndarray, upper: np.ndarray, time: np.ndarray, found, spells) -> None:
    """Widen the bands of suspects as the rotor table does: over every explanation of an event, and up to 1 after unexplained evidence."""
    for e in found:
        inside = (time >= e.detected_s) & (time <= (np.inf if e.end_s is None else e.end_s))
        for rotor in e.suspects if e.alternatives and e.interval else ():
            lower[inside, rotor - 1] = 0.0
            upper[inside, rotor - 1] = np.maximum(upper[inside, rotor - 1], e.most(rotor))
    for spell in spells:
        for rotor in spell.rotors:
            lower[time >= spell.onset_s, rotor - 1] = 0.0
            upper[time >= spell.onset_s, rotor - 1] = spell.most(rotor)


def _bridged(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(T, k) with NaN rows interpolated linearly between neighbours that are at most BRIDGE_S apart."""
    missing = np.isnan(values).any(axis=1)
    have = np.flatnonzero(~missing)
    if not missing.any() or have.size < 2:
        return values
    k = np.searchsorted(have, np.flatnonzero(missing))
    inside = (k > 0) & (k < have.size)
    rows = np.flatnonzero(missing)[inside]
    close = time[have[k[inside]]] - time[have[k[inside] - 1]] <= BRIDGE_S
    out = values.copy()
    for j in range(values.shape[1]):
        out[rows[close], j] = np.interp(time[rows[close]], time[have], values[have, j])
    return out


def angles(flight: Flight, name: str, time: np.ndarray) -> np.ndarray | None:
    """(T, 3) roll, pitch, yaw [degrees] at the latest sample of each tick; NaN where the last one is older than BRIDGE_S."""
    if not flight.has(name):
        return None
    signal = flight[name].wholes()
    when = signal.time
    if when.size < 2:
        return None
    at = np.searchsorted(when, time, side="right") - 1
    fresh, at = at >= 0, np.maximum(at, 0)
    fresh &= time - when[at] <= BRIDGE_S
    w, x, y, z = signal.values[at].T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.where(fresh[:, None], np.degrees(np.stack([roll, pitch, yaw], axis=1)), np.nan)


def rates(flight: Flight) -> tuple[Signal | None, Signal | None]:
    """(actual, commanded) rates [rad/s] of a vehicle that is flown by rates; None, None where its attitude is commanded."""
    if not flight.has("rates_wanted") or flight.has("attitude_wanted") or not (flight.has("rates") or flight.has("gyro")):
        return None, None
    return flight["rates" if flight.has("rates") else "gyro"], flight["rates_wanted"]


def _held(signal: Signal | None, time: np.ndarray) -> np.ndarray | None:
    """(T, 3) degrees/s at the latest sample of each tick; NaN where that is older than BRIDGE_S."""
    if signal is None:
        return None
    at = np.searchsorted(signal.time, time, side="right") - 1
    fresh = (at >= 0) & (time - signal.time[np.maximum(at, 0)] <= BRIDGE_S)
    fine = fresh & signal.valid[np.maximum(at, 0)].all(axis=1)
    return np.where(fine[:, None], np.degrees(signal.values[np.maximum(at, 0)]), np.nan)


def _messages(flight: Flight, end: float) -> tuple[tuple[float, str, str], ...]:
    """(time s, kind, text) of the autopilot's messages and modes; texts that repeat at once are left out."""
    out: list[tuple[float, str, str]] = []
    for m in flight.messages:
        row = (float(m.time), m.kind, " ".join(m.text.split()))
        if m.kind in KINDS and row[2] and 0.0 <= m.time <= end and not (out and out[-1][1:] == row[1:]):
            out.append(row)
    return tuple(out)


def _spans(when: np.ndarray, flag: np.ndarray) -> list[tuple[float, float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flag, [False]]).astype(int)))
    return [(float(when[a]), float(when[min(b, len(when) - 1)])) for a, b in zip(edges[::2], edges[1::2])]
