"""Python around the default estimator (engine/estimator/, derived in docs/methods/default.md): its definition run over ticks, and read.

plant, hypotheses: what goes in and what comes out, as arrays and in words; program: the estimator over ticks; default: as one
method among others; learning: what healthy flights teach it; events, residual_evidence: what it has found; shipping: machine
code for the package.
"""
