"""A scene and a model become a motion: steps, and the runs that repeat them."""
