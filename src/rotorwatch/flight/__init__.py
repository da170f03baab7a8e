"""Data classes: a flight as its log records it, the vehicle that flew, the answer. In SI units and known frames; no estimation here.

flight.py            signals, messages and parameters of a log
identity.py          the aircraft of a flight, by what a log holds of it
vehicle_kind.py      the kind of vehicle of a log, when it is no multirotor
output_functions.py  which output drives which motor, by the autopilots' parameters
vehicle.py           rotors, thrust curve, mixer, and learned parameters
vehicle_file.py      the same as a TOML file
display.py           display of a flight in notebooks
kinds.py             the table of kinds of events: meaning and texts
method_series.py     a method's own losses, states and innovations over a flight
diagnosis.py         the answer: verdict, rotors, events and the evidence for them
"""

from rotorwatch.flight.flight import Flight, Message, Signal

__all__ = ["Flight", "Message", "Signal"]
