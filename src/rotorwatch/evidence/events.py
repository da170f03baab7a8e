"""From the diagnoser's ticks to events: what was announced, what became of it, and how sure that is.

Announcements, commitments and endings are made by the estimator, live; this file only writes them down. Nothing here
moves a detection time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotorwatch.diagnosis import Event
from rotorwatch.evidence.hypotheses import WEIGHT as hypotheses_weight
from rotorwatch.evidence.hypotheses import Hypotheses
from rotorwatch.motion.ticks import JUDGE, Ticks
from rotorwatch.systems.wrench_balance import lower_rotors

CREDIBLE = 0.03  # a rotor set with less probability than this is not named
CERTAIN = 0.9  # below this the answer is ambiguous
CERTAIN_OPPOSITE = 0.99  # the same for a pair of opposite rotors: only manoeuvres tell it from the others
# What the model itself is uncertain of: the thrust curve away from the operating point, equal rotors.
MODEL_SD, MODEL_SHARE = 0.004, 0.02
COAXIAL_SHARE = 0.06  # ... how the thrust of a coaxial arm divides: half of what the lower rotors' share may be off by
GONE = 0.8
# One of two rotors that is taken back had failed only if it had lost so much, for so long: else it was an error in the other's share.
REAL, LASTED_S = 0.1, 5.0
HIDDEN = 20.0


@dataclass
class Record:
    """One loss under way, while the ticks are read in order."""

    onset: float
    announced: int
    rotors: tuple[int, ...]
    shares: dict
    last: int
    end: float | None = None
    loss: tuple[float, ...] = ()  # of opposite rotors that share a shift of thrust; the others' is in the estimates
    seen: int | None = None  # last tick of an announcement that judging stopped before it became part of the filter


def rotor_sets(hyp: Hypotheses, probability: np.ndarray) -> dict[tuple[int, ...], float]:
    """Probability of each rotor set: a rotor alone and with a common shift of thrust are the same set."""
    sets: dict[tuple[int, ...], float] = {}
    for who, fault, p in zip(hyp.rotors, hyp.fault, probability):
        if fault:
            sets[who] = sets.get(who, 0.0) + float(p)
    return dict(sorted(sets.items(), key=lambda item: -item[1]))


def opposites(B: np.ndarray) -> dict[int, tuple[int, ...]]:
    """For each rotor the rotors that cancel its roll and pitch torque: with those it can share a loss almost unseen."""
    n = B.shape[1]
    return {i: tuple(j for j in range(n) if j != i and np.abs(B[:2, i] + B[:2, j]).max() < 0.05) for i in range(n)}


def hidden_pairs(shares: dict, partners: dict) -> tuple[tuple[int, ...], ...]:
    """Pairs that only their rarity, not the data, rules out against a single rotor: it and the one opposite.

    Losses on opposite rotors cancel in roll and pitch; gusts hide the rest in yaw and thrust. When the data favour such
    a pair by more than HIDDEN once prior weights are taken out, a small single loss must not be claimed.
    """
    best = next(iter(shares), ())
    if len(best) != 1:
        return ()
    rarity = hypotheses_weight["single"] / hypotheses_weight["pair"]
    pairs = [tuple(sorted((best[0], j))) for j in partners.get(best[0], ())]
    return tuple(p for p in pairs if shares.get(p, 0.0) * rarity > HIDDEN * shares[best])


def opposite_shares(hyp: Hypotheses, log_odds: np.ndarray, partners: dict) -> dict[tuple[int, ...], float]:
    """Probabilities of the pairs of opposite rotors among each other."""
    pairs = [h for h, who in enumerate(hyp.rotors) if hyp.kinds[h] == "pair" and who[1] in partners.get(who[0], ())]
    weight = np.exp(log_odds[pairs] - log_odds[pairs].max())
    order = np.argsort(-weight)
    return {hyp.rotors[pairs[k]]: float(weight[k] / weight.sum()) for k in order}


def read(out, ticks: Ticks, hyp: Hypotheses, B: np.ndarray | None = None) -> tuple[Event, ...]:
    """Events of one flight from the diagnoser's stacked outputs (theta, theta_sd, announced, committed, active, ...)."""
    partners = opposites(B) if B is not None else {}
    records: list[Record] = []
    current: Record | None = None
    pending_onset = opened = 0.0
    active = np.zeros(out.theta.shape[1], bool)
    holder: dict[int, Record] = {}
    notable = np.flatnonzero(
        out.announced
        | out.committed
        | (out.opposite >= 0)
        | (np.diff(out.active, axis=0, prepend=False).any(axis=1))
        | ticks.restart
    )
    for k in map(int, notable):
        if ticks.restart[k]:
            landed = max((int(j) for j in np.flatnonzero(ticks.mode[:k] == JUDGE)[-1:]), default=max(0, k - 1))
            for record in holder.values():  # what lasted until the landing
                record.end = record.end if record.end is not None else float(ticks.time[landed])
            holder, current, active, opened = {}, None, np.zeros_like(active), float(ticks.time[k])
        if out.opposite[k] >= 0:
            onset = float(ticks.command_time[max(0, k - round(float(out.opposite_onset[k])))])
            shares = opposite_shares(hyp, out.log_odds[k], partners)
            share = float(np.mean(out.opposite_loss[k]))  # only their sum shows
            records.append(Record(onset, k, hyp.rotors[out.opposite[k]], shares, k, None, (share, share)))
        if out.announced[k]:
            who = hyp.rotors[out.best[k]]
            onset = float(ticks.command_time[max(0, k - round(float(out.onset[k])))])
            shares = rotor_sets(hyp, out.probability[k])
            pending_onset = onset
            if all(active[i] for i in who):
                current = None  # more, or less, of what is already known
            else:
                current = Record(min(onset, float(ticks.time[k])), k, who, shares, k)
                current.seen = _unjudged_from(ticks, k) - 1
                records.append(current)
        if out.committed[k]:
            now = out.active[k]
            if current is not None:
                current.seen = None
                fresh = tuple(int(i) for i in np.flatnonzero(now) if not active[i])
                current.shares = rotor_sets(hyp, out.probability[k])
                current.rotors = fresh or current.rotors
                for i in fresh:
                    holder[int(i)] = current
                resolved = [
                    r for r in records if r.loss and opened <= r.onset and set(current.rotors) <= set().union(*r.shares)
                ]
                for record in resolved[-1:]:  # what opposite rotors were suspected of is now known
                    current.onset, current.announced = record.onset, record.announced
                    records.remove(record)
                current = None
            for i in np.flatnonzero(active & ~now):
                record = holder.pop(int(i), None)
                if record is None:
                    continue
                if any(r is record for r in holder.values()):
                    gone = _left(record, int(i), k, pending_onset)
                    before = int(np.searchsorted(ticks.time, pending_onset)) - 1
                    if out.theta[before, i] >= REAL and pending_onset - ticks.time[record.announced] > LASTED_S:
                        records.append(gone)
                else:
                    record.end = pending_onset
                    record.last = k
            active = now.copy()
        for record in holder.values():
            record.last = k
    judged = np.flatnonzero(ticks.mode == JUDGE)
    final = int(judged[-1]) if judged.size else len(ticks.time) - 1
    return tuple(_event(r, out, ticks, final, partners, B) for r in records)


