"""Signed distances: closed forms, networks, grids, and the true distance of meshes."""
