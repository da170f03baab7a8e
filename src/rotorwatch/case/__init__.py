"""The conductor: one vehicle from its samples to its answer, the same for logs and links.

departures.py    losses of control of a flight that goes on, and impacts that end it
link_consistency.py whether the samples of a link contradict each other
conductor.py     Case: samples -> engine -> departures -> witnesses -> ledger -> events
verdict.py       LogCase, a log that is over: its events -> verdict
"""