def _unjudged_from(ticks: Ticks, k: int) -> int:
    """First tick after k that is not judged."""
    after = np.flatnonzero((ticks.mode[k:] != JUDGE) | (ticks.restart[k:] & (np.arange(len(ticks.time) - k) > 0)))
    return k + int(after[0]) if after.size else len(ticks.time)


def _left(record: Record, rotor: int, k: int, end: float) -> Record:
    """One of a record's rotors works again at tick k, or never failed: it leaves the record for one of its own, that ended."""
    record.rotors = tuple(r for r in record.rotors if r != rotor)
    shares: dict[tuple[int, ...], float] = {}
    for who, share in record.shares.items():
        rest = tuple(r for r in who if r != rotor)
        shares[rest] = shares.get(rest, 0.0) + share
    record.shares = {who: share for who, share in shares.items() if who}
    return Record(record.onset, record.announced, (rotor,), {(rotor,): 1.0}, k, end)


def sd_of(theta: np.ndarray, sd: np.ndarray, B: np.ndarray | None = None) -> np.ndarray:
    """Standard deviation of a loss with what the model of a vehicle with effectiveness B (4, n) is uncertain of."""
    coaxial = B is not None and lower_rotors(B) is not None
    share = np.hypot(MODEL_SHARE, COAXIAL_SHARE) if coaxial else MODEL_SHARE
    return np.sqrt(sd**2 + MODEL_SD**2 + (share * theta) ** 2)


