"""The parts of the study in `benchmarks/sdf.py`, one file each, and what they share (`study`, `tables`, `render`)."""
