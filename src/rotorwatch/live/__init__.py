"""Judging vehicles while they fly. Data flows one way, from bytes to alerts.

endpoint.py   bytes of UDP, TCP and serial ports
frames.py     bytes to sound MAVLink frames
senders.py    how many send under one id
clock.py      a vehicle's own time
mavlink.py    frames to samples
talk.py       what is asked of a vehicle: parameters, rates, who it is
link.py       one endpoint: its frames by vehicle, recorded
replay.py     a recorded flight instead of a link
window.py     the last seconds of a vehicle's signals
stream.py     samples to ticks: the front end of a diagnosis, piece by piece
account.py    losses, falls and contacts, with a way back
beginnings.py losses in the blind time, looked for again
control.py    loss of control: samples of ten minutes to departures and their causes
judge.py      ticks to events, and what is taken back when a landing is certain
session.py    one vehicle's stream, judge and loss of control
rotors.py     what ESC telemetry says of a vehicle that flies
changes.py    what is new about the events
watched.py    one vehicle, what was told of it, and the health of its link
watch.py      all vehicles of all endpoints, in one loop
beside.py     what is done besides judging and must not end it
record.py     a link as a telemetry log
view.py       them in a terminal
webhook.py    alerts to a web address
metrics.py    what is known of each vehicle, for Prometheus
ground.py     alerts told to ground stations
"""
