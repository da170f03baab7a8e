"""A loss compared with what else explains the motion that followed: nothing, wind, the ground, a slow motor, another rotor.

A loss must predict the motion, on all axes, as well as the healthy model predicted the motion before; wind, a knock, the ground or a tether
need not have the direction of a rotor, nor follow its command. odds.py has the weights of the explanations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rotorwatch.base.arrays import quantile
from rotorwatch.engine.bindings.explaining import Explanation, Fit, Span, compare, lagged, span
from rotorwatch.engine.motion.tick_table import Ticks
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.witnesses import pushes
from rotorwatch.witnesses.odds import COMMON, Comparison, Rival, row
from rotorwatch.witnesses.witness import View

BEFORE_S, AFTER_S, OVER_S = 10.0, 20.0, 8.0  # s of the comparison: before the onset; after the detection, or the growth; after the end
SHORTEST_S, BRIEF_S = 3.0, 1.0  # of motion after the onset; of a loss that is over
FALLING_S, LEAST_S = 1.0, 0.2  # from a loss of control on, motion that tells rotors apart; the least
PUSH = Rival("push", Explanation(push=0.5, step=1.0))
# What else moves a vehicle: a step of the trim, in standard deviations of this flight's disturbances; one that grows with the thrust, as by
# a load that shifts; a centre of mass that moves: a drift of roll and pitch [hover thrusts per sqrt(s)], which grows with the thrust, and
# its lever in a side force; and a free wrench, as a factor of the disturbances.
ELSE = (
    *(Rival(f"step {step:g}", Explanation(step=step)) for step in (1.0, 4.0)),
    PUSH,
    Rival("push grows", Explanation(push=0.5, step=1.0, swells=0.07)),
    Rival("shift", Explanation(step=1.0, load=1.0)),
    *(Rival(f"move {x:g}, lever {y:g}", Explanation(drift=x, lever=y, load=1.0)) for x in (0.01, 0.04) for y in (0.0, 14.0)),
    Rival("wrench 3", Explanation(step=1.0, force=3.0)),
)  # fmt: skip
PASSED = " passes"  # of a push that is over
COMPANIONS = 2  # of these, the likeliest ones, that are tried beside the loss
TURNS = 2.0  # yaw by a turned mount, of that by the rotor's own torque
GROWS, SAGS = 0.02, 0.07  # of a loss that grows, 1 per sqrt(s); of one of all rotors
GIVES = 2.0  # of a rotor that is stuck: standard deviation of its thrust, hover thrusts
CAP = 0.75  # quantile of a rotor's commands that may be its cap
LATES_S = (0.08, 0.2)  # of a slow motor
LAGS_S = (0.0, 0.03, 0.06, 0.12)  # of all motors, beyond the lag that the ticks assume


def rivals(n: int, claim: tuple[int, ...], end_s: float, pushed_s: float = np.inf, cap: float = 0.0) -> list[Rival]:
    """The explanations of a change that is over at end_s, or at pushed_s if it was a push, of n rotors. claim: rotors, from 0, that the
    change is said to be a loss of: it comes first; cap: thrust that may be the most that they give [hover thrusts], 0: none."""
    rest = [Rival("nothing", Explanation()), *ELSE]
    rest += [Rival(PUSH.name + PASSED, PUSH.how._replace(end_s=pushed_s))] if pushed_s < np.inf else []
    rest += [Rival(f"slow {late:g} s", Explanation((i,), end_s, late=late)) for i in range(n) for late in LATES_S]
    rest += [Rival("turned", Explanation((i,), end_s, turned=TURNS)) for i in range(n)]
    rest += [Rival(COMMON, Explanation(tuple(range(n)), end_s, grows=SAGS))]
    singles = [one for i in range(n) if (i,) != claim for one in _losses((i,), end_s)]
    if not claim:
        return [*rest, *singles]
    own = _losses(claim, end_s)
    own += [Rival("capped", Explanation(claim, end_s, cap=cap))] if cap else []
    return [*own, *rest, *singles]


def _losses(who: tuple[int, ...], end_s: float) -> list[Rival]:
    """A loss of these rotors: at once, growing, or of their commands' effect."""
    return [
        Rival("loss", Explanation(who, end_s)), Rival("growing loss", Explanation(who, end_s, grows=GROWS)),
        Rival("stuck", Explanation(who, end_s, gives=GIVES)),
    ]  # fmt: skip


def beside(n: int, claim: tuple[int, ...], end_s: float, them: Sequence[Rival], logs: np.ndarray) -> list[Rival]:
    """The loss together with the likeliest of what else moves the vehicle; and so the likeliest slow rotor or turned mount, and a loss of
    each other rotor of n: what else moves a vehicle has more freedom than its model, of which any rotor's loss takes a part. A step beside
    a loss does not give its thrust back: else two rotors that lost two thirds each explain a mount that turned."""
    evidence = {r.name: x for r, x in zip(them, logs)}
    likely = sorted((k for k, r in enumerate(them) if r in ELSE), key=lambda k: -max(logs[k], evidence.get(them[k].name + PASSED, -np.inf)))
    likely = likely[:COMPANIONS]
    odd = them[max((k for k, r in enumerate(them) if r.how.late or r.how.turned), key=lambda k: logs[k])]
    own = [Rival("loss", them[k].how._replace(rotors=claim, end_s=end_s, lifts=False), them[k].name) for k in likely]
    # Theirs last: an end would open the trim once more, as no disturbance alone does.
    others = [i for i in range(n) if (i,) != claim]
    own += [Rival("loss", them[k].how._replace(rotors=(i,), lifts=False), them[k].name) for i in others for k in likely]
    same = {name: getattr(odd.how, name) for name in ("rotors", "end_s", "late", "turned")}
    return [*own, *(Rival(odd.name, them[k].how._replace(**same), them[k].name) for k in likely)]


