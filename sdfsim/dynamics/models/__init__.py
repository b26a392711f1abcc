"""The networks: SDF-Sim as published (`paper`), and `impulse`, which acts on top of the contact solve."""
