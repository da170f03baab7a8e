"""Every threshold of a decision in one place, for the estimator, the witnesses and the answer.

docs/ablation.md shows the effect of each threshold. Limits of physical quantities and minimum durations are defined where they are used.
"""

# Explanations of one event
CREDIBLE = 0.03  # a set of rotors, or a cause, with less probability than this is not named
CLEAR = 10.0  # odds against all others from which an explanation is reported alone
SURE = CLEAR / (1.0 + CLEAR)  # the same as a probability
CERTAIN_NATS = 16.0  # log odds from which evidence is certain even without a plausible onset
CERTAIN = 0.99  # probability from which a single test, without time to confirm it, names or clears a rotor
LIKELY = 0.5  # probability of a cause shown by an ESC from which it is likelier than all others together
FALSE_ALARM_PERIOD_S = 10 * 3600.0  # specified mean time between false alarms, at least
SAME_S = 1.5  # onsets closer than this belong to one event

# Whole flights, compared with healthy flights or vehicles
FALSE_ALARM, FALSE_FAULT = (0.05, 0.01)  # share of the vehicle's healthy flights that differ as much, for a remark and for a fault
FALSE_FAULT_OF_ANY = 0.001  # the same for a fault against healthy vehicles of any build, of which there are few to learn from
DAMAGED = 0.95  # probability of damage to a rotor required for the verdict fault
MENTIONED = 0.05  # probability from which another cause is mentioned

# Sizes of losses
MATTERS = 0.2  # loss of one rotor from which it is degraded; `healthy` claims that all losses are smaller
WORN = 0.05  # loss of one rotor below which it is as good as new
TOTAL_LOSS = 0.8  # loss from which a rotor counts as totally lost
GRAVE = 0.5  # loss from which a rotor that hovers at half of its thrust can no longer carry its share
