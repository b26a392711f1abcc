"""Tracks of a film as a recording of a scene's motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sdfsim.apps.film.eye import Eye
from sdfsim.apps.film.frames import Clip
from sdfsim.apps.film.track import Track
from sdfsim.apps.observed import Recording, movers
from sdfsim.scene.scene import Scene

FINER = 8  # rows for a frame, if frames are not evenly spaced


def recording_of(clip: Clip, eye: Eye, tracks: Sequence[Track], scene: Scene) -> Recording:
    """Poses with their uncertainty, for the moving bodies of a scene, whose `tracks` these are in their order."""
    finer = 1 if clip.even else FINER
    dt = (clip.time[-1] - clip.time[0]) / (len(clip.time) - 1) if clip.even else clip.step / finer
    row = np.round((clip.time - clip.time[0]) / dt).astype(int)
    count, many, ways = row[-1] + 1, len(movers(scene)), eye.doubt.shape[1]
    late, seen = np.zeros(count), np.zeros((count, many), bool)
    late[row] = clip.time - clip.time[0] - dt * row
    place, turn = np.zeros((count, many, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, many, 1))
    root, rest, camera = np.zeros((count, many, 6, 6)), np.zeros((count, many, 6)), np.zeros((count, many, 6, ways))
    for d, track in enumerate(tracks):
        for k in track.frames.tolist():
            one, at = track.at(k), row[k]
            seen[at, d], place[at, d], turn[at, d] = True, one.place, one.turn
            root[at, d], rest[at, d], camera[at, d] = one.root, one.rest, one.camera @ eye.doubt
    none = np.zeros_like(place)
    return Recording(
        str(clip.path), float(dt), place.copy(), turn.copy(), none, none.copy(), np.array(seen.all(1)),
        np.zeros_like(seen), seen, (place, turn), root=root, rest=rest, camera=camera, late=late,
        lost=int(len(clip.time) * many - seen.sum()),
    )  # fmt: skip
