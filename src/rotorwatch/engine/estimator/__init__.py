"""The default estimator as a definition: ticks in, losses and evidence out (docs/methods/default.md, docs/one-definition.md).

In the order of the step: plant (what was commanded = motion + disturbances + what weak rotors did not deliver), noise, model_error, kalman,
bank, hypotheses, evidence, plausibility, announcement, opposite, posterior; estimator joins them, batch runs it over many ticks.
"""
