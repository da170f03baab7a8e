"""A published method run over a table: by JAX, or as machine code of this computer. Knows no method, no plant and no log.

run.py     steps an estimator over the rows, compiled once
native.py  the same by a C library, built once and kept
c99/       a traced step as C99; export/ makes projects for flight controllers of it
"""
