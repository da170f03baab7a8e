"""When something is said: every threshold of a decision, in one place. The estimator, the witnesses and the answer take theirs from here.

What a threshold is worth is in docs/ablation.md. Limits of physical quantities, and what is long enough to be judged at all, stand where
they are used.
"""

# Explanations of one event
CREDIBLE = 0.03  # a set of rotors, or a cause, with less probability than this is not named
CLEAR = 10.0  # times as likely as all others: from that on an explanation stands alone
SURE = CLEAR / (1.0 + CLEAR)  # the same as a probability
CERTAIN_NATS = 16.0  # log-odds from which on evidence is certain without an onset to show
CERTAIN = 0.99  # probability from which on one test alone, without time to confirm it, names a rotor or clears it
LIKELY = 0.5  # of a cause that an ESC shows: more than all others together
FALSE_ALARM_PERIOD_S = 10 * 3600.0  # promised: no more than one in so long
SAME_S = 1.5  # onsets so close are of one event

# Whole flights, compared with healthy flights or vehicles
FALSE_ALARM, FALSE_FAULT = (0.05, 0.01)  # share of healthy flights of a vehicle that differ as much, for a word and for a fault
FALSE_FAULT_OF_ANY = 0.001  # for a fault, of healthy vehicles of any build: there are few to learn from
DAMAGED = 0.95  # probability of being damaged that a rotor needs for the verdict fault
MENTIONED = 0.05  # probability from which another cause is worth a word

# Sizes of losses
MATTERS = 0.2  # of one rotor, up to which `healthy` is a claim: from there on a rotor is degraded
WORN = 0.05  # of one rotor, below which it is as healthy as a new one
TOTAL_LOSS = 0.8  # from there on a rotor is lost altogether
GRAVE = 0.5  # from there on a rotor that hovers at half of its thrust cannot carry its share any more
