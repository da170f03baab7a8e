"""Definitions in a subset of Python that translates to C (the engine is made of them). Knows no method, no plant and no log.

structs.py    the types for definitions
body.py       translation of functions to C
translate.py  translation of modules to one header and one source
running.py    execution by Python or as machine code
shipped.py    libraries shipped with the package
toolchain.py  the C compiler, and the folder of results
"""
