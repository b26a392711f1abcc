"""An arm takes the vase of a reconstruction by its neck, lifts it and puts it down elsewhere.

    sdfsim reconstruct samples/photos/table_vase -o room --preset quick
    python samples/grasp.py room object1            # writes room/grasp.mp4, and the run folder room/grasp

Its targets come from inverse kinematics with `Simulator.jacobian`, on a second simulator of the same scene.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import sdfsim

ARM = ("yaw", "shoulder", "elbow", "wrist")
OPEN, SHUT = 0.085, 0.02  # m, of each finger from the middle; it shuts until it meets the vase
MOTOR = {"max_force": 150.0, "position_deg": 0.0, "time": 0.05}


def add_arm(scene: sdfsim.Scene, x: float, y: float, z: float) -> None:
    """An arm that stands upright on a column at (x, y), whose top is at z, with a gripper."""
    grey, blue = (70, 72, 78), (60, 110, 170)
    scene.add("column", box={"size": (0.12, 0.12, z)}, position=(x, y, z / 2), motion="static", color=grey)
    scene.add("turret", cylinder={"radius": 0.05, "height": 0.06}, position=(x, y, z + 0.03), mass=1.0, color=blue)
    height, below = z + 0.06, "turret"
    scene.join("yaw", "hinge", "turret", "column", anchor=(x, y, z), axis=(0, 0, 1), motor=MOTOR)
    for name, link, length, mass in (("shoulder", "upper", 0.4, 2.0), ("elbow", "lower", 0.4, 1.2)):
        size = {"radius": 0.03, "height": length}
        scene.add(link, capsule=size, position=(x, y, height + length / 2), mass=mass, color=grey)
        scene.join(name, "hinge", link, below, anchor=(x, y, height), axis=(0, 1, 0), motor=MOTOR)
        height, below = height + length, link
    palm = [
        {"box": {"size": (0.05, 0.22, 0.03)}},
        {"cylinder": {"radius": 0.025, "height": 0.06}, "position": (0, 0, -0.03)},
    ]
    scene.add("hand", parts=palm, position=(x, y, height + 0.06), mass=0.4, color=blue)
    scene.join("wrist", "hinge", "hand", "lower", anchor=(x, y, height), axis=(0, 1, 0), motor=MOTOR)
    for side, name in ((1.0, "left"), (-1.0, "right")):
        pad = {"size": (0.03, 0.012, 0.12)}
        scene.add(
            name, box=pad, position=(x, y + side * (OPEN + 0.006), height + 0.135), mass=0.1, friction=1.2, color=grey
        )
        scene.join(f"{name} finger", "slider", name, "hand", axis=(0, side, 0), start=OPEN, limits=(0, 0.1))
    scene.joints[-2]["motor"] = {"max_force": 60.0, "position": OPEN, "time": 0.05}
    scene.couple("right finger", "left finger")
    scene.frame("grip", "hand", position=(0, 0, 0.11))


def reach(plan: sdfsim.Simulator, point: np.ndarray) -> np.ndarray:
    """[4] rad, angles of the arm with the grip at a point [3] m and the hand level, by damped least squares."""
    plan.reset()
    columns = [plan.joint_columns[name].start for name in ARM]
    plan.joint("shoulder").angle, plan.joint("elbow").angle, plan.joint("wrist").angle = -0.3, 1.8, 0.07
    for _ in range(100):
        q = plan.joint_positions
        level = np.pi / 2 - q[columns[1:]].sum()
        error = np.append(point - plan.frame("grip").position, level)
        slope = np.vstack([plan.jacobian("grip")[:3, columns], [0.0, 1.0, 1.0, 1.0]])
        q[columns] += slope.T @ np.linalg.solve(slope @ slope.T + 1e-4 * np.eye(4), error)
        plan.set_joints(q)
    assert np.abs(error).max() < 1e-3, f"the arm does not reach {point}"
    return plan.joint_positions[columns]


def main(folder: Path, name: str) -> None:
    room = sdfsim.load_scene(folder / "scene.yaml")
    body = next(body for body in room.bodies if body.name == name)
    high = body.scale * room.shapes[body.shape].mesh.vertices[:, 2].max()
    neck = body.position + np.array([0.0, 0.0, 0.82 * high])
    scene = sdfsim.Scene.read(folder / "scene.yaml")
    add_arm(scene, *neck - [0.68, 0.0, 0.15])
    moving, plan = sdfsim.Simulator(scene), sdfsim.Simulator(scene)
    joints, fingers = [moving.joint(joint) for joint in ARM], moving.joint("left finger")
    up, aside = np.array([0.0, 0.0, 0.1]), np.array([-0.1, 0.03, 0.0])
    base = neck - [0.68, 0.0, 0.0]

    def before(point: np.ndarray) -> np.ndarray:
        """A place nearer to the arm, from which its fingers go straight to a point."""
        return point - 0.16 * (point - base) / np.linalg.norm(point - base)

    # Where the grip goes, in how many s, and where the fingers then are.
    way = [
        (before(neck), 1.2, OPEN), (neck, 0.8, OPEN), (neck, 0.4, SHUT), (neck + up, 0.8, SHUT),
        (neck + up + aside, 0.9, SHUT), (neck + aside + [0.0, 0.0, 0.002], 1.0, SHUT), (neck + aside, 0.4, OPEN),
        (before(neck + aside), 0.9, OPEN),
    ]  # fmt: skip
    now, wide = np.zeros(4), OPEN
    with moving.record() as run:
        for point, seconds, width in way:
            goal, count = reach(plan, point), moving.steps_in(seconds)
            for k in range(1, count + 1):
                share = k / count
                for joint, angle in zip(joints, now + (3 - 2 * share) * share**2 * (goal - now), strict=True):
                    joint.target = angle
                fingers.target = wide + share * (width - wide)
                moving.step()
            now, wide = goal, width
            grip = moving.frame("grip").position
            print(f"grip at {np.round(grip, 4)} m, {name} at {np.round(moving[name].position, 4)} m")
    sdfsim.save_run(moving, run, folder / "grasp")
    camera, look_at = neck + np.array([-0.75, -1.15, 0.45]), neck + np.array([-0.2, 0.05, -0.05])
    film = folder / "grasp.mp4"
    sdfsim.render(moving.scene, run.rollout, film, camera=camera, look_at=look_at, fps=15, size=(640, 360))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
