"""The networks: SDF-Sim as published (`sdf-sim`), and `impulse`, which acts on top of the contact solve."""
