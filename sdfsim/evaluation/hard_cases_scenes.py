"""The scenes of the hard cases: metre-sized boxes and balls on a floor, in the teacher's gravity.

Coefficients of the bodies and the floor are such that their products lie within what models are trained on, unless a
case is about them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.data.starts_resting import steady_faces
from sdfsim.scene.types import Body, Effects, Scene
from sdfsim.shape.shape import Shape, analytic_shape, shape_from_primitive

G = 10.0  # m/s^2
FRICTION, RESTITUTION = 0.8, 0.5  # of a body
FLOOR_FRICTION, FLOOR_RESTITUTION = 0.5, 0.5
NUDGE = 1e-3  # m and rad: how far repetitions of a case start from the exact one
PLATE = 0.01  # m, thickness of what fast bodies are thrown at
BRICK = (1.0, 0.5, 0.4)  # m
CARD = (0.06, 0.6, 1.0)  # m, thickness along x, standing
LEAN = 20.0  # degrees from upright
BALLS = 8  # dropped at once
BOXES = ((1.0, 1.0, 1.0), (1.0, 0.7, 0.5), (1.0, 0.5, 0.5), (0.4, 1.0, 0.8))  # m, of those tossed
WALL = 0.12  # of the bowl primitive, relative to its outer radius
BOWL_BALL = 0.5  # m, size of what is piled into the bowl

UP = np.array([0.0, 0.0, 1.0])


@cache
def box(*size: float) -> Shape:
    """A box with full extents m; one number makes a cube."""
    return analytic_shape("box", size=size if len(size) == 3 else size * 3)


@cache
def ball(diameter: float = 1.0) -> Shape:
    """A sphere."""
    return analytic_shape("sphere", radius=diameter / 2)


def body(name: str, shape: int, position: Sequence[float] | np.ndarray, **fields: Any) -> Body:
    """A dynamic body of 1 kg that does not move, unless `fields` say otherwise."""
    defaults: dict[str, Any] = {
        "motion": "dynamic",
        "scale": 1.0,
        "quat_xyzw": np.array([0.0, 0.0, 0.0, 1.0]),
        "velocity": np.zeros(3),
        "angular_velocity": np.zeros(3),
        "mass": 1.0,
        "friction": FRICTION,
        "restitution": RESTITUTION,
    }
    return Body(name=name, shape=shape, position=np.asarray(position, dtype=np.float64), **(defaults | fields))


def on_floor(
    shapes: Sequence[Shape],
    bodies: Sequence[Body],
    *,
    tilt: float = 0.0,
    friction: float = FLOOR_FRICTION,
    restitution: float = FLOOR_RESTITUTION,
    sleep: bool = False,
) -> Scene:
    """Bodies above the plane z = 0, which is the last of them.

    Args:
        shapes: of the bodies.
        bodies: all but the floor.
        tilt: degrees; instead of the floor it is gravity that leans, towards +x, which is the same.
        friction, restitution: of the floor.
        sleep: whether bodies may fall asleep.
    """
    fields: Any = {"motion": "static", "mass": 0.0, "friction": friction, "restitution": restitution}
    floor = body("floor", len(shapes), [0, 0, 0], **fields)
    angle = np.radians(tilt)
    return Scene(
        shapes=(*shapes, analytic_shape("plane")),
        bodies=(*bodies, floor),
        gravity=G * np.array([np.sin(angle), 0.0, -np.cos(angle)]),
        duration=1.0,
        effects=Effects(sleep="on" if sleep else "off"),
    )


def nudged(scene: Scene, repeat: int) -> Scene:
    """The same scene started slightly off: bodies shifted sideways by up to `NUDGE` and turned about z by as much.

    Args:
        scene: as it is meant.
        repeat: the seed; 0 leaves the scene exactly as it is.
    """
    if repeat == 0:
        return scene
    rng = np.random.default_rng(repeat)
    return replace(scene, bodies=tuple(_nudge(b, rng) if b.motion == "dynamic" else b for b in scene.bodies))


def _nudge(one: Body, rng: np.random.Generator) -> Body:
    turn = Rotation.from_euler("z", rng.uniform(-NUDGE, NUDGE)) * Rotation.from_quat(one.quat_xyzw)
    shift = np.array([*rng.uniform(-NUDGE, NUDGE, 2), 0.0])
    return replace(one, position=one.position + shift, quat_xyzw=turn.as_quat())


def yawed(scene: Scene, degrees: float) -> Scene:
    """The whole scene turned about the z axis."""
    turn = Rotation.from_euler("z", degrees, degrees=True)
    return replace(
        scene,
        gravity=turn.apply(scene.gravity),
        bodies=tuple(
            replace(
                b,
                position=turn.apply(b.position),
                quat_xyzw=(turn * Rotation.from_quat(b.quat_xyzw)).as_quat(),
                velocity=turn.apply(b.velocity),
                angular_velocity=turn.apply(b.angular_velocity),
            )
            for b in scene.bodies
        ),
    )


def started_off(scene: Scene, speed: float) -> Scene:
    """The same with every dynamic body's velocity along x changed by `speed` m/s."""
    off = np.array([speed, 0.0, 0.0])
    return replace(
        scene,
        bodies=tuple(replace(b, velocity=b.velocity + off) if b.motion == "dynamic" else b for b in scene.bodies),
    )


