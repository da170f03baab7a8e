"""From a diagnosis to staying in the air: which commands still give the demanded thrust and moments when rotors are weak or dead.

    box.py          the exact least squares problem over a box, in a fixed number of turns
    allocation.py   demands (thrust, roll, pitch, yaw) -> commands of the rotors, by what is believed of each rotor
    certified.py    whether acting on a belief is better for every loss that is possible
    airframe.py     the numbers of a vehicle that its control is designed from
    excitation.py   a small excitation that moves nothing, unless rotors are weak: which ones?
    spinning.py     hover while turning, where it is impossible otherwise, and the feedback that holds it

Every thrust and moment that a vehicle can still give is worked out by `rotorwatch.toolkit.attainable`.

Everything that runs in flight is a pure step of fixed shapes, as estimators are: it runs under `scan` and `vmap` and can be
exported to C. What is worked out on the ground (attainable sets, gains) is NumPy and SciPy. See docs/control.md.
"""
