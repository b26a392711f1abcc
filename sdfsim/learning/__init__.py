"""From trajectories to weights: the teacher, the recipes, the dataset format, training and evaluation."""
