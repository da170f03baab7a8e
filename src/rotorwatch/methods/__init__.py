"""Published methods, one per file, and the mathematics they share.

estimators/   the methods: states and losses of a plant, step by step
maths/        what several of them use; maths/systems/ holds their plants
control/      commands for a vehicle whose rotors are weak or dead
compiling/    their steps run over a table, and as C99
published/    a method instead of the default one over a log; the autopilots' own checks
"""
