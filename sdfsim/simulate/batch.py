"""Many scenes in one call: each a world of one set of bodies, which never meets the others."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sdfsim.physics.bodies import Bodies, State, Units, from_scene
from sdfsim.scene.scene import Scene


def side_by_side(scene: Scene, world: Sequence[int], units: Units) -> tuple[Bodies, State]:
    """The bodies of a scene, each in its `world` [N] of 0, 1, ...; those in -1, behind all others, are in all of them.
    In model units."""
    bodies, state = from_scene(scene, units)
    return replace(bodies, world=np.array(world, dtype=np.int64)), state


def placed(
    state: State, position: np.ndarray, orientation: np.ndarray, velocity: np.ndarray, angular_velocity: np.ndarray
) -> State:
    """The first bodies as arrays [K, *] have them, in model units; those behind them, of all worlds, as they are."""

    def of(rows: np.ndarray, known: np.ndarray) -> np.ndarray:
        return np.concatenate([rows, known[len(rows) :]])

    return replace(
        state,
        position=of(position, state.position),
        orientation=of(orientation, state.orientation),
        velocity=of(velocity, state.velocity),
        angular_velocity=of(angular_velocity, state.angular_velocity),
    )
