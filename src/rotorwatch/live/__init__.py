"""Evaluation of vehicles in flight. Data flows one way, from bytes to alerts.

endpoint.py   bytes of UDP, TCP and serial ports
framing.py    bytes to valid MAVLink frames
routes.py     the addresses that send under one id, and the choice of the one to follow
senders.py    number of senders behind one address
clock.py      a vehicle's own time
mavlink.py    frames to samples
outliers.py   outputs that contradict those before and after
requests.py   requests to a vehicle: parameters, rates, identity
link.py       one endpoint: its frames by vehicle, recorded
replay.py     a recorded flight instead of a link
session.py    one vehicle: its case, and its state in words
esc_notices.py ESC telemetry of a flying vehicle
alert_states.py changes of the list of events
watched.py    one vehicle, its alerts so far, and the health of its link
watch.py      all vehicles of all endpoints, in one loop
guard.py      isolation of displays and alerts, whose failures must not end the evaluation
record.py     a link as a telemetry log
view.py       all vehicles in a terminal
snapshot.py   the state of a vehicle at one moment
ground.py     alerts in the words of a ground station
ground_events.py  alerts as MAVLink events, and their definitions
channels/     destinations of alerts besides the screen, a file each
mavproxy.py   the same in MAVProxy: its frames in, lines of its console and markers of its map out
"""
