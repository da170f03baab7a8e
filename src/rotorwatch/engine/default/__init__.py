"""The default diagnosis; docs/methods/default.md derives it from one model, and engine/estimator/ is its estimator,
a file for each idea.

program: the estimator run over ticks; learning: from healthy flights; events, residual_evidence: its ticks put in words; shipping: machine
code for the package.

plant is also the plant of published methods. noise, model_error, kalman, bank, hypotheses, evidence, plausibility, announcement, opposite,
posterior and estimator are the same method as a step that JAX traces, for accelerators and `export-c default`: tests hold the two together.
"""
