"""Before a flight: which losses the vehicle would survive (survive), and what to fly to learn which rotors are weak (ask)."""
