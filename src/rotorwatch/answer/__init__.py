"""From events to the answer that every view shows. No estimation happens here; the answer's data classes are in flight/diagnosis.py.

wording.py      the words for numbers, rotors and events
places.py       the location of a rotor, in words
health.py       grade of every rotor's loss, and its trend
trend.py        slope of a line under errors that wander, with its interval
unassessed.py     why a flight could not be assessed, or shows too little, and what would show more
unseen.py       the largest undetected loss, and lasting steps that wind could mask
drift.py        the trim of a whole flight: losses that grew, mounts and arms that turned
slow.py         losses that grew slowly or only seemed to end, merged with the others
from_takeoff.py damage from take-off, by comparison with healthy flights or vehicles
story.py        the sequence of a loss of control
ledger.py       all claims on a flight, and the rule that makes events of them
falls.py        the events with those of a loss of control
findings.py     the input to the conclusion
conclusion.py   verdict, reason, headline, main event, state of every rotor
by_method.py    an answer by a published method, with its own losses and intervals
advice.py       recommended actions
fitness.py      whether to fly again, and what explains the answer
settings.py     signals that a log lacks, and the settings that log them
common_mode.py  change of the thrust that all rotors together need
context.py      position, speed, battery, vibration: data that no verdict depends on
traces.py       time series for the plots of a flight
picture.py      data for the plot of a loss of control
"""
