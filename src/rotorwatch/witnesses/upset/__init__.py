"""Vehicles that left control: when, why, and what their rotors did.

A log need not be judged as it was flown. The default diagnosis (`default`) is causal, and believes in hover: a vehicle that turns over
leaves it some tenths of a second. Here all that was logged up to the impact is held against what each rotor may have done.

pegged.py           a rotor that is commanded all it has while the vehicle turns against it
loss_of_control.py  when control was lost and came back, falls, impacts
balance.py    torques and thrust at any attitude: how well commands explain motion
explain.py    explanations: healthy, a rotor, all rotors, outputs on the wrong motors, something from outside
find.py       the cause, and the events
"""

from rotorwatch.witnesses.witness import Events, Stage, View, Witness


def _pegged(view: View, claims: Events) -> Events:
    from rotorwatch.witnesses.upset import pegged

    return pegged.hear(view, claims)


WITNESSES = (Witness("pegged output", Stage.REVISION, 90, _pegged, needs=("motors",)),)