def weigh(view: View, event: Event, events: Sequence[Event], named: bool = True, fall_s: float | None = None) -> Comparison | None:
    """A loss compared with its rivals; None where too little follows it to tell. events: all of the flight; named: the event's rotors are
    claimed, else any one may be; fall_s: time of a loss of control that follows at once."""
    assert view.learned is not None
    claim = tuple(r - 1 for r in event.rotors) if named else ()
    end_s = np.inf if event.end_s is None or not named else event.end_s
    where = _span(view, event, events, named, end_s, fall_s)
    if where is None:
        return None
    cap = quantile(where.ticks.thrust[where.onset :, list(claim)].max(axis=1), CAP) if claim else 0.0
    side = pushes.SideForce(where)
    shoves = side.shove(float(where.ticks.command_time[where.onset])), side.shove(end_s)
    pushed_s = end_s if end_s < np.inf else side.end_s()
    where = replace(where, ends=(end_s, pushed_s))
    them = rivals(view.B.shape[1], claim, end_s, pushed_s, cap)
    also = [tuple(r - 1 for r in who) for who in event.alternatives] if named else []
    them += [Rival("loss", Explanation(who, end_s)) for who in also if len(who) > 1]
    fits, said = _fitted(where, them, end_s, shoves), tuple(map(float, view.said(event.onset_s)))

    def compared() -> Comparison:
        return Comparison(
            event.onset_s, event.rotors, named, event.alternatives if named else (), event.source.name, "grew_until_s" in event.extra,
            view.B.shape[1], tuple(map(row, them, fits)), said,
        )  # fmt: skip

    if claim:
        more = beside(view.B.shape[1], claim, end_s, them, compared().logs())
        fits += _fitted(where, [them[0], *more], end_s, shoves)[1:]
        them += more
    return compared()


def _fitted(where: Span, them: Sequence[Rival], end_s: float, shoves: tuple[pushes.Shove, pushes.Shove]) -> list[Fit]:
    """The fit of each explanation, with what the side force says of a push that begins, or ends with the change at end_s. shoves: its
    steps then."""
    begins, ends = shoves
    lift = where.B.shape[1] * begins.lift
    fits = compare(where, [r.how._replace(lift=lift) if r.how.push else r.how for r in them])
    both = begins.log_odds + ends.log_odds
    said = [0.0 if not r.how.push or r.how.swells else both if r.how.end_s == end_s else begins.log_odds for r in them]
    return [fit._replace(log_p=fit.log_p + more) for fit, more in zip(fits, said)]


def _span(view: View, event: Event, events: Sequence[Event], named: bool, end_s: float, fall_s: float | None) -> Span | None:
    """The ticks that tell of an event that is over at end_s, or None where they are too few."""
    table, learned = view.clear, view.learned
    assert table is not None and learned is not None
    begun = event.extra.get("grew_until_s", event.detected_s) if named else event.onset_s
    # Up to the next loss, unless that leaves too little.
    others = [e.onset_s for e in events if e.kind == LOSS and e.onset_s > begun + SHORTEST_S and not set(e.rotors) & set(event.rotors)]
    again = [e.onset_s for e in events if e.kind == LOSS and e.onset_s > end_s and set(e.rotors) & set(event.rotors)]
    until = begun + AFTER_S if fall_s is None else max(begun, fall_s) + FALLING_S
    until = min([until, end_s + OVER_S, *others, *again])
    where = span(table, view.B, learned, event.onset_s, BEFORE_S, until, missing(table, events, event.rotors))
    least, brief = (SHORTEST_S, BRIEF_S) if fall_s is None else (LEAST_S, LEAST_S)
    if where.ticks.valid[where.onset :].any(axis=1).sum() * table.dt < least or min(end_s, until) - event.onset_s < brief:
        return None
    return _in_time(where)


def _in_time(where: Span) -> Span:
    """The span with its commands delayed by the lag of all motors that explains the motion before the change best."""
    early = replace(where, onset=round(1.0 / where.ticks.dt))
    before = [early] + [replace(early, ticks=lagged(where.ticks, where.B, lag)) for lag in LAGS_S[1:]]
    before = [replace(s, y=s.y + s.ticks.wrench - where.ticks.wrench) for s in before]
    fits = [compare(replace(s, ticks=s.ticks.part(slice(0, where.onset)), y=s.y[: where.onset]), [Explanation()])[0].log_p for s in before]
    return replace(before[int(np.argmax(fits))], onset=where.onset)


def missing(table: Ticks, events: Sequence[Event], but: Sequence[int] = ()) -> np.ndarray:
    """(T, n) thrust that losses take at the ticks, without those of some rotors, from 1."""
    lost = np.zeros_like(table.thrust)
    for e in events:
        if e.kind != LOSS or e.alternatives or set(e.rotors) & set(but):
            continue
        rows = (table.command_time >= e.onset_s) & (table.command_time <= (np.inf if e.end_s is None else e.end_s))
        for rotor, loss in zip(e.rotors, e.loss):
            lost[rows, rotor - 1] = loss
    return lost * table.thrust
