"""A scene and a model become a motion: the step, and the runs that repeat it."""
