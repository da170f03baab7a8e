"""The nouns: a flight as its log records it, the vehicle that flew, the answer. Data in SI units and known frames; no estimation in here.

flight.py         signals, messages and parameters of a log
identity.py       whose flight is it? what a log holds that tells its aircraft apart
vehicle_kind.py   what a log is of, when it is no multirotor
output_functions.py  which output drives which motor, by the autopilots' parameters
vehicle.py        rotors, thrust curve, mixer, and what was learned of them
vehicle_file.py   the same as a TOML file
notebook.py       a flight as notebooks show it
kinds.py          the table of kinds of events: what each means, and what is said of it
method_series.py  what one method says over a flight: its own losses, states and innovations
diagnosis.py      the answer: verdict, rotors, events and the evidence for them
"""

from rotorwatch.flight.flight import Flight, Message, Signal

__all__ = ["Flight", "Message", "Signal"]
