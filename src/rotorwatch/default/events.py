"""From the diagnoser's ticks to events: what was announced, what became of it, and how sure that is.

What happened, and which explanations are left, is the estimator's, live; this file only writes it down.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotorwatch.default import hypotheses
from rotorwatch.default.hypotheses import Hypotheses
from rotorwatch.default.plant import lower_rotors
from rotorwatch.diagnosis import Event
from rotorwatch.motion.ticks import JUDGE, Ticks

CREDIBLE = 0.03  # a rotor set with less probability than this is not named
CERTAIN_OPPOSITE = 0.99  # the same for a pair of opposite rotors: only manoeuvres tell it from the others
MODEL_SD = 0.004  # rotors that are not equal
# By what share the thrust curve may be steeper or flatter in hover than the log says: an expo of 0.65 that is 0.12 off.
CURVE_SHARE = 0.08
HIDDEN = 20.0  # times that the data alone must prefer a pair of opposite rotors to be named
SETTLES_S = 1.0  # after an announcement: by then a pair that was taken for one rotor is told from it
COAXIAL_SHARE = 0.06  # ... how the thrust of a coaxial arm divides: half of what the lower rotors' share may be off by
# Estimates, evenly spaced, that say what a loss was that is over: so few can be kept on board as they come.
ESTIMATES = 16


@dataclass(eq=False)
class Record:
    """One loss: rotors (0-based) that failed together and, as far as they did, ended together. shares: probability of each set of rotors
    that may have failed instead; data: the same as the data alone had it when it was announced; known, last: ticks of its first and last
    estimate; told: tick at which its end was known."""

    onset: float
    announced: int
    rotors: tuple[int, ...]
    shares: dict[tuple[int, ...], float]
    data: dict[tuple[int, ...], float]
    known: int
    last: int
    told: int = 0
    end: float | None = None
    loss: tuple[float, ...] = ()  # of opposite rotors that share a shift of thrust; the others' is in the estimates


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


def hidden_pairs(shares: dict, partners: dict, young: bool = False) -> tuple[tuple[int, ...], ...]:
    """Pairs that only their rarity, not the data, rules out against a single rotor: it and the one opposite.

    Losses on opposite rotors cancel in roll and pitch; gusts hide the rest in yaw and thrust. When the data favour such
    a pair by more than HIDDEN once prior weights are taken out, a small single loss must not be claimed. young: of a loss that
    has just been announced any pair: equal losses of two rotors look like one of the rotor between them until their yaw and thrust show.
    """
    best = next(iter(shares), ())
    if len(best) != 1:
        return ()
    rarity = hypotheses.WEIGHT["single"] / hypotheses.WEIGHT["pair"]
    pairs = [tuple(sorted((best[0], j))) for j in partners.get(best[0], ())]
    if young:
        pairs = [s for s in shares if len(s) == 2]
    return tuple(p for p in pairs if shares.get(p, 0.0) * rarity > HIDDEN * shares[best])


def opposite_shares(hyp: Hypotheses, log_odds: np.ndarray, partners: dict) -> dict[tuple[int, ...], float]:
    """Probabilities of the pairs of opposite rotors among each other."""
    pairs = [h for h, who in enumerate(hyp.rotors) if hyp.kinds[h] == "pair" and who[1] in partners.get(who[0], ())]
    weight = np.exp(log_odds[pairs] - log_odds[pairs].max())
    order = np.argsort(-weight)
    return {hyp.rotors[pairs[k]]: float(weight[k] / weight.sum()) for k in order}


def read(out, ticks: Ticks, hyp: Hypotheses, B: np.ndarray | None = None, flies: bool = False) -> tuple[Event, ...]:
    """Events of one flight from the diagnoser's stacked outputs (theta, theta_sd, announced, since, active, share, ...).

    At every announcement the estimator goes on with a few explanations; the one that leads when the next announcement is made, or at
    the end, is what happened. flies: the flight goes on, and what was announced a moment ago may still turn out to be a pair.
    """
    partners = opposites(B) if B is not None else {}
    records: list[Record] = []
    for first, last in _hops(ticks):
        open_: dict[int, Record] = {}
        suspected = _suspected(out, ticks, hyp, partners, first, last)
        records += suspected
        before: frozenset[int] = frozenset()
        births = [int(k) for k in np.flatnonzero(out.announced[first : last + 1]) + first]
        for k, stop in zip(births, [*[j - 1 for j in births[1:]], last]):
            sets = [frozenset(map(int, np.flatnonzero(row))) for row in out.active[stop]]
            onset = float(ticks.command_time[max(first, stop - round(float(out.since[stop])))])
            onset = min(onset, float(ticks.time[k]))
            now = sets[0]
            for record in list(dict.fromkeys(open_[r] for r in sorted(before - now))):
                gone = tuple(r for r in record.rotors if r not in now)
                if len(gone) < len(record.rotors):  # the others are weak still
                    records.append(_parted(record, gone))
                    record = records[-1]
                before_it = int(np.searchsorted(ticks.time, onset)) - 1  # the last estimate that knew nothing of it
                record.end, record.told, record.last = onset, k, max(record.announced, before_it)
                for r in gone:
                    del open_[r]
            new = tuple(sorted(now - before))
            if new:
                shares: dict[tuple[int, ...], float] = {}
                for who, share in zip(sets, out.share[stop]):
                    other = tuple(sorted(who - before))
                    if other:  # that nothing broke is weighed before anything is announced
                        shares[other] = shares.get(other, 0.0) + float(share)
                shares = {who: share / sum(shares.values()) for who, share in shares.items()}
                same = (out.active[k : stop + 1, 0] == out.active[stop, 0]).all(axis=1)
                found = k + int(np.flatnonzero(~same)[-1]) + 1 if not same.all() else k
                record = Record(onset, found, new, shares, rotor_sets(hyp, out.probability[k]), found, last)
                # What opposite rotors were suspected of is now known.
                for suspect in [s for s in suspected if s.announced < k][-1:]:
                    if suspect in records and set(new) <= set().union(*suspect.shares):
                        record.onset, record.announced = suspect.onset, suspect.announced
                        records.remove(suspect)
                records.append(record)
                open_ |= dict.fromkeys(new, record)
            before = now
        if last < len(ticks.time) - 1 and ticks.restart[last + 1 :].any():  # what lasted until the landing
            for record in dict.fromkeys(open_.values()):
                record.end, record.told = float(ticks.time[last]), last + 1
    judged = np.flatnonzero(ticks.mode == JUDGE)
    final = int(judged[-1]) if judged.size else len(ticks.time) - 1
    recent = round(SETTLES_S / ticks.dt) if flies else 0
    return tuple(
        _event(r, out, ticks, final, partners, B, final - r.announced < recent)
        for r in sorted(records, key=lambda r: r.announced)
    )


def accuses(event: Event) -> bool:
    """Is it an accusation? A loss that may be nothing, by its interval, and is said of one set of rotors alone is evidence, no more."""
    return bool(event.alternatives) or max(low for low, _ in event.interval) > 0.0


def one_arm(event: Event, B: np.ndarray) -> Event:
    """The event, with each rotor alone among its explanations where its two stand on one coaxial arm and together lack about one whole
    rotor. B (4, n).

    In all but yaw one rotor that is gone looks like parts of both, and what is left of the arm then gives another thrust and yaw than
    geometry says, because the air between the two has changed.
    """
    if len(event.rotors) != 2 or event.alternatives or lower_rotors(B) is None:
        return event
    i, j = (r - 1 for r in event.rotors)
    low, high = (sum(bounds) for bounds in zip(*event.interval))
    if np.abs(B[:2, i] / B[3, i] - B[:2, j] / B[3, j]).max() > 0.05 or not low < 1.0 < high:
        return event
    reason = f"{event.reason}, but one of them alone may be gone: the two stand on one arm"
    return replace(event, alternatives=tuple((r,) for r in event.rotors), reason=reason)


def _hops(ticks: Ticks) -> list[tuple[int, int]]:
    """First and last tick of every hop: until the last one that is judged."""
    starts = [0, *[int(k) for k in np.flatnonzero(ticks.restart) if k > 0]]
    spans = []
    for a, b in zip(starts, [*starts[1:], len(ticks.time)]):
        judged = np.flatnonzero(ticks.mode[a:b] == JUDGE)
        if judged.size:
            spans.append((a, a + int(judged[-1])))
    return spans


def _suspected(out, ticks: Ticks, hyp: Hypotheses, partners: dict, first: int, last: int) -> list[Record]:
    """Sudden shifts of thrust that may be two opposite rotors."""
    found = []
    for k in map(int, np.flatnonzero(out.opposite[first : last + 1] >= 0) + first):
        onset = float(ticks.command_time[max(first, k - round(float(out.opposite_onset[k])))])
        shares = opposite_shares(hyp, out.log_odds[k], partners)
        share = float(np.mean(out.opposite_loss[k]))  # only their sum shows
        found.append(Record(onset, k, hyp.rotors[out.opposite[k]], shares, shares, k, k, loss=(share, share)))
    return found


def _parted(record: Record, gone: tuple[int, ...]) -> Record:
    """A record of its own for those of its rotors that work again."""
    record.rotors = tuple(r for r in record.rotors if r not in gone)
    record.shares = {record.rotors: 1.0}
    record.data = {}
    return Record(record.onset, record.announced, gone, {gone: 1.0}, {}, record.known, record.last)


def _usual(record: Record, theta: np.ndarray, mode: np.ndarray) -> int:
    """The tick whose estimate of `theta` (T,) is what a loss that is over was for most of its time: the middle one (of two, the smaller) of
    ESTIMATES of its judged ticks at most, each a power of two of them after the one before."""
    seen = record.known + np.flatnonzero(mode[record.known : record.told] == JUDGE)
    if not seen.size:
        return record.last
    step = 1
    while seen.size > ESTIMATES * step:
        step *= 2
    seen = seen[::step]
    seen = seen[seen <= max(record.last, seen[0])]
    course = theta[seen]
    return int(seen[np.argmax(course == np.sort(course)[(course.size - 1) // 2])])


def sd_of(theta: np.ndarray, sd: np.ndarray, B: np.ndarray | None = None) -> np.ndarray:
    """Standard deviation of a loss with what the model of a vehicle with effectiveness B (4, n) is uncertain of.

    A rotor that makes up for theta is commanded T = 1 / (1 - theta), and gives T (1 + k (T - 1)) where the curve's slope is off by a
    share k: the loss then is k theta (1 - theta) / (1 - theta + k theta) larger.
    """
    coaxial = B is not None and lower_rotors(B) is not None
    k, left = np.hypot(CURVE_SHARE, COAXIAL_SHARE) if coaxial else CURVE_SHARE, np.clip(1.0 - theta, 1e-9, 1.0)
    return np.sqrt(sd**2 + MODEL_SD**2 + (k * theta * left / (left + k * theta)) ** 2)


def _event(record: Record, out, ticks: Ticks, final: int, partners: dict, B, young: bool) -> Event:
    k = min(record.last, final)
    if record.end is not None and not record.loss:  # a loss that is over: what it was for most of its time
        k = _usual(record, out.theta[:, record.rotors[0]], ticks.mode)
    rotors = record.rotors
    loss = np.array(record.loss) if record.loss else out.theta[k, list(rotors)]
    # Of a shared shift each rotor may hold anything from nothing to all.
    sd = loss / 1.96 if record.loss else sd_of(loss, out.theta_sd[k, list(rotors)], B)
    shares = record.shares
    own = shares.get(tuple(sorted(rotors)), max(shares.values(), default=0.0))
    paired = len(rotors) == 2 and rotors[1] in partners.get(rotors[0], ()) and len(partners) > 4
    others = [s for s, p in shares.items() if s and (p >= CREDIBLE or record.loss) and set(s) != set(rotors)]
    hidden = (
        () if record.loss else tuple(p for p in hidden_pairs(record.data, partners, young) if set(p) != set(rotors))
    )
    unsure = (
        own < (CERTAIN_OPPOSITE if paired else 1.0 / (1.0 + np.exp(-hypotheses.CLEAR)))
        or bool(hidden)
        or bool(record.loss)
    )
    if paired and unsure:  # all that only a manoeuvre could tell apart
        torque_free = {tuple(sorted((i, j))) for i, js in partners.items() for j in js}
        others += [s for s in sorted(torque_free) if s not in others and set(s) != set(rotors)]
    alternatives = (
        tuple(tuple(i + 1 for i in s) for s in (*hidden, *(o for o in others if o not in hidden))) if unsure else ()
    )
    names = " and ".join(str(i + 1) for i in rotors)
    if alternatives:
        reason = (
            f"commands and motion changed at {record.onset:.1f} s as if rotor {names} had lost thrust, but "
            + ", ".join("+".join(map(str, a)) for a in alternatives)
            + " would look the same"
            + (", and so would a sudden drop of battery voltage or more weight" if record.loss or paired else "")
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
        detected_s=float(ticks.time[record.announced]),
        end_s=record.end,
        loss=tuple(float(v) for v in loss),
        interval=tuple((max(0.0, float(v - 1.96 * s)), min(1.0, float(v + 1.96 * s))) for v, s in zip(loss, sd)),
        probability=float(own),
        alternatives=alternatives,
        reason=reason,
        extra={"loss_2s": [float(v) for v in (record.loss or out.theta[k2, list(rotors)])]},
    )
