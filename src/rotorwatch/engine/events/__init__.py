"""From the estimator's ticks to events and their texts: one definition for logs, links and flight controllers (docs/one-definition.md).

decisions.py  thresholds of all decisions
carried.py    ticks in which the ground carries a part of the vehicle
records.py    data of losses: the estimator's result of a tick, records, estimates
losses.py     announcements -> losses
events.py     losses, overrides and contacts merged
changes.py    changes since the last evaluation
words.py      text of an event for the pilot
texts.py      selection and timing of the texts
reliance.py   effectiveness that control may rely on, rotors to leave out
calls.py      many samples or ticks in one call
"""
