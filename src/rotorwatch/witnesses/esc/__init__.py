"""The ESC consistency check: what logged speeds and currents say about a loss of thrust, and about motors that change without one.

telemetry.py    what can be believed of the log's records
ratios.py       the mathematics: lost speed, lost propeller, current; the cause by their probabilities
evidence.py     what of it stands in the answer
stopped.py      rotors that stopped, or lost their propeller
watch.py        motors that became slow or hungry without a loss
consistency.py  all of that for the events of a flight; without ESC telemetry they stay unchanged
"""

from rotorwatch.witnesses.witness import Events, Stage, View, Witness


def _hear(view: View, events: Events) -> Events:
    from rotorwatch.witnesses.esc import consistency

    if view.table is None:
        return events
    events, notes = consistency.check(view.flight, view.vehicle, view.air, view.table, events)
    view.warnings += notes
    return events


WITNESSES = (Witness("ESC telemetry", Stage.EVENTS, 10, _hear, needs=("esc", "motors")),)
