"""An estimator run over a table: by JAX, or as machine code of this computer. Knows no method, no plant and no log.

run.py        steps an estimator over the rows, compiled once
native.py     the same by a C library, built once and kept
shipped.py    libraries that come with the package
toolchain.py  the C compiler, and where results are kept
c99/          a traced step as C99; export/ makes projects for flight controllers of it

And definitions in a part of Python that is also C (front/ is made of them):

structs.py    the types that they are written in
body.py       functions of them as C
translate.py  modules of them as one header and one source
running.py    runs them, by Python or as machine code
"""
