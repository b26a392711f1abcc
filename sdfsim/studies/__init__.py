"""Studies: what the simulator costs, and where it fails."""
