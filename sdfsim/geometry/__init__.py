"""Triangles: meshes and their files, solids, hierarchies over faces, mass, procedural shapes."""
