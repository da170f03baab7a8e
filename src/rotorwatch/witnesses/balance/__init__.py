"""Rotors that are out of balance, by the vibration once per turn of each, in logs that hold an unfiltered sensor, and rotor speeds or the
commands that tell them.

hearing.py     which sensor hears, and which setting is missing where none does
tones.py       rotor speeds from commands and tones, where none are logged
orders.py      the orders of each rotor in windows: least squares at its angle
imbalances.py  one figure for each rotor, with its interval
unbalanced.py  against the other rotors, earlier flights, and the flight before
testimony.py   what that says on a loss of thrust, as log-odds

A propeller that lost a piece of a blade is out of balance long before its thrust shows it. Alone that is a notice, never a loss of thrust.
"""

from collections.abc import Iterator

from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import OUT_OF_BALANCE, UNBALANCED, Kind, Weight, Words, register
from rotorwatch.witnesses.witness import Stage, View, Witness, adding

ADVICE = (
    "Balance or replace the propeller of {who} before the next flight, and look for a chipped or bent blade, a loose hub and a worn motor "
    "bearing: it is out of balance, although no loss of thrust follows from that."
)
register(
    Kind(
        19, OUT_OF_BALANCE, "rotor out of balance", "a rotor vibrates once per turn more than others or in earlier flights", Weight.NOTICE,
        by_outputs=False, brief="out of balance",
        headline=Words("is out of balance"), past=Words("out of balance"), advice=Words(ADVICE),
    ),
    Kind(
        20, UNBALANCED, "rotor became out of balance", "a rotor vibrates once per turn more than before in the flight", Weight.NOTICE,
        by_outputs=False, brief="out of balance",
        headline=Words("became out of balance"), past=Words("out of balance since {at}"), advice=Words(ADVICE),
    ),
)  # fmt: skip


def _claims(view: View) -> Iterator[Event]:
    """A notice for each rotor that is, or became, out of balance; the figures go to `view.facts`."""
    from rotorwatch.witnesses.balance import hearing

    n, air = len(view.vehicle.rotors), view.air
    if view.lost:  # what follows shakes for other reasons
        air = tuple((start, min(end, view.lost[0])) for start, end in air if start < view.lost[0])
    if not air or hearing.deaf(view.flight, n) is not None:
        return
    from rotorwatch.answer.wording import rotors
    from rotorwatch.witnesses.balance import imbalances, testimony, unbalanced

    found = imbalances.listen(view.flight, n, air)
    if found is None:
        return
    view.facts["imbalance"] = found
    view.warnings += found.doubts
    earlier = (view.vehicle.identified or {}).get("imbalance", ())
    if found.measured:
        view.testimony.append(lambda onset: testimony.from_takeoff(found, earlier) if onset is None else testimony.at(found, onset))
    for one in unbalanced.findings(found, earlier):
        reason, extra = unbalanced.described(one, found.channel.unit, rotors(one.rotors))
        named, others = one.rotors[:1], tuple((r,) for r in one.rotors[1:])
        began = one.onset is not None
        onset = air[0][0] if one.onset is None else one.onset
        certain = min(air[-1][1], view.flight.duration) if one.certain is None else one.certain
        kind = UNBALANCED if began else OUT_OF_BALANCE
        yield Event(kind, named, onset, max(certain, onset), None, (), (), one.probability, others, reason, extra)


WITNESSES = (Witness("balance", Stage.CLAIMS, 60, adding(_claims), needs=("motors",)),)
