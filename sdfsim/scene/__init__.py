"""Scene files, what they become, and the plan of what is in play in them."""
