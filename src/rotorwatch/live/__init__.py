"""Judging vehicles while they fly. Data flows one way, from bytes to alerts.

endpoint.py   bytes of UDP, TCP and serial ports
frames.py     bytes to sound MAVLink frames
routes.py     the addresses that send under one id, and which of them is followed
senders.py    how many send from one address
clock.py      a vehicle's own time
mavlink.py    frames to samples
outliers.py   outputs that those before and after contradict
requests.py   what is requested of a vehicle: parameters, rates, who it is
link.py       one endpoint: its frames by vehicle, recorded
replay.py     a recorded flight instead of a link
window.py     the last seconds of a vehicle's signals
stream.py     samples to the diagnoser of `diagnose`, piece by piece
account.py    the way back, from an impact that is found later
beginnings.py losses in the blind time, looked for again
control.py    loss of control: samples of ten minutes to losses of control and their causes
reported.py   what the autopilot reports, and measures beyond limits
trust.py      whether what comes can be what flies
judge.py      what the diagnoser has written down to claims
session.py    one vehicle's stream, judge and loss of control
rotors.py     what ESC telemetry says of a vehicle that flies
changes.py    what is new about the events
watched.py    one vehicle, its alerts so far, and the health of its link
watch.py      all vehicles of all endpoints, in one loop
guard.py      displays and alerts, whose failures must not end the judging
record.py     a link as a telemetry log
view.py       them in a terminal
webhook.py    alerts to a web address
metrics.py    what is known of each vehicle, for Prometheus
ground.py     alerts to ground stations
mavproxy.py   the same in MAVProxy: its frames in, lines of its console and markers of its map out
"""
