"""Runs a published method over a table, by JAX or as native code. Independent of methods, plants and logs.

run.py     steps an estimator over the rows, compiled once
native.py  the same by a C library, built once and kept
c99/       a traced step as C99; export/ makes projects for flight controllers of it
"""
