"""Preflight analysis: losses that the vehicle would survive (survive), and excitations that show which rotors are weak (ask)."""
