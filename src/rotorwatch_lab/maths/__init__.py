"""Mathematics that several methods share: no logs in here."""
