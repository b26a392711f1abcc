"""The keys of bodies and joints in scene.yaml as arguments, for type checkers. `schema` says what they mean and checks
their values; a test checks that both have the same keys."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np

from sdfsim.scene.scene import Motion
from sdfsim.shape.shape import SdfKind

Numbers = Sequence[float] | np.ndarray
Group = Mapping[str, Any]
Switch = bool | Literal["on", "off"]


class BodyKeys(TypedDict, total=False):
    """Keyword arguments of `Scene.add`: the keys of a body and those of its shape."""

    asset: Path | str | None
    mesh: Path | str | None
    primitive: Group | None
    sphere: Group | None
    capsule: Group | None
    box: Group | None
    cylinder: Group | None
    cone: Group | None
    torus: Group | None
    plane: Group | None
    parts: Sequence[Group] | None
    units: Literal["m", "cm", "mm", "in"] | None
    cap: Switch | None
    thicken: float | None
    centre: Switch | None
    round: Literal["auto", "off"] | None
    wall: float | None
    sdf: SdfKind | None
    resolution: int | None
    nodes: int | None
    shape: str | None
    motion: Motion | None
    position: Numbers | None
    quat_xyzw: Numbers | None
    quat_wxyz: Numbers | None
    euler_xyz_deg: Numbers | None
    velocity: Numbers | None
    angular_velocity: Numbers | None
    scale: float | None
    mass: float | None
    density: float | None
    inertia_factor: float | None
    friction: float | None
    restitution: float | None
    stiffness: float | None
    damping: float | None
    collides_with: Literal["all"] | Sequence[str] | None
    avoids: Sequence[str]
    path: Sequence[Group] | None
    color: Numbers | None
    count: int | None
    arrange: Group | None


class JointKeys(TypedDict, total=False):
    """Of `Scene.join`."""

    anchor: Numbers | None
    to: Numbers | None
    axis: Numbers | None
    frame: str | None
    start: float | None
    start_deg: float | None
    limits: Numbers | None
    limits_deg: Numbers | None
    cone_deg: float | None
    rod: float | None
    rope: float | None
    restitution: float | None
    damping: float | None
    friction: float | None
    armature: float | None
    spring: Group | None
    motor: Group | None
    breaks_at: Group | None
    collide: Switch | None
