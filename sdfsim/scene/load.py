"""`load_scene`: scene.yaml -> `Scene`, with every fault of the file reported at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from sdfsim.errors import SdfsimError
from sdfsim.scene.bodies import BodySpec
from sdfsim.scene.schema import SceneSpec, ShapeSpec, read_scene
from sdfsim.scene.types import Body, Scene
from sdfsim.shape.shape import (
    SdfKind,
    Shape,
    analytic_shape,
    load_shape,
    shape_from_mesh,
    shape_from_primitive,
    with_nodes,
    with_sdf,
)

Progress = Callable[[float, str], None]

_FITTED = ("mesh", "primitive")  # kinds of shapes that are fitted (or sampled) on first use
_PLANE = ""  # the key of the one plane shape that all bodies with a `plane:` of their own share


def load_scene(path: Path | str, on_progress: Progress | None = None, *, allow_outside: bool = False) -> Scene:
    """Read a scene file, and load or fit the shapes that its bodies use.

    Args:
        path: of the scene.yaml; paths inside it are taken from its folder.
        on_progress: called with (fraction, message) while shapes are fitted. A mesh is fitted on first use only.
        allow_outside: whether meshes, shape folders and models that the file names may lie outside of its folder.

    Returns:
        The scene in SI units.

    Raises:
        SceneError: with one line `FILE:LINE: FIELD: what is wrong` for every fault found.
    """
    path = Path(path)
    spec = read_scene(path, allow_outside=allow_outside)
    shapes = _load_shapes(spec, on_progress or (lambda fraction, message: None))
    order = {key: i for i, key in enumerate(shapes)}
    groups = {body.name: body.names() for body in spec.bodies}
    fitted = [shapes[key] for key, of in spec.shapes.items() if key in shapes and of and of.kind in _FITTED]
    bodies = []
    for body in spec.bodies:
        key = body.shape or _PLANE
        bodies += _expand(body, order[key], shapes[key], groups)
    spec.problems.check()
    return Scene(
        shapes=tuple(shapes.values()),
        bodies=tuple(bodies),
        gravity=spec.gravity,
        duration=spec.duration,
        seed=spec.seed,
        model=spec.model,
        effects=spec.effects,
        limits=spec.limits,
        path=path,
        missed=tuple(f"{s.name}: {s.certificate['reason']}" for s in fitted if s.certificate.get("reason")),
        caveats=tuple(f"{s.name}: {s.certificate['caveat']}" for s in fitted if s.certificate.get("caveat")),
    )


def _load_shapes(spec: SceneSpec, on_progress: Progress) -> dict[str, Shape]:
    """Every shape in use, in the order of first use.

    What must be fitted or sampled waits until the rest of the file is known to be right: a fit takes a minute.
    """
    used = list(dict.fromkeys(body.shape or _PLANE for body in spec.bodies))
    shapes = {_PLANE: analytic_shape("plane", name="plane")}
    for slow in (False, True):
        if slow:
            spec.problems.check()
        given = {key: spec.shapes.get(key) for key in used if key != _PLANE}
        todo = {key: shape for key, shape in given.items() if shape and _is_slow(shape) is slow}
        for i, (key, shape) in enumerate(todo.items()):

            def report(fraction: float, message: str, i: int = i, count: int = len(todo)) -> None:
                on_progress((i + fraction) / count, message)

            try:
                made = _load_shape(shape, report)
                shapes[key] = with_nodes(made, shape.nodes) if shape.nodes else made
            except SdfsimError as error:
                shape.place.wrong(error.message + (f" ({error.hint})" if error.hint else ""))
    spec.problems.check()
    return {key: shapes[key] for key in used}


def _is_slow(spec: ShapeSpec) -> bool:
    return spec.kind in _FITTED or spec.sdf == "grid"


def _load_shape(spec: ShapeSpec, on_progress: Progress) -> Shape:
    kind = cast(SdfKind | None, spec.sdf)
    if spec.kind == "asset" and spec.path:
        shape = load_shape(spec.path)
        return with_sdf(shape, kind, resolution=spec.resolution) if kind else shape
    made: Any = {"name": spec.name, "sdf": kind or "mlp", "resolution": spec.resolution, "on_progress": on_progress}
    if spec.kind == "mesh" and spec.path:
        return shape_from_mesh(spec.path, units=spec.units, cap=spec.cap, thicken=spec.thicken, **made)
    if spec.kind == "primitive":
        return shape_from_primitive(spec.options["name"], spec.options["size"], **made)
    return analytic_shape(cast(Any, spec.kind), name=spec.name, **spec.options)


def _expand(body: BodySpec, index: int, shape: Shape, groups: dict[str, list[str]]) -> list[Body]:
    """The bodies of one entry, with its mass resolved."""
    mass = 0.0
    if body.motion == "dynamic":
        volume = shape.volume * body.scale**3
        mass = body.density * volume if body.mass is None else body.mass
        if not (np.isfinite(volume) and volume > 0):
            body.place.wrong(f"cannot move: its shape has a volume of {volume:g} m^3; close it, or make it static")
        elif not (np.isfinite(mass) and mass > 0):
            told = f"density {body.density:g} kg/m^3 times a volume of {volume:g} m^3"
            body.place.wrong(f"has no usable mass: {told}; give mass in kg")
        elif not len(shape.nodes):
            body.place.wrong("cannot move: its shape has no surface nodes to touch others with; make it static")
    partners = None
    if body.collides_with is not None:
        partners = tuple(n for place in body.collides_with for n in groups.get(place.text(), [place.text()]))
    return [
        Body(
            name=name,
            shape=index,
            motion=body.motion,
            scale=body.scale,
            position=body.position + offset,
            quat_xyzw=body.quat_xyzw,
            velocity=body.velocity,
            angular_velocity=body.angular_velocity,
            mass=mass,
            friction=body.friction,
            restitution=body.restitution,
            collides_with=partners,
            path=body.path and replace(body.path, position=body.path.position + offset),
        )
        for name, offset in zip(body.names(), body.offsets, strict=True)
    ]
