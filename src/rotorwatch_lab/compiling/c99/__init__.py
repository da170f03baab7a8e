"""From a traced function to C99 that depends on libm alone.

lower.py      jaxpr -> graph: calls inlined, constants folded, indices made constant tables; refusals
graph.py      the graph: each value once, slices, transposes and broadcasts as affine views
selections.py products with constants that pick and scale: no products
operations.py element-wise operations: what NumPy and what C call them
zeros.py      what is known to be zero: products with sparse Jacobians term by term
plan.py       which values get storage, for how long, and who shares it
indices.py    constant indices of gathers and scatters as tables
kernels.py    products, factors, triangular systems as C loops
emit.py       the graph as C statements
project.py    header, source, example, CMakeLists of a function with named inputs, state and outputs
"""
