"""The parts of benchmarks/scale.py: our runs, other engines, accuracy, and the page that tells them."""
