"""From recorded motion to weights: contact frames, tasks, the training loop."""
