"""Judging vehicles while they fly. Data flows one way:

endpoint.py   bytes of UDP, TCP and serial ports; link.py: one of them, its frames by vehicle, recorded
mavlink.py    frames -> samples; clock.py: the vehicle's time; talk.py: what is asked of a vehicle: parameters, rates
replay.py     a recorded flight instead
window.py     the last seconds of a vehicle's signals
stream.py     samples -> ticks: the front end of a diagnosis, piece by piece
judge.py      ticks -> estimator -> events, and what is taken back when a landing is certain; history.py: the ticks it needs for that
session.py    one vehicle's stream and judge
changes.py    what is new about the events; watched.py: one vehicle with that and the health of its link
watch.py      all vehicles of all endpoints, in one loop; view.py: them in a terminal
"""
