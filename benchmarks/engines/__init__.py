"""Engines for comparisons only: Drake and Newton."""
