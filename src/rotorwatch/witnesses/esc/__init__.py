"""The ESC consistency check: logged speeds and currents on a loss of thrust, and on motors that change without one.

telemetry.py    which telemetry records are usable
ratios.py       the mathematics: loss of speed, loss of the propeller, current; probabilities of the causes
causes.py       the form of the result in the answer
stopped.py      rotors that stopped, or lost their propeller
changed.py      motors that became slow or draw more current without a loss
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
