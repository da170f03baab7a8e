"""Vehicles that departed controlled flight: when, why, and what their rotors did.

The default diagnosis (`default`) is causal and assumes hover, which a vehicle that turns over leaves within some tenths of a second. Here
everything that was logged up to the impact is compared with each possible behaviour of the rotors.

pegged.py           a rotor at full command while the vehicle turns against it
loss_of_control.py  when control was lost and came back, falls, impacts
balance.py          torques and thrust at any attitude: how well commands explain motion
explain.py          explanations: healthy, a rotor, all rotors, outputs on the wrong motors, an external torque
spinning.py         vehicles that spin and fly on, and which rotors they lost
find.py             the cause, and the events
"""

from rotorwatch.witnesses.witness import Events, Stage, View, Witness


def _pegged(view: View, claims: Events) -> Events:
    from rotorwatch.witnesses.upset import pegged

    return pegged.hear(view, claims)


WITNESSES = (Witness("pegged output", Stage.REVISION, 90, _pegged, needs=("motors",)),)
