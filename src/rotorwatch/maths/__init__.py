"""Mathematics that several methods share: no logs, no aircraft in here."""
