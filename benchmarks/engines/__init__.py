"""Engines that only comparisons need: Drake and Newton."""
