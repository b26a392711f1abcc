"""Recorded motion: the teacher, its scenarios, the dataset format, and what is read off recordings."""
