"""From recorded motion to weights: contact frames, tasks, and the training loop."""
