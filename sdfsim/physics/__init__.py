"""Rigid motion: bodies and states, free flight, the contact solve, and the instruments that judge a motion."""
