"""Shapes: a mesh, its signed distance, nodes and mass; their folders; what contacts need of them."""
