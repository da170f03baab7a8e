"""The conductor: one vehicle from its samples to its answer, the same for logs and links.

departures.py        losses of control of a flight that goes on, and impacts that end it
link_consistency.py  whether the samples of a link contradict each other
in_flight.py         events reconsidered while the vehicle flies
estimated.py         Estimated: an estimator's outputs at the ticks of a log
whole_log.py         a log through the engine, in one piece
verdict.py           claims -> bounds -> the conclusion
conductor.py         Case: samples -> engine -> departures -> witnesses -> ledger -> claims -> answer
"""
