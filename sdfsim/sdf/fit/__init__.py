"""SDF networks from exact distances: training, and the certificate at its end."""

from typing import Literal

Recipe = Literal["quick", "default", "paper"]

# Changes whenever the same mesh would come out differently; part of every cache key.
FIT_VERSION = 8
