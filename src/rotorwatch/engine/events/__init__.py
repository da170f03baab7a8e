"""From the estimator's ticks to events and their texts: one definition for logs, links and flight controllers (docs/one-definition.md).

decisions.py  thresholds of all decisions
records.py    what the estimator announced, tick by tick
losses.py     announcements -> losses
events.py     losses, outputs and contacts merged
changes.py    changes since the last look
words.py      an event as a text for the pilot
texts.py      which text is sent when
calls.py      many samples or ticks in one call
"""
