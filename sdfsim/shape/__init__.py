"""Shapes: a mesh with its signed distance, nodes and mass; shape folders; the geometry that contacts need."""
