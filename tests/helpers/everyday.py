"""How many checks of everyday scenes there are, and which do not hold."""

# Checks by row: of closed forms where a shape has one, and of meshes and grids.
COUNTS = {
    "slender": (6, 6), "heaps": (16, 16), "seams": (61, 61), "thin_floors": (30, 30), "rolling": (96, 160),
    "facets": (14, 14), "round_on_meshes": (56, 56), "flat_drops": (108, 108), "slabs": (90, 90), "spins": (28, 28),
    "gentle": (9, 4), "edges": (21, 21), "elastic": (5, 5), "bullets": (6, 6), "before_touch": (8, 8),
}  # fmt: skip
MISSED = {
    "analytic": {"heaps: pencil over a bowl: overlap"},
    "mesh": {"heaps: pencil over a bowl: overlap"},
    "grid": {"heaps: pencil over a bowl: overlap", "heaps: pencil over a bowl: height"},
}  # fmt: skip
