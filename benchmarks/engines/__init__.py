"""Engines for comparisons only: Drake, Newton and Rapier."""
