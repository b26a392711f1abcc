"""The environments that come with sdfsim. Each is short: read it, copy it, change it."""

from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.envs.task import Seen, Task
from sdfsim.geometry.mesh import lattice
from sdfsim.physics import pose
from sdfsim.scene.builder import SceneBuilder, loaded
from sdfsim.scene.scene import Body, Scene

WITHIN = 0.05  # m of the goal: success
APART = 0.01  # m between a body's free places and others
FLAT, SIDE, UP = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


class Push(Task):
    """A tool on two rails pushes a body to a free place on the table. Actions move the tool; the goal is relative to
    where the body stands in the scene.

    Options of `build`: `body`, a dynamic body that stands on something; None: the first one."""

    actions, observe, goal = 2, (), ((-0.15, -0.15), (0.15, 0.15))
    task_description = "Push the body to the goal."
    act = ("target rail_x", "target rail_y")
    stride, area = 0.06, 0.25  # m: how far the tool's target may be ahead of it, and from the middle

    def build(self, scene: Any, body: str | None = None) -> SceneBuilder:
        made = table() if scene is None else scene
        known, low, high = stands(made, body)
        self.body, start, tall = known.name, known.position, float(high[2] - low[2])
        goals, ways = free(made, known, 0.15), free(made, known, 0.1)
        self.goal = goals[0].tolist(), goals[1].tolist()
        self.half, self.radius = float((high - low)[:2].max()) / 2, float(np.clip(0.25 * tall, 0.02, 0.05))
        self.floor, away = low[2], self.half + self.radius + 0.12
        place = np.array([start[0] - away, start[1], low[2] + max(0.3 * tall, 1.1 * self.radius)])
        cart = {"size": [0.05, 0.05, 0.05]}
        heavy = max(0.5, 5 / 3 * known.mass)  # kg: the motors' stiffness follows from what they move
        made.add("cart", box=cart, position=place + 0.3 * UP, mass=heavy, collides_with=[])
        made.add("tool", sphere={"radius": self.radius}, position=place, mass=heavy, collides_with=[self.body])
        motor = {"max_force": 30.0 + 20.0 * known.mass, "position": 0.0, "time": 0.05}
        made.join("rail_x", "slider", "cart", axis=(1, 0, 0), motor=motor)
        made.join("rail_y", "slider", "tool", "cart", axis=(0, 1, 0), motor=motor)
        self.start, self.rail = start[:2], place[:2]
        self.observe = [f"{kind} {name}" for name in (self.body, "tool") for kind in ("position", "velocity")]
        self.observe += ["joint_position rail_x", "joint_position rail_y"]
        near = {"position": tuple(start + np.array([*way, 0.0]) for way in ways), "yaw": (-np.pi, np.pi)}
        material = {"friction": np.array([0.6, 1.2]) * known.friction, "mass": np.array([0.7, 1.3]) * known.mass}
        self.vary = {self.body: near | material}
        return made

    def axes(self, seen: Seen, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[W] m from the body to the goal, and [W, 2, 2] the axes along this way and to its left, in which the policy
        sees and acts: all directions are alike to it."""
        way = goal + self.start - seen[f"position {self.body}"][:, :2]
        far = np.linalg.norm(way, axis=1)
        ahead = way / np.maximum(far, 1e-9)[:, None]
        return far, np.stack([ahead, ahead[:, ::-1] * (-1.0, 1.0)], 1)

    def command(self, seen: Seen, goal: np.ndarray, actions: np.ndarray) -> np.ndarray:
        moved = np.einsum("wij,wi->wj", self.axes(seen, goal)[1], actions)
        place = seen["position tool"][:, :2] + self.stride * moved - self.start
        area = self.half + self.area
        return np.clip(place, -area, area) + self.start - self.rail

    def look(self, seen: Seen, goal: np.ndarray) -> np.ndarray:
        body, tool = (seen[f"position {name}"] for name in (self.body, "tool"))
        far, axes = self.axes(seen, goal)
        ways = (10.0 * (tool - body), seen[f"velocity {self.body}"], seen["velocity tool"])
        flat = [np.einsum("wij,wj->wi", axes, way[:, :2]) for way in ways]
        return np.concatenate([10.0 * far[:, None], 10.0 * (body[:, 2:] - self.floor), *flat], 1)

    def score(self, seen: Seen, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far the body is from the goal; and the tool from behind the body, from where it pushes towards the goal:
        along a circle around the body, so that it does not get stuck on the other side."""
        body, (far, axes) = seen[f"position {self.body}"], self.axes(seen, goal)
        back = seen["position tool"][:, :2] - body[:, :2]
        along, across = np.einsum("wij,wj->iw", axes, back)
        angle, reach = np.arctan2(np.abs(across), -along), self.half + self.radius
        aside = reach * angle + np.abs(np.hypot(along, across) - reach - 0.02 * np.minimum(angle, 1.0))
        return -20.0 * far - 3.0 * aside * np.minimum(1.0, far / WITHIN), far < WITHIN, body[:, 2] < self.floor - 0.02


class Grasp(Task):
    """A gripper on three rails lifts a body. Actions: its way in x, y and z, and how far it is shut."""

    actions, observe, goal = 4, (), ((0.05,), (0.1,))  # m to lift it
    task_description = "Lift the body."
    act = ("target rail_x", "target rail_y", "target lift", "target left", "target right")
    stride, opening = 0.05, 0.02  # m: how far a target may be ahead; what is free on each side of the body

    def build(self, scene: Any, body: str | None = None) -> SceneBuilder:
        made = table() if scene is None else scene
        known, low, high = stands(made, body)
        self.body, self.start = known.name, known.position
        start = self.start
        wide = float((high - low)[1]) / 2 + self.opening
        top = start * FLAT + (high[2] + 0.06) * UP
        size = {"size": [0.04, 0.01, 0.08]}
        for name, up in (("cart_x", 0.3), ("cart_y", 0.2), ("hand", 0.1)):
            made.add(name, box={"size": [0.04, 0.04, 0.04]}, position=top + up * UP, mass=0.5, collides_with=[])
        for name, side in (("left", -1.0), ("right", 1.0)):
            place = top + side * (wide + 0.005) * SIDE
            made.add(f"finger_{name}", box=size, position=place, mass=0.1, friction=1.0, collides_with=[self.body])
        motor = {"max_force": 60.0, "position": 0.0, "time": 0.05}
        made.join("rail_x", "slider", "cart_x", axis=(1, 0, 0), motor=motor)
        made.join("rail_y", "slider", "cart_y", "cart_x", axis=(0, 1, 0), motor=motor)
        made.join("lift", "slider", "hand", "cart_y", axis=(0, 0, 1), motor=motor)
        for name, side in (("left", 1.0), ("right", -1.0)):
            made.join(name, "slider", f"finger_{name}", "hand", axis=(0, side, 0), motor=motor | {"max_force": 15.0})
        self.rails = ["joint_position rail_x", "joint_position rail_y", "joint_position lift"]
        self.observe = [f"position {self.body}", f"velocity {self.body}", "position hand", *self.rails,
                        "joint_position left", "joint_position right"]  # fmt: skip
        near = {"position": (start - 0.05 * FLAT, start + 0.05 * FLAT)}
        self.vary = {self.body: near | {"mass": np.array([0.5, 1.0]) * known.mass}}
        return made

    def command(self, seen: Seen, goal: np.ndarray, actions: np.ndarray) -> np.ndarray:
        here = np.concatenate([seen[entry] for entry in self.rails], 1)
        shut = self.opening * (1.0 + actions[:, 3:])
        return np.concatenate([np.clip(here + self.stride * actions[:, :3], -0.2, 0.2), shut, shut], 1)

    def score(self, seen: Seen, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Metres from the hand's place above the body, and of height."""
        body = seen[f"position {self.body}"]
        away = np.linalg.norm(seen["position hand"] - 0.1 * UP - body, axis=1)
        lifted = body[:, 2] - self.start[2]
        return 20.0 * np.minimum(lifted, goal[:, 0]) - 5.0 * away, lifted > goal[:, 0] - 0.01, lifted < -0.05


class Drop(Task):
    """A body falls, and a wind that the policy makes brings it to a place. Actions: its force, in units of half the
    body's weight."""

    actions, observe, goal = 3, (), ((-0.15, -0.15), (0.15, 0.15))
    task_description = "Bring the falling body to the goal."
    seconds = 2.0

    def build(self, scene: Any, body: str | None = None, height: float = 0.3) -> SceneBuilder:
        made = table() if scene is None else scene
        known, low, _ = stands(made, body)
        self.body, self.start, self.floor, self.force = known.name, known.position, low[2], 0.5 * 9.81 * known.mass
        self.act = [f"force {self.body}"]
        self.observe = [f"{kind} {self.body}" for kind in ("position", "quat_xyzw", "velocity", "angular_velocity")]
        above = self.start + height * UP
        self.vary = {self.body: {"position": (above - 0.1 * FLAT, above + 0.1 * FLAT), "yaw": (-np.pi, np.pi)}}
        return made

    def command(self, seen: Seen, goal: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return self.force * actions

    def score(self, seen: Seen, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Metres to the goal; it is reached once the body rests there."""
        place, speed = (seen[f"{kind} {self.body}"] for kind in ("position", "velocity"))
        far = np.linalg.norm(place[:, :2] - self.start[:2] - goal, axis=1)
        still = np.linalg.norm(speed, axis=1) < 0.05
        return -10.0 * far, (far < WITHIN) & still, place[:, 2] < self.floor - 0.02


def table() -> SceneBuilder:
    """A mug-sized can on a table."""
    made = SceneBuilder(model="solver")
    made.add("table", box={"size": [1.0, 0.8, 0.04]}, position=(0, 0, 0.38), motion="static")
    return made.add("mug", cylinder={"radius": 0.04, "height": 0.1}, position=(0, 0, 0.45), mass=0.3)


def free(made: SceneBuilder | Scene, body: Body, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest way in x and y, m, up to `reach`, by which a body may move without meeting others that
    stand beside it."""
    low, high = np.full(2, -reach), np.full(2, reach)
    _, *own = stands(made, body.name)
    for other in loaded(made).bodies:
        if other.motion != "dynamic" or other.name == body.name or other.collides_with == ():
            continue
        _, *ends = stands(made, other.name)
        least, most = ends[0] - own[1] - APART, ends[1] - own[0] + APART  # ways between these make their boxes meet
        if least[2] < 0 < most[2]:
            room = np.maximum(least, -most)[:2]
            axis = int(room.argmax())
            if least[axis] > -most[axis]:
                high[axis] = np.clip(least[axis], 0.0, high[axis])
            else:
                low[axis] = np.clip(most[axis], low[axis], 0.0)
    return low, high


def stands(made: SceneBuilder | Scene, body: str | None) -> tuple[Body, np.ndarray, np.ndarray]:
    """A body (None: the first that moves), and the ends of the box around it, m. Raises SdfsimError if the scene has no
    such body."""
    scene = loaded(made)
    moving = [b for b in scene.bodies if b.motion == "dynamic"]
    found = next((b for b in moving if body in (None, b.name)), None)
    if found is None:
        raise SdfsimError(f"body: {body!r} is none that moves", f"these do: {', '.join(b.name for b in moving)}")
    bounds = scene.shapes[found.shape].sdf.bounds * found.scale
    corners = found.position + pose.rotate(found.quat_xyzw, lattice(*bounds.T))
    return found, corners.min(0), corners.max(0)
