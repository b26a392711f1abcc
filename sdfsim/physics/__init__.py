"""Rigid motion: bodies and states, free flight, the contact solve, and what judges a motion."""
