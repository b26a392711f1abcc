"""Scene files, the scenes that they become, and the plan: which effects are on in a scene."""
