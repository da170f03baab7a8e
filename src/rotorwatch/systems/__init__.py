"""Plants: one file each, found by discovery."""
