"""From events to the one answer that every view shows. Nothing is estimated in here; the answer's data are in flight/diagnosis.py.

wording.py      the words for numbers, rotors and events
places.py       where a rotor sits, in words
health.py       grade of every rotor's loss, and its trend
trend.py        slope of a line under errors that wander, with its interval
unjudged.py     why a flight could not be judged, or shows too little, and what would show more
unseen.py       how large a loss can be that has not been announced, and whether one has stayed that wind hides
trim.py         what the trim of a whole flight shows: losses that grew, mounts and arms that turned
slow.py         losses that grew slowly or only seemed to end, with the others
from_takeoff.py damage from take-off, as healthy flights or vehicles show it
story.py        what happened when control was lost, in time order
ledger.py       all that is claimed of a flight, and the one rule that makes events of the claims
falls.py        the events with those of a loss of control
evidence.py     what a conclusion is drawn from
conclusion.py   verdict, reason, headline, main event, state of every rotor
by_method.py    an answer by a published method: whose losses and intervals are whose
advice.py       what to do next
common_mode.py  how much more thrust all rotors together need at the end
context.py      where it flew, how fast, battery, vibration: what no verdict depends on
traces.py       what a picture of the flight needs
picture.py      what a picture of a loss of control needs
"""
