"""Mathematics that several methods share, and the plants that they run on (systems/): no logs in here."""
