"""Two estimators for rotorwatch from outside of it."""
