"""The default diagnosis, a file for each of its ideas; docs/methods/default.md derives them from one model.

plant: what was commanded = what the motion needed + disturbances + what weak rotors did not deliver. noise: how large disturbances are,
learned in the flight. model_error: what a tick's evidence counts, and how wrong the model may be at it. bank: what a jump at any time
would have done to the innovations. hypotheses: what may have jumped. announcement, plausibility: when that is announced. posterior:
explanations side by side after it. estimator: the step that joins them. program: made runnable; learning: from healthy flights; events,
residual_evidence: its ticks put in words.
"""
