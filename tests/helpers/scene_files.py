"""Scenes as text, and what is wrong with them."""

import pytest

from sdfsim import SceneError

SCENE = """
version: 1
duration: 0.4
shapes:
  box: {box: {size: [0.1, 0.1, 0.1]}}
bodies:
  - {name: floor, plane: {offset: 0.5}, friction: 0.8, restitution: 0.5}
  - {name: low, shape: box, position: [0, 0, 0.5501], mass: 1.0, friction: 0.5, restitution: 0.1}
  - {name: high, shape: box, position: [3, 0, 9], velocity: [1, 0, 0], angular_velocity: [0, 0, 2], mass: 2.0}
"""

HEAD = "version: 1\nshapes:\n  ball: {sphere: {radius: 0.5}}\nbodies:\n"  # bodies[0] is on line 5


def problems_of(load, text: str) -> list[str]:
    """The faults of a scene, without the folder in front of the file's name."""
    with pytest.raises(SceneError) as caught:
        load(text)
    return ["scene.yaml:" + line.split("scene.yaml:", 1)[1] for line in caught.value.problems]
