"""Recorded motion: the teacher (PyBullet), its scenarios, the dataset format, and simulations from recordings."""
