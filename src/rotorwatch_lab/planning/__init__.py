"""Preflight analysis: losses that the vehicle would survive (survive), and excitations that show which rotors are weak (ask, of what a log
leaves open: question)."""
