"""Judging vehicles while they fly. Data flows one way:

link.py, mavlink.py, parameters.py   an endpoint's bytes -> messages -> samples of each vehicle; parameters and rates asked for
replay.py     a recorded flight instead
window.py     the last seconds of a vehicle's signals
stream.py     samples -> ticks: the front end of a diagnosis, piece by piece
judge.py      ticks -> estimator -> events, and what is taken back when a landing is certain; history.py: the ticks it needs for that
session.py    one vehicle's stream and judge
changes.py    what is new about the events; watched.py: one vehicle with that and the health of its link
watch.py      all vehicles of all endpoints, in one loop
"""
