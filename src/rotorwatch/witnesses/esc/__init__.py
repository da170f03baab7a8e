"""The ESC consistency check: logged speeds and currents on a loss of thrust, and on motors that change without one.

telemetry.py    which telemetry records are usable
ratios.py       the mathematics: loss of speed, loss of the propeller, current; probabilities of the causes
causes.py       the form of the result in the answer
stopped.py      rotors that stopped, or lost their propeller
changed.py      motors that became slow or draw more current without a loss
following.py    rotors whose speed leaves what their command asks for, within samples
consistency.py  all of that for the events of a flight; without ESC telemetry they stay unchanged
"""

from rotorwatch.flight.kinds import HIGH, LOW, SLOW, Kind, Weight, Words, register
from rotorwatch.witnesses.witness import Events, Stage, View, Witness


def _notice(number: int, name: str, noun: str, meaning: str, verb: str, part: str) -> Kind:
    """A kind that ESC telemetry alone shows. verb: the motor's behaviour; part: the part to inspect."""
    why = "before the next flight: its ESC telemetry changed in flight, although no loss of thrust was found."
    past, advice = Words(f"{verb} since {{at}}"), Words(f"Inspect {part} {{who}} {why}")
    return Kind(number, name, noun, meaning, Weight.NOTICE, brief=verb, headline=Words(verb), past=past, advice=advice)


register(
    _notice(
        6,
        SLOW,
        "motor slower than commanded",
        "a motor turns slower than commanded, by its ESC telemetry",
        "turns slower than commanded",
        "motor, ESC, their connectors and supply wires of",
    ),
    _notice(
        7,
        HIGH,
        "motor draws more current",
        "more current at the same speed than before: a bearing",
        "draws more current than before",
        "the motor bearings of",
    ),
    _notice(
        8,
        LOW,
        "motor draws less current",
        "less current at the same speed than before: a propeller",
        "draws less current than before",
        "the propeller of",
    ),
)


def _hear(view: View, events: Events) -> Events:
    from rotorwatch.witnesses.esc import consistency

    if view.table is None:
        return events
    events, notes = consistency.check(view.flight, view.vehicle, view.air, view.table, events)
    view.warnings += notes
    return events


WITNESSES = (Witness("ESC telemetry", Stage.EVENTS, 10, _hear, needs=("esc", "motors")),)