def _event(record: Record, out, ticks: Ticks, final: int, partners: dict, B) -> Event:
    if record.seen is not None:
        k = record.seen
    elif record.end is None:
        k = final
    else:  # the last estimate before the change that ended it
        k = int(np.searchsorted(ticks.time, record.end)) - 1
    k = max(k, record.announced)
    rotors = record.rotors
    loss = np.array(record.loss) if record.loss else out.theta[k, list(rotors)]
    # Of a shared shift each rotor may hold anything from nothing to all.
    sd = loss / 1.96 if record.loss else sd_of(loss, out.theta_sd[k, list(rotors)], B)
    shares = record.shares
    own = shares.get(tuple(sorted(rotors)), max(shares.values(), default=0.0))
    paired = len(rotors) == 2 and rotors[1] in partners.get(rotors[0], ()) and len(partners) > 4
    others = [s for s, p in shares.items() if (p >= CREDIBLE or record.loss) and set(s) != set(rotors)]
    hidden = hidden_pairs(shares, partners)
    unsure = own < (CERTAIN_OPPOSITE if paired else CERTAIN) or bool(hidden) or bool(record.loss)
    if paired and unsure:  # all that only a manoeuvre could tell apart
        torque_free = {tuple(sorted((i, j))) for i, js in partners.items() for j in js}
        others += [s for s in sorted(torque_free) if s not in others and set(s) != set(rotors)]
    alternatives = (
        tuple(tuple(i + 1 for i in s) for s in (*hidden, *(o for o in others if o not in hidden))) if unsure else ()
    )
    delay = float(ticks.time[record.announced])
    names = " and ".join(str(i + 1) for i in rotors)
    if alternatives:
        reason = (
            f"commands and motion changed at {record.onset:.1f} s as if rotor {names} had lost thrust, but "
            + ", ".join("+".join(map(str, a)) for a in alternatives)
            + " would look the same"
            + (", and so would a sudden drop of battery voltage or more weight" if record.loss else "")
        )
    else:
        reason = (
            f"since {record.onset:.1f} s the rotors are commanded a torque and thrust that the motion does not show; the "
            f"missing part has the direction of rotor {names}"
        )
    k2 = min(record.announced + round(2.0 / ticks.dt), final)
    return Event(
        kind="loss_of_effectiveness",
        rotors=tuple(int(i) + 1 for i in rotors),
        onset_s=record.onset,
        detected_s=delay,
        end_s=record.end,
        loss=tuple(float(v) for v in loss),
        interval=tuple((max(0.0, float(v - 1.96 * s)), min(1.0, float(v + 1.96 * s))) for v, s in zip(loss, sd)),
        probability=float(own),
        alternatives=alternatives,
        reason=reason,
        extra={"loss_2s": [float(v) for v in (record.loss or out.theta[k2, list(rotors)])]},
    )
