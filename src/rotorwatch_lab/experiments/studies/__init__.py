"""Comparisons, false alarms, tuning by hand, and the experiments of the papers (reproduce_<paper>.py) with the flights they need."""
