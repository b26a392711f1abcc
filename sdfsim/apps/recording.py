"""From rollouts to rerun recordings. A live run and a file use the same calls: a live step is a chunk of one frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sdfsim.apps.beside import COLOR, OPACITY, between, rows_in
from sdfsim.base.files import write_bytes
from sdfsim.geometry.mesh import Mesh
from sdfsim.physics import pose
from sdfsim.physics.bodies import largest_extent
from sdfsim.physics.motion import MOTION
from sdfsim.physics.rollout import Rollout
from sdfsim.physics.steps import PHASES
from sdfsim.physics.units import EARTH
from sdfsim.scene.scene import Joint, Scene
from sdfsim.simulate.camera import Camera, eye_around
from sdfsim.simulate.looks import body_colors, framed, shown, with_normals

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb
    from PIL import Image
else:
    from sdfsim.base.lazy import rr, rrb

WORLD = "world"
CONTACTS = "world/contacts"
JOINTS = "world/joints"
FORCES = "world/forces"
STILL = "world/still"
BESIDE = "world/recorded"
# The plots: counters of a view, by their legends.
VIEWS = {
    "kinetic energy (J)": {"kinetic_energy": "kinetic energy (J)"},
    "worst penetration (m)": {"worst_penetration": "worst penetration (m)"},
    "contacts": {"contacts": "contacts", "pairs": "near pairs of bodies"},
    "bodies": {"free": "free", "active": "active", "asleep": "asleep"},
    "network": {"nodes": "nodes", "edges": "edges"},
    "milliseconds": {"step_ms": "step", **PHASES},
}
PLOTS = {key: legend for view in VIEWS.values() for key, legend in view.items()}
_NODE_COLOR = (20, 20, 20)
_CONTACT_COLOR = (255, 40, 40)
_FORCE_COLOR = (255, 170, 0)
_STILL_COLOR = (60, 110, 230)
_PHOTO_PIXELS = 320
_TEXTURE_PIXELS = 2048
MANY = 24  # number of moving bodies of one shape from which they are drawn as a crowd
COLORS = 4  # copies share their mesh's colour, so a crowd is split into groups of different colours
LONGEST = 5.0  # longest arrow, in sizes of its body
# Least force of an arrow, in weights; number of bodies above which only hits get arrows; the least force of a hit.
LEAST, TOLD, MANY_LEAST = 0.05, 100, 3.0
# Of joints.
MOST_SHOWN = 256  # largest number of joints that are shown: each takes bodies out of the crowds
SIZE = 0.4  # size of marks, relative to the smaller of the two bodies
AROUND = 24  # points on a full circle
UNKNOWN = 0.1  # m, size of marks between infinite bodies
AXIS_COLOR, LIMIT_COLOR = (255, 140, 0), (255, 210, 90)


class Playback:
    """One recording of one scene, to write to a file or to stream to a viewer. Its first view shows the whole scene
    and, if the motion is known already, all of the motion; then only plots that have something to show are made.
    `network`: whether the run uses one. A recorded motion `beside` it is shown with translucent bodies."""

    def __init__(
        self, scene: Scene, motion: Rollout | None = None, *, network: bool = True, beside: Rollout | None = None
    ) -> None:
        self._scene = scene
        self._centre, self._radius = framed(scene, motion)
        self._step = 0
        self._before: Rollout | None = None  # the last frame that was logged
        self._views = {name: list(keys) for name, keys in VIEWS.items() if network or name != "network"}
        if motion is not None:
            plotted = {key for key in PLOTS if np.any(motion.counters.get(key, 0.0))}
            shown_of = {name: [key for key in keys if key in plotted] for name, keys in self._views.items()}
            self._views = {name: keys for name, keys in shown_of.items() if keys}
        self._movers = np.array([k for k, body in enumerate(scene.bodies) if body.motion == "dynamic"], dtype=int)
        self._mass = np.array([scene.bodies[k].mass for k in self._movers])
        sizes = [float(np.ptp(shape.mesh.vertices, axis=0).max(initial=0.0)) for shape in scene.shapes]
        self._size = np.array([scene.bodies[k].scale * sizes[scene.bodies[k].shape] for k in self._movers])
        self._com = [b.scale * scene.shapes[b.shape].com for b in scene.bodies]
        self._crowds = _crowds(scene)
        crowded = {int(k) for crowd in self._crowds for k in crowd.bodies}
        paths = [f"{WORLD}/{rr.escape_entity_path_part(body.name)}" for body in scene.bodies]
        self._alone = [(k, path) for k, path in enumerate(paths) if k not in crowded]
        rows = () if beside is None else rows_in(scene, beside)
        self._ghosts = [(int(k), f"{BESIDE}/{rr.escape_entity_path_part(scene.bodies[k].name)}") for k in rows]
        self._beside = beside
        self._ropes = [joint for joint in shown_joints(scene) if joint.kind == "distance"]
        self.stream = rr.RecordingStream("sdfsim")

    def blueprint(self) -> rrb.Blueprint:
        """The layout: the scene on the left, plots of the counters on the right. Nodes, contact points, forces and the
        marks of bodies at rest are hidden until a user switches them on."""
        hidden = [CONTACTS, FORCES, STILL, *(f"{path}/nodes" for _, path in self._alone)]
        view = rrb.Spatial3DView(
            origin=WORLD,
            name="scene",
            overrides={path: rrb.EntityBehavior(visible=False) for path in hidden},
            eye_controls=_controls(eye_around(self._centre, self._radius, -self._scene.gravity)),
            line_grid=False,
        )
        plots = [
            rrb.TimeSeriesView(origin="plots", contents=[f"plots/{key}" for key in keys], name=name)
            for name, keys in self._views.items()
        ]
        return rrb.Blueprint(
            rrb.Horizontal(view, rrb.Vertical(*plots), column_shares=[3, 1]),
            rrb.TimePanel(timeline="time", state="collapsed"),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            auto_views=False,
        )

    def log_static(self) -> None:
        """Log everything that does not change: meshes, surface nodes, and the names of the plots."""
        scene = self._scene
        self.stream.send_blueprint(self.blueprint())
        self.stream.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        colors = body_colors(scene)
        for crowd in self._crowds:
            shape = scene.shapes[crowd.shape]
            mesh = replace(shape.shown, vertices=shape.shown.vertices - shape.com)
            self.stream.log(crowd.path, _shaded(mesh, colors[crowd.bodies[0]]), static=True)
            scales = np.repeat([[scene.bodies[k].scale] for k in crowd.bodies], 3, 1)
            self.stream.log(crowd.path, rr.InstancePoses3D.from_fields(scales=scales), static=True)
        for k, path in self._alone:
            body, com = scene.bodies[k], self._com[k]
            shape = scene.shapes[body.shape]
            mesh = shown(scene, k, 6 * self._radius)
            placed = replace(mesh, vertices=mesh.vertices * body.scale - com)
            self.stream.log(f"{path}/mesh", _shaded(placed, colors[k]), static=True)
            if len(shape.nodes):
                nodes = rr.Points3D(shape.nodes * body.scale - com, colors=_NODE_COLOR, radii=rr.Radius.ui_points(2))
                self.stream.log(f"{path}/nodes", nodes, static=True)
            if body.motion == "static":  # its pose never changes
                centre = body.position + pose.rotate(body.quat_xyzw, com)
                placed = rr.Transform3D(translation=centre, quaternion=rr.Quaternion(xyzw=body.quat_xyzw))
                self.stream.log(path, placed, static=True)
        for k, path in self._ghosts:
            body, mesh = scene.bodies[k], scene.shapes[scene.bodies[k].shape].mesh
            plain = Mesh(mesh.vertices * body.scale - self._com[k], mesh.faces)
            self.stream.log(f"{path}/mesh", _shaded(plain, (*COLOR, round(255 * OPACITY))), static=True)
        for joint in shown_joints(scene):
            for number, mark in enumerate(marks(scene, joint)):
                home = JOINTS if mark.body < 0 else dict(self._alone)[mark.body]
                path = f"{home}/{rr.escape_entity_path_part(f'joint {joint.name}')}/{number}"
                lines = rr.LineStrips3D(mark.strips, colors=mark.color, radii=rr.Radius.ui_points(1.5))
                self.stream.log(path, lines, static=True)
        if self._ropes:
            style = rr.LineStrips3D.from_fields(colors=AXIS_COLOR, radii=rr.Radius.ui_points(1.5))
            self.stream.log(f"{JOINTS}/ropes", style, static=True)
        style = rr.Points3D.from_fields(colors=_CONTACT_COLOR, radii=rr.Radius.ui_points(4))
        self.stream.log(CONTACTS, style, static=True)
        style = rr.Arrows3D.from_fields(colors=_FORCE_COLOR, radii=rr.Radius.ui_points(2))
        self.stream.log(FORCES, style, static=True)
        style = rr.Points3D.from_fields(colors=_STILL_COLOR, radii=rr.Radius.ui_points(6))
        self.stream.log(STILL, style, static=True)
        for key, name in PLOTS.items():
            self.stream.log(f"plots/{key}", rr.SeriesLines(names=name), static=True)

    def log_steps(self, chunk: Rollout) -> None:
        """Log poses, contact points, forces, marks of bodies at rest, and counters of the frames of `chunk`, which
        follow the frames logged before."""
        frames = len(chunk.time)
        steps = np.arange(self._step, self._step + frames)
        self._step += frames
        times = [rr.TimeColumn("time", duration=chunk.time), rr.TimeColumn("step", sequence=steps)]
        for crowd in self._crowds:
            places, turns = (getattr(chunk, k)[:, crowd.bodies] for k in ("position", "orientation"))
            poses = rr.InstancePoses3D.columns(
                translations=places.reshape(-1, 3).astype(np.float32),
                quaternions=turns.reshape(-1, 4).astype(np.float32),
            )
            self.stream.send_columns(crowd.path, times, poses.partition(np.full(frames, len(crowd.bodies))))
        for i, path in self._alone:
            if self._scene.bodies[i].motion != "static":
                motion = rr.Transform3D.columns(translation=chunk.position[:, i], quaternion=chunk.orientation[:, i])
                self.stream.send_columns(path, times, motion)
        if self._ropes:
            strips = ends(self._ropes, chunk.position, chunk.orientation, self._scene)
            lines = rr.LineStrips3D.columns(strips=strips.reshape(-1, 2, 3).astype(np.float32))
            self.stream.send_columns(f"{JOINTS}/ropes", times, lines.partition(np.full(frames, len(self._ropes))))
        if self._beside is not None:
            places, turns = between(self._beside.time, self._beside.position, self._beside.orientation, chunk.time)
            for d, (_, path) in enumerate(self._ghosts):
                motion = rr.Transform3D.columns(translation=places[:, d], quaternion=turns[:, d])
                self.stream.send_columns(path, times, motion)
        points = rr.Points3D.columns(positions=chunk.contact_point).partition(chunk.contact_count)
        self.stream.send_columns(CONTACTS, times, points)
        self._log_forces(chunk, times)
        for key in PLOTS:
            if key in chunk.counters:
                values = np.asarray(chunk.counters[key], dtype=np.float64)
                self.stream.send_columns(f"plots/{key}", times, rr.Scalars.columns(scalars=values))

    def _log_forces(self, chunk: Rollout, times: list[Any]) -> None:
        """Log the mean force on each body from others since the frame before (mass times change of velocity, minus
        gravity), as an arrow at the body's centre. An arrow as long as its body is the body's weight (on Earth, in a
        scene without gravity); arrows are at most `LONGEST` bodies long. Also log a point on each body that has not
        moved since then."""
        rows = self._movers
        ahead = self._before
        parts = [chunk] if ahead is None else [ahead, chunk]
        time, place, turn, speed, spin = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("time", *MOTION)
        )
        self._before = chunk.frames(len(chunk.time) - 1, len(chunk.time))
        place, turn, speed, spin = (of[:, rows] for of in (place, turn, speed, spin))
        change = np.diff(speed, axis=0) / np.maximum(np.diff(time), 1e-12)[:, None, None] - self._scene.gravity
        strength = float(np.linalg.norm(self._scene.gravity)) or EARTH
        arrows = change / strength  # in weights
        length = np.linalg.norm(arrows, axis=-1, keepdims=True)
        arrows *= self._size[:, None] * np.minimum(1.0, LONGEST / np.maximum(length, 1e-12))
        moved = (np.diff(place, axis=0) != 0).any(-1) | (np.diff(turn, axis=0) != 0).any(-1)
        still = ~(moved | (speed[1:] != 0).any(-1) | (spin[1:] != 0).any(-1))
        pushed = length[..., 0] > (LEAST if len(rows) <= TOLD else MANY_LEAST)
        first = np.zeros((len(chunk.time) - len(change), len(rows)), bool)  # for the very first frame nothing is known
        pushed, still = np.concatenate([first, pushed]), np.concatenate([first, still])
        at = place[len(place) - len(chunk.time) :]
        arrows = np.concatenate([np.zeros((len(first), len(rows), 3)), arrows])
        found = rr.Arrows3D.columns(vectors=arrows[pushed], origins=at[pushed]).partition(pushed.sum(1))
        self.stream.send_columns(FORCES, times, found)
        self.stream.send_columns(STILL, times, rr.Points3D.columns(positions=at[still]).partition(still.sum(1)))


class Crowd(NamedTuple):
    """Bodies that are drawn as copies of one mesh; their poses at a step are one row."""

    path: str  # entity path
    shape: int  # index into `Scene.shapes`
    bodies: np.ndarray  # [C] int64, indices of the bodies


def _crowds(scene: Scene) -> list[Crowd]:
    """The crowds of a scene. Other bodies are drawn one by one, and so are those whose joints are shown."""
    found = []
    shape = np.array([b.shape if b.motion != "static" else -1 for b in scene.bodies])
    shape[[k for joint in shown_joints(scene) for k in joint.bodies if k >= 0]] = -1
    for number, name in enumerate(s.name for s in scene.shapes):
        members = np.flatnonzero(shape == number)
        alike: dict[Any, list[int]] = {}
        for n, k in enumerate(members.tolist() if len(members) >= MANY else ()):
            alike.setdefault(scene.bodies[k].color or n % COLORS, []).append(k)
        for k, bodies in enumerate(alike.values()):
            called = rr.escape_entity_path_part(f"{number}_{name}")
            found.append(Crowd(f"{WORLD}/crowds/{called}/{k}", number, np.array(bodies, dtype=np.int64)))
    return found


def save_rollout(scene: Scene, rollout: Rollout, path: Path, beside: Rollout | None = None) -> None:
    """Write `rollout` as a rerun recording, with a recorded motion `beside` it. Raises SdfsimError if the file cannot
    be written."""
    playback = Playback(scene, rollout, beside=beside)
    encoded = playback.stream.binary_stream()  # because rerun's own sink only logs an error if the disk is full
    playback.log_static()
    playback.log_steps(rollout)
    write_bytes(path, encoded.read() or b"")


@dataclass(frozen=True)
class PosedPhoto:
    """One camera of a reconstruction."""

    name: str  # its name in the viewer
    image: Path | None  # photo file, or None to show the camera alone
    camera: Camera
    color: tuple[int, int, int] | None = None  # RGB of its frame, or None for the viewer's default


def save_reconstruction(
    path: Path, photos: list[PosedPhoto], points: np.ndarray, colors: np.ndarray | None, mesh: Mesh | None,
    skins: Mapping[str, Mesh] = MappingProxyType({}), trust: Mapping[str, Mesh] = MappingProxyType({}),
) -> None:  # fmt: skip
    """Write cameras with their photos, sparse points [P, 3] m with colours [P, 3] uint8, and the surface as one rerun
    recording. Raises SdfsimError if it cannot be written.

    Parts with textures (`skins`, by name) are shown in place of the mesh. With `trust` (parts whose colours show how
    far each place can be trusted) the viewer has a second tab for these.
    """
    stream = rr.RecordingStream("sdfsim-reconstruct")
    encoded = stream.binary_stream()
    centres = np.array([photo.camera.position for photo in photos])
    # Cameras surround the subject; sparse points also lie on things behind it.
    around = np.concatenate([np.reshape(centres, (-1, 3)), points[:0] if mesh is None else mesh.vertices])
    low, high = (around.min(0), around.max(0)) if len(around) else (-np.ones(3), np.ones(3))
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2 or 1.0
    # Before there is a surface, z may not be up: use the cameras, as photographers mostly hold them level.
    up = (
        -np.sum([photo.camera.rotation[1] for photo in photos], axis=0)
        if mesh is None and photos
        else np.array([0.0, 0.0, 1.0])
    )
    hidden = {"reconstruction": "trust"} | ({"trust": "surface"} if trust else {})
    tabs = [
        rrb.Spatial3DView(
            origin=WORLD, name=name, eye_controls=_controls(eye_around(centre, radius, up)), line_grid=False,
            contents=["+ $origin/**", f"- $origin/{other}/**"],
        )
        for name, other in hidden.items()
    ]  # fmt: skip
    stream.send_blueprint(rrb.Blueprint(rrb.Tabs(*tabs), collapse_panels=True, auto_views=False))
    stream.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log(f"{WORLD}/points", rr.Points3D(points, colors=colors, radii=rr.Radius.ui_points(1.5)), static=True)
    surfaces = {} if mesh is None else {f"{WORLD}/surface": mesh}
    if skins:
        surfaces = {f"{WORLD}/surface/{rr.escape_entity_path_part(name)}": skin for name, skin in skins.items()}
    surfaces |= {f"{WORLD}/trust/{rr.escape_entity_path_part(name)}": part for name, part in trust.items()}
    for entity, surface in surfaces.items():
        stream.log(entity, _shaded(surface, (200, 190, 175)), static=True)
    for photo in photos:
        camera = photo.camera
        entity = f"{WORLD}/cameras/{rr.escape_entity_path_part(photo.name)}"
        stream.log(entity, rr.Transform3D(translation=camera.position, mat3x3=camera.rotation.T), static=True)
        shrink = min(1.0, _PHOTO_PIXELS / max(camera.width, camera.height))
        pinhole = rr.Pinhole(
            focal_length=camera.lens[0] * shrink,
            principal_point=camera.lens[1] * shrink,
            resolution=[max(1, round(length * shrink)) for length in (camera.width, camera.height)],
            image_plane_distance=0.1 * radius,
            color=photo.color,
        )
        stream.log(entity, pinhole, static=True)
        if photo.image is not None and photo.image.exists():
            from PIL import Image

            image = rr.Image(_reduced(Image.open(photo.image), _PHOTO_PIXELS))
            stream.log(entity, image.compress(jpeg_quality=80), static=True)
    write_bytes(path, encoded.read() or b"")


def _controls(eye: Camera) -> rrb.EyeControls3D:
    return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=eye.position, look_target=eye.look_at, eye_up=eye.up)


def _shaded(mesh: Mesh, color: tuple[int, ...]) -> rr.Mesh3D:
    """The mesh with its own texture or colours, or with `color` if it has neither."""
    from PIL import Image

    mesh, normals = with_normals(mesh)
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=normals,
        vertex_colors=mesh.colors,
        vertex_texcoords=mesh.uv,
        albedo_texture=None if mesh.texture is None else _reduced(Image.fromarray(mesh.texture), _TEXTURE_PIXELS),
        albedo_factor=color if mesh.colors is None and mesh.texture is None else None,
    )


def _reduced(image: Image.Image, longest: int) -> np.ndarray:
    """Pixels [H, W, 3], reduced for a recording, which stores every image."""
    image = image.convert("RGB")
    image.thumbnail((longest, longest))
    return np.asarray(image)


# --- joints: lines that stay with their bodies, so that they are logged once ---


@dataclass(frozen=True)
class Mark:
    """The drawing of a joint in one of its bodies."""

    body: int  # -1: the world
    strips: list[np.ndarray]  # [P, 3] m, about the body's centre of mass in body axes; for the world, world coordinates
    color: tuple[int, int, int]


def shown_joints(scene: Scene) -> tuple[Joint, ...]:
    return scene.joints if len(scene.joints) <= MOST_SHOWN else ()


def marks(scene: Scene, joint: Joint) -> list[Mark]:
    """The axis, in the second body, and the limits: for a hinge an arc, along which a needle in the first body moves;
    for a slider the path of its point; for a ball the rim of its cone. Fixed joints, and the ends of distances, are
    small crosses."""
    smaller = min(_extent(scene, k) for k in joint.bodies)
    size = SIZE * smaller if np.isfinite(smaller) else UNKNOWN
    axis, limits, needle = [], [], []
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    if joint.kind == "hinge":
        axis = [np.stack([-size * x, size * x])]
        low, high = joint.limits if joint.limits is not None else (0.0, 0.0)
        high = min(high, low + 2.0 * np.pi)
        turns = np.linspace(low, high, 2 + int(AROUND * (high - low) / (2.0 * np.pi)))
        arc = 0.8 * size * np.stack([0.0 * turns, np.cos(turns), np.sin(turns)], 1)
        limits = [np.concatenate([np.zeros((1, 3)), arc, np.zeros((1, 3))])] if joint.limits is not None else []
        needle = [np.stack([0.0 * y, size * y])]
    elif joint.kind == "slider":
        low, high = joint.limits if joint.limits is not None else (-size, size)
        axis = [np.stack([low * x, high * x])]
        limits = [np.stack([e * x - 0.3 * size * y, e * x + 0.3 * size * y]) for e in (joint.limits or ())]
        needle = [np.stack([-0.2 * size * y, 0.2 * size * y])]
    elif joint.kind == "ball" and joint.limits is not None:
        turns, lean = np.linspace(0.0, 2.0 * np.pi, AROUND + 1), joint.limits[1]
        rim = np.stack([np.full_like(turns, np.cos(lean)), *(np.sin(lean) * f(turns) for f in (np.cos, np.sin))], 1)
        limits, needle = [size * rim], [np.stack([0.0 * x, size * x])]
    else:
        needle = [0.2 * size * np.stack([-side, side]) for side in np.eye(3)]
        axis = needle if joint.kind == "distance" else []
    made = [(1, axis, AXIS_COLOR), (1, limits, LIMIT_COLOR), (0, needle, AXIS_COLOR)]
    return [_mark_of(scene, joint, side, strips, color) for side, strips, color in made if strips]


def ends(joints: Sequence[Joint], place: np.ndarray, turn: np.ndarray, scene: Scene) -> np.ndarray:
    """[T, J, 2, 3] m: the ends of distances, for bodies with centres of mass `place` [T, N, 3] and orientations `turn`
    [T, N, 4]."""
    found = np.zeros((len(place), len(joints), 2, 3))
    for j, joint in enumerate(joints):
        for side, k in enumerate(joint.bodies):
            offset = _from_com(scene, joint, side)
            found[:, j, side] = offset if k < 0 else place[:, k] + pose.rotate(turn[:, k], offset)
    return found


def _mark_of(scene: Scene, joint: Joint, side: int, strips: list[np.ndarray], color: tuple[int, int, int]) -> Mark:
    frame, origin = joint.quat_xyzw[side], _from_com(scene, joint, side)
    return Mark(joint.bodies[side], [pose.rotate(frame, strip) + origin for strip in strips], color)


def _from_com(scene: Scene, joint: Joint, side: int) -> np.ndarray:
    """[3] m, the joint's end relative to the body's centre of mass, in body axes."""
    k = joint.bodies[side]
    if k < 0:
        return joint.anchor[side]
    return joint.anchor[side] - scene.bodies[k].scale * scene.shapes[scene.bodies[k].shape].com


def _extent(scene: Scene, k: int) -> float:
    """Extent of a body, m; infinite for the world and for planes."""
    if k < 0:
        return np.inf
    return largest_extent(scene.shapes[scene.bodies[k].shape]) * scene.bodies[k].scale
