"""Definitions in a part of Python that is also C (the engine is made of them). Knows no method, no plant and no log.

structs.py    the types that they are written in
body.py       functions of them as C
translate.py  modules of them as one header and one source
running.py    runs them, by Python or as machine code
shipped.py    libraries that come with the package
toolchain.py  the C compiler, and where results are kept
"""
