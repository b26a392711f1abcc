"""The networks: `impulse`, on bodies, and SDF-Sim as published (`sdf-sim`), on surface nodes."""