def overlapping(first: Shape, second: Shape, apart: float) -> Scene:
    """Two bodies of 1 m at floor height, their centres `apart` m from each other."""
    return on_floor([first, second], [body("first", 0, [0, 0, 0.5]), body("second", 1, [apart, 0, 0.5])])


def sunk(shape: Shape) -> Scene:
    """A body whose centre is in the floor."""
    return on_floor([shape], [body("sunk", 0, [0, 0, 0])])


def thrown_at_plate(speed: float, repeat: int) -> Scene:
    """Eight boxes and eight balls of 20 cm, anyhow turned, flying at `speed` m/s down to a plate of 1 cm.

    There is no floor below: what passes the plate falls on.
    """
    rng = np.random.default_rng(repeat)
    thrown = []
    for k in range(16):
        place = np.array([0.6 * (k % 4) - 0.9, 0.6 * (k // 4) - 0.9, 0.5])
        turn = Rotation.random(rng=rng).as_quat()
        thrown.append(body(f"thrown[{k}]", k % 2, place, quat_xyzw=turn, velocity=-speed * UP))
    static: Any = {"motion": "static", "mass": 0.0, "friction": FLOOR_FRICTION, "restitution": FLOOR_RESTITUTION}
    plate = body("plate", 2, [0, 0, -PLATE / 2], **static)
    shapes = (box(0.2), ball(0.2), box(3.0, 3.0, PLATE))
    return Scene(shapes, (*thrown, plate), gravity=-G * UP, duration=1.0)


def resting(shape: Shape, *, sleep: bool) -> Scene:
    """One body at rest on the floor: on that of its steady faces which already looks down most, else as it is."""
    vertices = shape.mesh.vertices - shape.com
    faces = steady_faces(vertices)
    turn = Rotation.identity()
    if len(faces):
        turn = Rotation.align_vectors([[0.0, 0.0, -1.0]], faces[faces[:, 2].argmin()][None])[0]
    low = turn.apply(shape.mesh.vertices)[:, 2].min()
    return on_floor([shape], [body("body", 0, [0, 0, -low], quat_xyzw=turn.as_quat())], sleep=sleep)


def tower(count: int) -> Scene:
    """`count` cubes of 1 m on top of each other."""
    return on_floor([box(1.0)], [body(f"block[{k}]", 0, [0, 0, 0.5 + k]) for k in range(count)])


def pyramid(layers: int = 4) -> Scene:
    """Cubes in a plane, one less in each layer, each over the gap between two."""
    places = [[1.05 * (i - (layers - k - 1) / 2), 0, 0.5 + k] for k in range(layers) for i in range(layers - k)]
    return on_floor([box(1.0)], [body(f"block[{n}]", 0, place) for n, place in enumerate(places)])


def wall(layers: int = 5, length: int = 4) -> Scene:
    """Bricks in running bond: every other layer is set off by half a brick, and has half a brick at either end."""
    long, deep, high = BRICK
    pitch = 1.01 * long  # sides do not touch
    bricks = []
    for k in range(layers):
        places = [(0, pitch * (i - (length - 1) / 2)) for i in range(length)]
        if k % 2:
            end = pitch * (length - 1) / 2 + long / 4
            places = [(1, -end), *((0, (a + b) / 2) for (_, a), (_, b) in pairwise(places)), (1, end)]
        for shape, x in places:
            mass = 0.5 if shape else 1.0
            bricks.append(body(f"brick[{len(bricks)}]", shape, [x, 0, high * (0.5 + k)], mass=mass))
    return on_floor([box(*BRICK), box(long / 2, deep, high)], bricks)


def card_house() -> Scene:
    """Two cards that lean against each other, upper edges touching over the middle."""
    thick, _, length = CARD
    angle = np.radians(LEAN)
    aside = 0.5 * (length * np.sin(angle) + thick * np.cos(angle))
    height = 0.5 * (length * np.cos(angle) + thick * np.sin(angle))
    cards = [
        body(
            name,
            0,
            [side * aside, 0, height],
            quat_xyzw=Rotation.from_euler("y", -side * LEAN, degrees=True).as_quat(),
        )
        for name, side in (("left", -1), ("right", 1))
    ]
    return on_floor([box(*CARD)], cards)


def heavy_on_light(ratio: float) -> Scene:
    """A cube of `ratio` kg on one of 1 kg."""
    return on_floor([box(1.0)], [body("light", 0, [0, 0, 0.5]), body("heavy", 0, [0, 0, 1.5], mass=ratio)])


def dropped(restitution: float, repeat: int) -> Scene:
    """Balls far from each other whose lowest points are 0.9 to 1.1 m above a floor of restitution 1.

    Not one height: how an engine bounces depends on how far above the floor a step happens to end.
    """
    heights = np.random.default_rng(repeat).uniform(0.9, 1.1, BALLS)
    balls = [
        body(f"ball[{k}]", 0, [4.0 * k, 0, 0.5 + height], restitution=restitution) for k, height in enumerate(heights)
    ]
    return on_floor([ball()], balls, restitution=1.0)


def slope(friction: float, degrees: float) -> Scene:
    """A flat box at rest on a slope; `friction` is the product of the two coefficients."""
    slab = body("slab", 0, [0, 0, 0.25], friction=friction / 0.8)
    return on_floor([box(1.0, 1.0, 0.5)], [slab], tilt=degrees, friction=0.8)


def bowl_radii(count: int) -> tuple[float, float]:
    """(inner, outer) radius m of a bowl with twice the room that `count` bodies take."""
    inner = BOWL_BALL * (2.0 * count / (4 * 0.6)) ** (1 / 3)
    return inner, inner / (1 - WALL)


def piled(count: int, repeat: int) -> Scene:
    """Balls and boxes in a loose lattice inside a bowl, and above it as far as they find no room."""
    rng = np.random.default_rng(repeat)
    inner, outer = bowl_radii(count)
    spacing = 1.2 * BOWL_BALL
    side = np.arange(-np.ceil(inner / spacing), np.ceil(inner / spacing) + 1) * spacing
    heights = np.arange(-np.floor(inner / spacing), 4 * len(side)) * spacing
    lattice = np.stack(np.meshgrid(side, side, heights), -1).reshape(-1, 3)
    reach = np.linalg.norm(np.minimum(lattice, [np.inf, np.inf, 0.0]), axis=1)
    free = lattice[reach < inner - 0.75 * BOWL_BALL]
    places = free[np.argsort(free[:, 2], kind="stable")][:count] + outer * UP
    places += rng.uniform(-0.02, 0.02, places.shape)
    turns = Rotation.random(count, rng=rng).as_quat()
    shapes = (ball(BOWL_BALL), box(0.6 * BOWL_BALL), shape_from_primitive("bowl", sdf="grid", name="bowl"))
    bodies = [body(f"piled[{k}]", k % 2, p, quat_xyzw=turns[k]) for k, p in enumerate(places)]
    static: Any = {"motion": "static", "mass": 0.0, "friction": FLOOR_FRICTION, "restitution": FLOOR_RESTITUTION}
    vessel = body("bowl", 2, [0, 0, outer], scale=2 * outer, **static)
    return on_floor(shapes, [*bodies, vessel])


def tossed(seed: Sequence[int]) -> Scene:
    """Three to eight boxes and balls of random size and material, thrown across each other as in MOVi."""
    rng = np.random.default_rng(seed)
    shapes = (ball(), *(box(*size) for size in BOXES))
    bodies: list[Body] = []
    places, radii = np.zeros((0, 3)), np.zeros(0)
    count = rng.integers(3, 9)
    while len(bodies) < count:
        index = 0 if rng.random() < 0.5 else int(rng.integers(1, len(shapes)))
        scale = rng.uniform(0.6, 1.2)
        radius = scale * float(np.linalg.norm(shapes[index].mesh.vertices, axis=1).max())
        place = rng.uniform([-2.5, -2.5, radius], [2.5, 2.5, 4.0])
        if (np.linalg.norm(places - place, axis=1) < radii + radius).any():
            continue
        places, radii = np.vstack([places, place]), np.append(radii, radius)
        aim = rng.uniform([-4.0, -4.0, 0.0], [4.0, 4.0, 0.0])
        fields = {
            "scale": scale,
            "quat_xyzw": Rotation.random(rng=rng).as_quat(),
            "velocity": aim - place * [1.0, 1.0, 0.0],
            "mass": shapes[index].volume * scale**3 * rng.uniform(1.0, 2.7),
            "friction": rng.uniform(0.4, 0.8),
            "restitution": rng.uniform(0.3, 0.7),
        }
        bodies.append(body(f"tossed[{len(bodies)}]", index, place, **fields))
    return on_floor(shapes, bodies)


def body_inertia(body: Body, shape: Shape) -> np.ndarray:
    """[3, 3] kg m^2 of a dynamic body about its centre of mass, shape axes."""
    if body.inertia is not None:
        return body.inertia
    return body.mass / shape.volume * body.scale**2 * shape.inertia
