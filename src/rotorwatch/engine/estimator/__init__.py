"""The default estimator: ticks in, losses and evidence out (docs/methods/default.md, docs/one-definition.md).

Modules in the order of the step: plant (commanded wrench = motion + disturbances + shortfall of weak rotors), noise, model_error, kalman,
bank, hypotheses, evidence, plausibility, announcement, opposite, posterior; estimator joins them, batch runs it over many ticks.
"""
