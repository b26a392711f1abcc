"""The networks: `impulse`, which acts on top of the contact solve; SDF-Sim as published (`sdf-sim`), and its
baselines."""
