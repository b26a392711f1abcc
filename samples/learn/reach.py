"""An arm from a URDF learns to touch a ball on the floor, in some minutes of one core.

    python samples/learn/reach.py [-o reach]

The environment is the class below: any scene becomes one by naming what acts, what is seen and what counts.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from ppo import success, train

from sdfsim.apps.import_robot import import_robot
from sdfsim.base.errors import run_main
from sdfsim.envs import Task
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.scene import Scene

JOINTS = ("turn", "lift", "bend")


class Reach(Task):
    """Actions: how far the targets of the three motors are ahead of the joints. The goal is the ball itself, which lies
    somewhere else in each episode."""

    actions, seconds = 3, 3.0
    act = ("target turn", "target lift", "target bend")
    observe = (
        "position ball", "velocity ball", "force ball", "position tip", "velocity tip",
        *(f"joint_position {j}" for j in JOINTS),
    )  # fmt: skip
    task_description = "Touch the ball."

    def build(self, scene: Any) -> Scene:
        somewhere = (0.4, -0.35, 0.05), (0.7, 0.35, 0.05)
        self.vary = {
            "ball": {"position": somewhere},
            "bend": {"position": (0.5, 1.0)},
            "lift": {"position": (-1, -0.5)},
        }
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "arm.yaml"
            import_robot(Path(__file__).with_name("arm.urdf"), file, fixed=True, floor=True)
            made = SceneBuilder.read(file).add("ball", sphere={"radius": 0.05}, position=(0.5, 0.0, 0.05), mass=0.5)
            return made.load()  # while the files of its shapes exist

    def command(self, seen: Any, goal: np.ndarray, actions: np.ndarray) -> np.ndarray:
        here = np.concatenate([seen[f"joint_position {name}"] for name in JOINTS], 1)
        return np.clip(here + 0.3 * actions, (-3.0, -1.5, -2.5), (3.0, 1.5, 2.5))

    def look(self, seen: Any, goal: np.ndarray) -> np.ndarray:
        bent = np.concatenate([seen[f"joint_position {name}"] for name in JOINTS], 1)
        ball, tip = seen["position ball"], seen["position tip"]
        return np.concatenate([3.0 * ball, 3.0 * (ball - tip), seen["velocity tip"], np.sin(bent), np.cos(bent)], 1)

    def score(self, seen: Any, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The distance to the ball; it is touched, and the episode over, if more than the floor acts on it."""
        far = np.linalg.norm(seen["position ball"] - seen["position tip"], axis=1)
        touched = np.linalg.norm(seen["force ball"][:, :2], axis=1) > 0.01
        touched |= np.linalg.norm(seen["velocity ball"], axis=1) > 0.01
        return -5.0 * far, touched, touched


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("reach"))
    parser.add_argument("--steps", type=int, default=60_000, help="actions, in all worlds together")
    given = parser.parse_args()
    policy = train(Reach(64), given.out, given.steps)
    print(f"{success(Reach(200), policy, 10**6):.1%} of 200 new episodes end at the ball")


if __name__ == "__main__":
    run_main(main)
