"""Statistics that the diagnosis, the fleet and the laboratory share: arrays in, numbers out.

tails.py           distribution functions and quantiles of the normal, of Student's t and of F
multivariate_t.py  flights compared with one another: Student's t of several variables
huber.py           robust regression and mean
nonnegative.py     least squares with unknowns that are not negative; the best assignment of rows to columns
"""
