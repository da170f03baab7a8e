"""The default diagnosis, a file for each of its ideas; docs/methods/default.md derives them from one model.

plant: what was commanded = what the motion needed + disturbances + what weak rotors did not deliver. noise: how large disturbances are,
learned in the flight. caution: how far commands, motion and model can be believed. bank: what a jump at any time would have done to the
innovations. hypotheses: what may have jumped. announcement, plausibility: when that is said. posterior: explanations side by side after
it. estimator: the step that joins them. program: made runnable; learning: from healthy flights; events, leftover: its ticks put in words.
"""
