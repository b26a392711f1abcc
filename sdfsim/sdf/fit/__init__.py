"""Fits SDF networks to exact distances: training, and the certificate at its end."""

from typing import Literal

Recipe = Literal["quick", "default"]

# Increase it whenever the same mesh would be fitted differently; it is part of every cache key.
FIT_VERSION = 8
