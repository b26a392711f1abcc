"""From a scene and a model to a motion: single steps, and runs of many steps."""
