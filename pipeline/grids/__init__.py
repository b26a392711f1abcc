"""Grids of values between which torch and compiled code interpolate."""
