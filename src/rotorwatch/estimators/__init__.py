"""Estimators: one method a file, found by discovery."""
