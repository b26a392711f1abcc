"""`load_scene`: reads and checks a scene file, makes its shapes, and returns a `Scene`."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from sdfsim.base.errors import SdfsimError, warn_once
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry.mesh_io import load_textured
from sdfsim.scene.bundled import find_scene
from sdfsim.scene.document import Document, Faults
from sdfsim.scene.joints import joints_of
from sdfsim.scene.scene import WORLD, Body, Coupling, Effects, Frame, Keyframe, Motion, Scene, Waypoints
from sdfsim.scene.schema import (
    FITTED,
    OF_PART,
    UNITS,
    BodyTable,
    CouplingTable,
    KeyframeTable,
    PartTable,
    SceneTable,
    ShapeTable,
)
from sdfsim.shape.make import analytic_shape, far_origin, shape_from_mesh, shape_from_primitive
from sdfsim.shape.parts import Part, color_of, moved, pose_of, skin_of, solid_of
from sdfsim.shape.round_form import round_form
from sdfsim.shape.shape import SdfKind, Shape, centred, load_shape, with_nodes, with_sdf, with_wall


def read_scene(path: Path, *, allow_outside: bool = False, text: str | None = None) -> tuple[SceneTable, Document]:
    """Read and check a scene file; nothing is loaded yet. Returns its tables, and the document, to which faults that
    show later can be added. Raises SceneError with every fault found."""
    document = Document(path, text)
    return checked(document, {"folder": path.parent, "allow_outside": allow_outside}), document


def checked(faults: Faults, context: dict[str, Any]) -> SceneTable:
    """The tables of a scene's data. `context`: the `folder` at which its paths start, and whether they may lead out of
    it (`allow_outside`). Raises SceneError with every fault found."""
    try:
        table = SceneTable.model_validate(faults.data, context=context)
    except ValidationError as error:
        for e in error.errors(include_url=False):
            faults.wrong(e["loc"], e["msg"])
        faults.check()
        raise
    faults.check()
    return table


def load_scene(
    path: Path | str, on_progress: Progress = silent, *, allow_outside: bool = False, text: str | None = None
) -> Scene:
    """Read a scene file, by its path or the name of a sample, and load or fit the shapes that its bodies use. The scene
    is in SI units.

    Paths in the file are relative to its folder; unless `allow_outside`, they may not lead out of it. `text` is the
    content of a file that is not written yet. Raises SceneError with one line `FILE:LINE: FIELD: what is wrong` for
    every fault found.
    """
    path = find_scene(path) if text is None else Path(path)
    return replace(scene_of(*read_scene(path, allow_outside=allow_outside, text=text), on_progress), path=path)


def scene_of(table: SceneTable, faults: Faults, on_progress: Progress) -> Scene:
    """The scene of its tables. Raises SceneError with every fault found."""
    same, shapes, turned = _load_shapes(table, faults, on_progress)
    number = {key: i for i, key in enumerate(dict.fromkeys(same.values()))}
    groups = {body.name: body.names() for body in table.bodies}
    bodies: list[Body] = []
    for i, entry in enumerate(table.bodies):
        shape = shapes[same[entry.shape]]
        made = _body(entry, number[same[entry.shape]], table.motion_of(entry), groups)
        if (own := turned.get(same[entry.shape])) is not None:
            made = _turned(made, own)
        if made.motion == "dynamic":
            made = replace(made, mass=_mass(entry, shape, partial(faults.wrong, ("bodies", i, "name"))))
            if entry.inertia_factor != 1.0 and made.mass > 0.0:
                own = made.mass / shape.volume * shape.inertia * entry.scale**2
                made = replace(made, inertia=entry.inertia_factor * own)
        for name, offset in zip(entry.names(), entry.offsets(), strict=True):
            way = made.path and replace(made.path, position=made.path.position + offset)
            bodies.append(replace(made, name=name, position=made.position + offset, path=way))
    joints = joints_of(table.joints, bodies, faults.wrong)
    faults.check()
    loaded = [(of, shapes[key]) for key, of in table.shapes.items() if key in shapes]
    fitted = [shape for of, shape in loaded if of.kind in FITTED or of.sdf == "grid"]
    notes = tuple(f"{s.name}: {note}" for of, s in loaded if of.mesh or of.parts for note in s.source.get("notes", []))
    away = [(s.name, far_origin(s.mesh)) for of, s in loaded if of.mesh or of.asset]
    notes += tuple(f"{name}: {line}; centre: on moves it to the centre of mass" for name, line in away if line)
    if on_progress is silent:
        for note in notes:
            warn_once(note)
    return Scene(
        shapes=tuple(shapes[key] for key in number),
        bodies=tuple(bodies),
        gravity=np.array(table.gravity),
        duration=table.duration,
        step=table.step,
        seed=table.seed,
        model=table.model,
        effects=Effects(**dict(table.effects)),
        missed=tuple(f"{s.name}: {s.certificate['reason']}" for s in fitted if s.certificate.get("reason")),
        notes=notes,
        caveats=tuple(f"{s.name}: {s.certificate['caveat']}" for s in fitted if s.certificate.get("caveat")),
        joints=joints,
        **_poses_of(table, bodies, [turned.get(same[body.shape]) for body in table.bodies for _ in body.names()]),
    )


def _poses_of(table: SceneTable, bodies: list[Body], turned: list[np.ndarray | None]) -> dict[str, Any]:
    """The frames, keyframes and couplings of a scene, for bodies whose shapes have the frames `turned` in their
    meshes."""
    number = {WORLD: -1} | {body.name: k for k, body in enumerate(bodies)}
    joint = {entry.name: j for j, entry in enumerate(table.joints)}
    known = [Frame(f.name, number[f.body], np.array(f.position), f.rotation()) for f in table.frames]
    named = {frame.name for frame in known}
    own = [k for k, at in enumerate(turned) if at is not None and bodies[k].name not in named]
    known += [Frame(bodies[k].name, k, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])) for k in own]
    frames = [_in_round(f, bodies[f.body].scale, turned[f.body]) if f.body >= 0 else f for f in known]

    def keyframe(key: KeyframeTable) -> Keyframe:
        angles = {name: math.radians(angle) for name, angle in key.angles_deg.items()}
        turns = {name: np.array(quat) for name, quat in key.quats_xyzw.items()}
        there = {}
        for name, at in key.bodies.items():
            k = number[name]
            place = _onto(np.array(at.position), at.rotation(), bodies[k].scale, turned[k])
            there[name] = (*place, np.array(at.velocity), np.array(at.angular_velocity))
        return Keyframe(angles | key.positions | turns, there, key.speeds | key.spins, key.targets)

    def coupling(of: CouplingTable) -> Coupling:
        first, second = (joint[name] for name in of.joints)
        turns = table.joints[first].type == "hinge"
        return Coupling((first, second), of.ratio, math.radians(of.offset_deg) if turns else of.offset)

    keyframes = {name: keyframe(key) for name, key in table.keyframes.items()}
    return {"frames": tuple(frames), "keyframes": keyframes, "couplings": tuple(map(coupling, table.couplings))}


def _onto(
    position: np.ndarray, quat_xyzw: np.ndarray, scale: float, own: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """The position [..., 3] and orientation [..., 4] of a round shape whose frame is `own` [4, 4] in its mesh, from
    those of the mesh."""
    if own is None:
        return position, quat_xyzw
    from scipy.spatial.transform import Rotation  # slow to import

    turn = Rotation.from_quat(quat_xyzw)
    return position + turn.apply(scale * own[:3, 3]), (turn * Rotation.from_matrix(own[:3, :3])).as_quat()


def _turned(body: Body, own: np.ndarray) -> Body:
    """A body placed by its mesh, placed by the round shape whose frame is `own` in that."""
    position, quat = _onto(body.position, body.quat_xyzw, body.scale, own)
    path = body.path
    if path is not None:
        place, turns = _onto(path.position, path.quat_xyzw, body.scale, own)
        path = replace(path, position=place, quat_xyzw=turns)
    return replace(body, position=position, quat_xyzw=quat, path=path)


def _in_round(frame: Frame, scale: float, own: np.ndarray | None) -> Frame:
    """A frame in a mesh, in the round shape whose frame is `own` in that."""
    if own is None:
        return frame
    from scipy.spatial.transform import Rotation  # slow to import

    back = Rotation.from_matrix(own[:3, :3]).inv()
    quat = (back * Rotation.from_quat(frame.quat_xyzw)).as_quat()
    return replace(frame, position=back.apply(frame.position - scale * own[:3, 3]), quat_xyzw=quat)


def _load_shapes(
    table: SceneTable, faults: Faults, on_progress: Progress
) -> tuple[dict[str | None, str | None], dict[str | None, Shape], dict[str | None, np.ndarray]]:
    """Load the shapes in use. Returns for each key, in order of first use, the first key with the same entry (in Python
    every body may bring its own copy of a mesh); the shapes of these first keys; and the frames [4, 4] of those that
    are round in place of their meshes, in these. The key None is the plane that all bodies with a `plane` share. Shapes
    that must be fitted or sampled are made last, when all else is valid: a fit takes a minute."""
    first: dict[str, str] = {}
    same: dict[str | None, str | None] = {}
    for key in dict.fromkeys(body.shape for body in table.bodies):
        same[key] = key and first.setdefault(table.shapes[key].model_dump_json(exclude_unset=True), key)
    shapes: dict[str | None, Shape] = {None: analytic_shape("plane", name="plane")}
    turned: dict[str | None, np.ndarray] = {}
    scales: dict[str | None, list[float]] = {}
    for body in table.bodies:
        scales.setdefault(same[body.shape], []).append(body.scale)
    # A network that predicts motions was trained on fitted shapes.
    own: SdfKind = "mesh" if table.model in (None, "solver") else "mlp"
    slow = {key: s.kind in FITTED or s.sdf == "grid" for key, s in table.shapes.items()}
    for now in (False, True):
        todo = [key for key in first.values() if slow[key] is now]
        for i, key in enumerate(todo):

            def report(fraction: float, message: str, i: int = i, count: int = len(todo)) -> None:
                on_progress((i + fraction) / count, message)

            try:
                told = silent if on_progress is silent else report
                if found := _as_round(key, table.shapes[key]):
                    shapes[key], turned[key] = found
                    continue
                shapes[key] = _load_shape(key, table.shapes[key], scales[key], own, told)
            except SdfsimError as error:
                hint = f" ({error.hint})" if error.hint else ""
                faults.wrong(("shapes", key, table.shapes[key].kind), error.message + hint)
        faults.check()
    return same, shapes, turned


def _as_round(name: str, entry: ShapeTable) -> tuple[Shape, np.ndarray] | None:
    """The round solid that a mesh is up to its facets, and its frame [4, 4] in the mesh; None if it is none, or is not
    asked for."""
    if entry.mesh is None or entry.round == "off":
        return None
    loaded, units = load_textured(entry.mesh), UNITS[entry.units] * np.eye(4)
    form = round_form(moved(loaded.mesh, units))
    if form is None:
        return None
    shape = analytic_shape(form.kind, name=name, **form.sizes)
    shape = with_wall(shape, entry.wall) if entry.wall else shape
    skin = skin_of([Part("mesh", pose_of(), {}, moved(loaded.skin or loaded.mesh, units))], form.pose)
    return replace(shape, skin=skin, source=shape.source | {"notes": [str(form)]}), form.pose


def _load_shape(name: str, entry: ShapeTable, scales: list[float], own: SdfKind, on_progress: Progress) -> Shape:
    kind: Any = entry.kind
    made: Any = {"sdf": entry.sdf or own, "resolution": entry.resolution, "on_progress": on_progress, "name": name}
    if entry.asset:
        shape = load_shape(entry.asset)
        shape = with_sdf(shape, entry.sdf, resolution=entry.resolution) if entry.sdf else shape
    elif entry.mesh:
        units = UNITS[entry.units] if "units" in entry.model_fields_set else None
        made |= {"units": units, "scales": scales, "cap": entry.cap == "on", "thicken": entry.thicken}
        shape = shape_from_mesh(entry.mesh, **made)
        if entry.round == "auto":
            notes = [*shape.source.get("notes", []), "its mesh is no round solid: it collides as it is"]
            shape = replace(shape, source=shape.source | {"notes": notes})
    elif entry.primitive:
        shape = shape_from_primitive(entry.primitive.name, entry.primitive.size, **made)
    elif entry.parts:
        shape = _of_parts(name, entry.parts)
    else:
        shape = analytic_shape(kind, name=name, **dict(getattr(entry, kind)))
    shape = with_wall(shape, entry.wall) if entry.wall else shape
    shape = with_nodes(shape, entry.nodes) if entry.nodes else shape
    return centred(shape) if entry.centre == "on" else shape


def _of_parts(name: str, entries: Sequence[PartTable]) -> Shape:
    from scipy.spatial.transform import Rotation  # slow to import

    def part(k: int, *, seen: bool) -> Part:
        one, mesh, sizes = entries[k], None, {}
        kind: Any = next(kind for kind in OF_PART if getattr(one, kind) is not None)
        if one.mesh is not None:
            loaded = load_textured(one.mesh)
            mesh = moved((loaded.skin if seen else None) or loaded.mesh, one.scale * np.eye(4))
        else:
            sizes = dict(getattr(one, kind))
        color: Any = one.color and tuple(map(round, one.color))
        return Part(kind, pose_of(one.position, Rotation.from_quat(one.rotation())), sizes, mesh, f"parts[{k}]", color)

    shape = solid_of([part(k, seen=False) for k, one in enumerate(entries) if one.use != "shown"], name)
    seen = [part(k, seen=True) for k, one in enumerate(entries) if one.use != "touch"]
    plain = all(one.use == "both" for one in entries) and not any(map(color_of, seen))
    return shape if plain or not seen else replace(shape, skin=skin_of(seen, np.eye(4)))


def _body(entry: BodyTable, shape: int, motion: Motion, groups: dict[str, list[str]]) -> Body:
    """The first copy of a body, without its mass."""
    partners, path = entry.collides_with, None
    if entry.avoids:
        avoided = {n for p in entry.avoids for n in groups.get(p, [p])}
        known = (n for p in (groups if partners is None else partners) for n in groups.get(p, [p]))
        partners = [n for n in known if n not in avoided]
    position, quat = (np.array(entry.position), entry.rotation()) if entry.plane is None else entry.plane.pose()
    if entry.path:
        times, places, turns = zip(*((p.time, p.position, p.rotation()) for p in entry.path), strict=True)
        path = Waypoints(np.array(times), np.stack(places), np.stack(turns))
        position, quat = path.position[0], path.quat_xyzw[0]
    return Body(
        name=entry.name,
        shape=shape,
        motion=motion,
        scale=entry.scale,
        position=position,
        quat_xyzw=quat,
        velocity=np.array(entry.velocity),
        angular_velocity=np.array(entry.angular_velocity),
        mass=0.0,
        friction=entry.friction,
        restitution=entry.restitution,
        stiffness=math.inf if entry.stiffness is None else entry.stiffness,
        damping=entry.damping,
        collides_with=None if partners is None else tuple(n for p in partners for n in groups.get(p, [p])),
        path=path,
        color=tuple(round(value) for value in entry.color) if entry.color else None,
    )


def _mass(entry: BodyTable, shape: Shape, wrong: Callable[[str], None]) -> float:
    """Mass of a dynamic body, kg. Calls `wrong` with the reason if the body cannot move."""
    volume = shape.volume * entry.scale**3
    mass = entry.density * volume if entry.mass is None else entry.mass
    if not (np.isfinite(volume) and volume > 0):
        wrong(f"cannot move: its shape has a volume of {volume:g} m^3; close it, or make it static")
    elif not (np.isfinite(mass) and mass > 0):
        wrong(f"has no usable mass: density {entry.density:g} kg/m^3 times a volume of {volume:g} m^3; give mass in kg")
    elif not len(shape.nodes):
        wrong("cannot move: its shape has no surface nodes to touch others with; make it static")
    return mass
