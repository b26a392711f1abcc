"""`export`: a shape, a scene or a run becomes a file that other programs open.

In every format poses are those of the shapes' own origins. The report's `left_out` says what the format cannot hold;
docs/import-and-export.md lists it for each format.
"""

import csv
import io
import logging
import math
import tempfile
import unicodedata
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.apps import export_joints as jointed
from sdfsim.apps.beside import between
from sdfsim.apps.export_joints import add, numbers
from sdfsim.apps.observed import COLUMNS
from sdfsim.apps.run import read_run
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import cached_arrays, check_writable, digest, user_cache, write_bytes, write_text
from sdfsim.base.lazy import optional
from sdfsim.base.parallel import StageProgress, of_stage, silent_stages
from sdfsim.geometry.gltf import GltfWriter, light
from sdfsim.geometry.mesh import Mesh, clean, convex_hull, far_middle, is_closed, lattice
from sdfsim.geometry.mesh_io import MESH_SUFFIXES, wavefront
from sdfsim.physics import pose
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.bundled import find_scene
from sdfsim.scene.collision_filter import contact_groups
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Body, Effects, Joint, Scene
from sdfsim.sdf.closed_forms import COMMON_FORMS, BoxSdf, CapsuleSdf, ClosedForm, CylinderSdf, PlaneSdf, SphereSdf
from sdfsim.shape.shape import RECORD_FILE, Shape, load_shape, own_pieces
from sdfsim.simulate.looks import body_colors, framed, is_infinite, shown, with_normals

_log = logging.getLogger(__name__)

# Concavity relative to the size; and a search a third as long as CoACD's default, which finds equally good pieces.
COACD = {"threshold": 0.05, "mcts_iterations": 60, "mcts_nodes": 10, "resolution": 1000, "seed": 0}
SOLID_CELLS = 64  # along the longest side of a surface made from a distance, for these pieces
PIECES_VERSION = 1  # of cached pieces; a new one if they are made otherwise
RATE = 60.0  # USD time codes per second if no frame rate is given; programs step through whole ones
# Schemas of PhysX (Isaac Sim, ManiSkill) and Newton for sampled distances, and the attribute for the number of cells
# along the longest side. None of them is part of OpenUSD.
USD_GRIDS = {
    "PhysxSDFMeshCollisionAPI": "physxSDFMeshCollision:sdfResolution",
    "NewtonSDFCollisionAPI": "newton:sdfMaxResolution",
}
USD_CELLS = 256
# What glTF's drafts of physics have along y, we have along z.
UPRIGHT = [0.5**0.5, 0.0, 0.0, 0.5**0.5]
STEP = 0.001  # s, the step of MuJoCo
SOFT = 4.0  # steps, over 2 pi: the period of a MuJoCo contact
MOST_PAIRS = 1000  # pairs of geoms whose coefficients are written one by one
MOST_GROUPS = 31  # MuJoCo's bit masks
# MuJoCo refuses moments of inertia below 1e-14 kg m^2, and convex pieces of hardly any volume. Below this moment,
# kg m^2, or this size of a mesh, m, the unit of length is a thousandth.
LEAST_MOMENT, LEAST_SIZE, FINER = 1e-13, 1e-3, 1000.0
SMOOTH = 3.0  # accelerations of gravity: a faster change of velocity is an impact
WEIGHTLESS = 1e-9  # kg, of a link of URDF that is only a frame
MOST_TOLD = 8  # names in a line of the report
# Names that are taken: our own, MuJoCo's, and device names, which Windows does not allow for files.
RESERVED = ("world", "root", "physics", "materials", "shapes", "groups", "joints", "con", "prn", "aux", "nul")
RESERVED += tuple(f"{port}{k}" for port in ("com", "lpt") for k in range(1, 10))
XML = ElementTree.Element


# How MuJoCo collides shapes without a closed form: as convex pieces, or by distances that it samples from the mesh
# itself.
Collide = Literal["pieces", "sdf"]


@dataclass(frozen=True)
class Take:
    """The data to export: N bodies at T times."""

    scene: Scene  # the bodies as they are at the start
    names: list[str]  # [N] unique names of letters, digits and underscores
    shapes: list[str]  # names of the scene's shapes, in the same form
    colors: np.ndarray  # [N, 3] uint8 sRGB, for bodies whose mesh has no colours
    time: np.ndarray  # [T] s
    position: np.ndarray  # [T, N, 3] m, of the shapes' own origins
    quat_xyzw: np.ndarray  # [T, N, 4], with the sign that is nearer to the time before
    velocity: np.ndarray  # [T, N, 3] m/s, of the origins
    collide: Collide = "pieces"
    rate: float = RATE  # USD time codes per second
    ascii: bool = False  # whether the names have no other letters than those of ASCII
    notes: tuple[str, ...] = ()  # what differs from the source, one line each

    @property
    def moving(self) -> bool:
        return len(self.time) > 1

    def each(self) -> Iterable[tuple[str, Body, Shape, np.ndarray]]:
        """Name, body, shape and colour of every body."""
        shapes = [self.scene.shapes[body.shape] for body in self.scene.bodies]
        return zip(self.names, self.scene.bodies, shapes, self.colors, strict=True)

    def plane_size(self) -> float:
        """Half the side, m, of the square that is shown for a plane."""
        return 6.0 * framed(self.scene)[1]

    def at_rate(self, fps: float) -> "Take":
        """The same motion at `fps` evenly spaced times per second, interpolated between frames, by their velocities
        where nothing hits: so a flight stays a parabola. The last time is not before the end, and has the last pose."""
        from scipy.interpolate import CubicHermiteSpline

        count = int(np.ceil((self.time[-1] - self.time[0]) * fps - 1e-3)) + 1
        time = self.time[0] + np.arange(count) / fps
        place, turn = between(self.time, self.position, self.quat_xyzw, time)
        if self.moving:
            curved = CubicHermiteSpline(self.time, self.position, self.velocity)(np.minimum(time, self.time[-1]))
            change = np.linalg.norm(np.diff(self.velocity, axis=0), axis=-1) / np.diff(self.time)[:, None]
            row = np.clip(np.searchsorted(self.time, time) - 1, 0, len(change) - 1)
            smooth = change <= SMOOTH * max(float(np.linalg.norm(self.scene.gravity)), 1.0)
            place = np.where(smooth[row][..., None], curved, place)
        return replace(self, time=time, position=place, quat_xyzw=turn, velocity=0.0 * place, rate=fps)


Written = tuple[list[Path], list[str]]  # the files of an export, and what is left out, one line each


def export(
    source: Path | str | Scene,
    out: Path | str,
    *,
    scene_file: Path | str | None = None,
    fps: float | None = None,
    collide: Collide = "pieces",
    allow_outside: bool = False,
    on_progress: StageProgress = silent_stages,
) -> dict[str, Any]:
    """Write a run (folder or rollout.npz), a scene (loaded, a scene.yaml, or a sample by its name) or a Shape folder in
    the format given by the ending of `out` (see `FORMATS`).

    Args:
        scene_file: the scene of a run; None: the one that it was made from.
        fps: frames of the motion per second, evenly spaced; None: every step of the run.
        collide: for MuJoCo, see `Collide`; "sdf" is about thirty times slower there.

    Returns a report: format, bodies, frames, files, left_out and notes. Raises SdfsimError for an unknown ending, an
        option that the format does not have, a damaged source, an extra that is not installed, a shape without convex
        pieces, or a file that cannot be written.
    """
    wanted = 'export reads files: scene.save("scene.yaml") or rollout.save("run.npz") first'
    source = source if isinstance(source, Scene) else _path("source", source, wanted)
    out = _path("out", out, "its ending names the format")
    scene_file = _path("scene_file", scene_file, wanted) if scene_file else None
    kind = out.suffix.lower()
    if kind not in FORMATS:
        raise SdfsimError(f"{out}: unknown format {out.suffix or '(no ending)'}", "end it in " + " ".join(FORMATS))
    if collide != "pieces" and FORMATS[kind] is not _mjcf:
        raise SdfsimError(
            f"--collide {collide}: is for MuJoCo", "leave it out; USD always uses it for bodies without pieces"
        )
    if fps is not None and (FORMATS[kind] in (_mjcf, _urdf) or not 0.0 < fps <= 1e4):
        message = f"--fps {fps:g}: " + ("no motion in it" if 0.0 < fps <= 1e4 else "must be above 0, at most 10,000")
        raise SdfsimError(
            message, "formats with it: " + " ".join(e for e, f in FORMATS.items() if f not in (_mjcf, _urdf))
        )
    if FORMATS[kind] is _usd:
        _pxr("Usd")  # checked before fitting shapes, which takes minutes
    check_writable(out.parent)
    take = replace(_read(source, scene_file, FORMATS[kind], allow_outside, on_progress), collide=collide)
    if fps is not None and not take.moving:
        raise SdfsimError(f"--fps {fps:g}: {source} has no motion", "leave it out, or export a run")
    take = take if fps is None else take.at_rate(fps)
    out.parent.mkdir(parents=True, exist_ok=True)
    files, left_out = FORMATS[kind](take, out, on_progress)
    counts = {"bodies": len(take.names), "frames": len(take.time)}
    notes = [*take.notes, *(["z up is turned to glTF's y up"] if kind == ".glb" else [])]
    return {"format": kind[1:], **counts, "files": files, "left_out": left_out, "notes": notes}


def _pxr(name: str) -> Any:
    return optional(f"pxr.{name}", "usd-core", "export")


# --- the source ---


def _path(what: str, given: Any, wanted: str) -> Path:
    if not isinstance(given, str | Path):
        raise SdfsimError(f"{what}: must be a path (got a {type(given).__name__})", wanted)
    return Path(given)


def _read(
    source: Path | Scene, scene_file: Path | None, write: Callable, allow_outside: bool, on_progress: StageProgress
) -> Take:
    """What to export, with names and shapes as the function `write` needs them."""
    progress, run = of_stage(on_progress, "shapes"), None
    if isinstance(source, Path) and not source.exists():
        source = find_scene(source, or_run=True)
    if isinstance(source, Scene):
        scene = source
    elif source.suffix == ".npz" or (source / "rollout.npz").is_file():
        scene, run = read_run(source, scene_file, allow_outside=allow_outside, on_progress=progress)
    elif scene_file is not None:
        raise SdfsimError(f"{source}: --scene belongs to a run", "leave out --scene")
    elif (source / RECORD_FILE).is_file():
        shape = load_shape(source)
        moves = "dynamic" if shape.volume > 0 else "static"
        scene = SceneBuilder().add(shape.name, asset=source, motion=moves).load(progress)
    elif source.suffix.lower() in (".yaml", ".yml"):
        scene = load_scene(source, progress, allow_outside=allow_outside)
    elif not source.exists():
        raise SdfsimError(f"{source}: no such folder or file", "give a run folder, scene.yaml or Shape folder")
    else:
        hint = f"sdfsim fit {source} -o FOLDER makes a Shape folder of a mesh"
        message = f"{source}: not a run folder, a rollout.npz, a scene.yaml or a Shape folder"
        raise SdfsimError(message, hint if source.suffix.lower() in MESH_SUFFIXES else "")
    scene, notes = (scene, []) if write is _csv else _near(scene)
    if run is not None:
        time, turn = run.time, run.orientation.copy()
        turn[1:] *= np.cumprod(np.where((turn[1:] * turn[:-1]).sum(-1) < 0, -1.0, 1.0), axis=0)[..., None]
        com = np.array([body.scale * scene.shapes[body.shape].com for body in scene.bodies])
        offset = Rotation.from_quat(turn.reshape(-1, 4)).apply(np.tile(com, (len(turn), 1)))
        offset = offset.reshape(run.position.shape)
        place, speed = run.position - offset, run.velocity - np.cross(run.angular_velocity, offset)
        planes = [k for k, body in enumerate(scene.bodies) if is_infinite(scene.shapes[body.shape])]
        place[:, planes] = np.reshape([scene.bodies[k].position for k in planes], (-1, 3))
        speed[:, planes] = 0.0
    else:
        time, turn = np.zeros(1), np.array([[body.quat_xyzw for body in scene.bodies]])
        place = np.array([[body.position for body in scene.bodies]])
        speed = 0.0 * place
    # ROS allows ASCII only, and programs that read URDF may not find files with other names.
    ascii = write is _urdf
    names, shapes = (plain_names([one.name for one in ones], ascii) for ones in (scene.bodies, scene.shapes))
    pairs = zip((*scene.bodies, *scene.shapes), (*names, *shapes), strict=True)
    renamed = list(dict.fromkeys(f"{one.name} is called {name}" for one, name in pairs if one.name != name))
    if renamed and write is not _csv:
        more = f", and {len(renamed) - MOST_TOLD} more" if len(renamed) > MOST_TOLD else ""
        notes.append(", ".join(renamed[:MOST_TOLD]) + more)
    colors = np.array(body_colors(scene), dtype=np.uint8)
    return Take(scene, names, shapes, colors, time, place, turn, speed, ascii=ascii, notes=tuple(notes))


def _near(scene: Scene) -> tuple[Scene, list[str]]:
    """The same scene, but shapes far from their own origin (a map's coordinates) have it in their middle, because files
    hold vertices in single precision; and a line for each. Distances from the surface stay as they are."""
    middles = [np.zeros(3) if isinstance(s.sdf, ClosedForm) else far_middle(s.mesh.vertices) for s in scene.shapes]
    if not np.any(middles):
        return scene, []

    def moved(mesh: Mesh, middle: np.ndarray) -> Mesh:
        return replace(mesh, vertices=mesh.vertices - middle)

    shapes, arms, bodies = [], [], []
    for shape, c in zip(scene.shapes, middles, strict=True):
        skin, pieces = shape.skin and moved(shape.skin, c), tuple(piece - c for piece in shape.pieces)
        shape = replace(shape, mesh=moved(shape.mesh, c), skin=skin, pieces=pieces)
        shapes.append(replace(shape, nodes=shape.nodes - c, com=shape.com - c))
    for body in scene.bodies:
        arms.append(body.scale * middles[body.shape])
        path, place = body.path, body.position + Rotation.from_quat(body.quat_xyzw).apply(arms[-1])
        if path is not None:
            path = replace(path, position=path.position + Rotation.from_quat(path.quat_xyzw).apply(arms[-1]))
        bodies.append(replace(body, position=place, path=path))
    middle = framed(replace(scene, shapes=tuple(shapes), bodies=tuple(bodies)))[0]
    for k, body in enumerate(bodies):
        if is_infinite(shapes[body.shape]):  # drawn around its position, which may be any in it
            normal = Rotation.from_quat(body.quat_xyzw).apply([0.0, 0.0, 1.0])
            bodies[k] = replace(body, position=middle - (middle - body.position) @ normal * normal)
    held = [[np.zeros(3) if k < 0 else arms[k] for k in joint.bodies] for joint in scene.joints]
    joints = tuple(replace(joint, anchor=joint.anchor - arm) for joint, arm in zip(scene.joints, held, strict=True))
    frames = tuple(replace(f, position=f.position - (arms[f.body] if f.body >= 0 else 0.0)) for f in scene.frames)
    arm = {body.name: own for body, own in zip(bodies, arms, strict=True)}
    keys = {
        name: replace(key, bodies={
            of: (place + Rotation.from_quat(quat).apply(arm[of]), quat, *speeds)
            for of, (place, quat, *speeds) in key.bodies.items()
        })
        for name, key in scene.keyframes.items()
    }  # fmt: skip
    far = [(shape.name, c) for shape, c in zip(scene.shapes, middles, strict=True) if c.any()]
    notes = [f"{name} is far from its origin: poses are those of its middle, at {numbers(c)} m" for name, c in far]
    scene = replace(scene, shapes=tuple(shapes), bodies=tuple(bodies), joints=joints, frames=frames, keyframes=keys)
    return scene, notes


def plain_names(names: list[str], ascii: bool = False) -> list[str]:
    """Unique names that formats accept, in place of `names`: letters of any script or only of ASCII, digits and
    underscores."""
    used: set[str] = set(RESERVED)
    plain = []
    for name in names:
        kept = (
            c if f"_{c}".isidentifier() and (c.isascii() or not ascii) else " "
            for c in unicodedata.normalize("NFC", name)
        )
        # Trailing separators are dropped: `cup[3]` becomes `cup_3`.
        stem = "".join(kept).rstrip().replace(" ", "_") or "_"
        stem = stem if stem.isidentifier() else f"_{stem}"
        # Names that differ only in case are the same file on some systems.
        choice = next(c for k in range(len(used) + 1) if (c := f"{stem}_{k}" if k else stem).lower() not in used)
        used.add(choice.lower())
        plain.append(choice)
    return plain


# --- what several formats need ---


def _joint_names(take: Take) -> dict[str, str]:
    """Names that every format accepts, in place of the names of the joints."""
    names = [joint.name for joint in take.scene.joints]
    return dict(zip(names, plain_names(names, take.ascii), strict=True))


def _inertia(body: Body, shape: Shape) -> np.ndarray:
    """[3, 3] kg m^2 of a dynamic body about its centre of mass, shape axes."""
    return body.inertia if body.inertia is not None else body.mass / shape.volume * body.scale**2 * shape.inertia


def _principal(body: Body, shape: Shape) -> tuple[np.ndarray, Rotation]:
    """Principal moments [3] kg m^2 of a dynamic body, and the turn of their axes in the shape's."""
    moments, axes = np.linalg.eigh(_inertia(body, shape))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return moments, Rotation.from_matrix(axes)


def convex_pieces(shape: Shape, *, warn: bool = False) -> list[Mesh]:
    """Convex pieces [m]: the shape's own, or CoACD's, which are cut once for each mesh and then taken from the user's
    cache. With `warn`, a warning says so when that takes long. Raises SdfsimError if there are none."""
    if own := own_pieces(shape):
        return own
    mesh = shape.mesh if is_closed(shape.mesh) else _solid(shape)
    known = digest(mesh.vertices, mesh.faces, COACD)
    kept = cached_arrays(
        user_cache("pieces") / f"{known}-{PIECES_VERSION}.npz", "convex pieces", lambda: _cut(shape.name, mesh, warn)
    )
    ends = np.cumsum(kept["count"])[:-1]
    return [convex_hull(vertices) for vertices in np.split(kept["vertices"], ends)]


def _cut(name: str, mesh: Mesh, warn: bool) -> dict[str, Any]:
    """The vertices [V, 3] m of CoACD's pieces of a mesh, one after the other, and how many each has."""
    if warn:
        _log.warning("cutting the shape %s into convex pieces: some seconds, or minutes; once for this mesh", name)
    import open3d  # noqa: F401  (it fails to load after CoACD)

    coacd = optional("coacd", "coacd", "export")
    coacd.set_log_level("off")
    try:
        found = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), **COACD)
        hulls = [convex_hull(np.asarray(vertices)).vertices for vertices, _ in found]
    except (RuntimeError, ValueError, SdfsimError) as error:
        raise SdfsimError(f"shape {name}: CoACD cannot cut it into convex pieces ({error})") from error
    return {"vertices": np.concatenate(hulls), "count": [len(hull) for hull in hulls]}


def _solid(shape: Shape) -> Mesh:
    """The closed surface of a shape's distance, where its drawn mesh is open: scenery from photos."""
    from skimage.measure import marching_cubes

    low, high = shape.mesh.vertices.min(0), shape.mesh.vertices.max(0)
    cell = float((high - low).max()) / SOLID_CELLS
    counts = np.ceil((high - low) / cell).astype(int) + 5
    start = low - 2 * cell
    values = shape.sdf(start + cell * lattice(*(np.arange(count) for count in counts)))[0].reshape(counts)
    values = np.pad(values, 1, constant_values=cell)  # Closed where the matter goes on beyond what is drawn.
    vertices, faces, *_ = marching_cubes(values, 0.0, spacing=(cell,) * 3, gradient_direction="descent")
    return clean(Mesh(vertices + start - cell, faces.astype(np.int64)))


def _write_assets(
    take: Take, out: Path, cuts: Callable[[Body], bool], on_progress: StageProgress
) -> tuple[dict[int, Path], dict[int, list[Path]]]:
    """Write OBJ files to `NAME_assets/`. Returns them by the index of each shape that engines do not have: the shown
    mesh, and its convex pieces if a body `cuts` it."""
    folder, shapes = out.with_name(f"{out.stem}_assets"), take.scene.shapes

    def obj(name: str, mesh: Mesh) -> Path:
        folder.mkdir(exist_ok=True)
        write_text(folder / f"{name}.obj", wavefront([mesh]))
        return folder / f"{name}.obj"

    used = sorted({body.shape for body in take.scene.bodies})
    drawn = [k for k in used if not isinstance(shapes[k].sdf, COMMON_FORMS)]
    wanted = {body.shape for body in take.scene.bodies if cuts(body)}
    seen, cut = {}, {}
    for done, k in enumerate(drawn):
        on_progress("convex pieces", done / len(drawn), f"of {shapes[k].name}")
        seen[k] = obj(take.shapes[k], shapes[k].mesh)
        pieces = convex_pieces(shapes[k], warn=on_progress is silent_stages) if k in wanted else []
        cut[k] = [obj(f"{take.shapes[k]}-{i}", piece) for i, piece in enumerate(pieces)]
    return seen, cut


def _wxyz(quat_xyzw: np.ndarray) -> np.ndarray:
    return np.roll(quat_xyzw, 1, axis=-1)


def _rgba(shape: Shape, color: np.ndarray) -> str:
    """The colour for formats with one colour per mesh: the mean of its own colours, or `color`."""
    return numbers((color if shape.mesh.colors is None else shape.mesh.colors.mean(0)) / 255.0, 1.0)


def _write_xml(path: Path, root: XML) -> None:
    ElementTree.indent(root)
    write_text(path, ElementTree.tostring(root, encoding="unicode") + "\n")


def _missing(take: Take, *, motion: bool = False, textures: bool = False, frames: bool = False) -> list[str]:
    """The lines for a format without motion, without textures, or without frames."""
    led = any(body.motion == "kinematic" for body in take.scene.bodies)
    lines = {
        "frames": bool(take.scene.frames) and not frames,
        "the motion: the scene is exported as at the start": take.moving and not motion,
        "the paths of kinematic bodies: they stay at their start": led and not (take.moving and motion),
        "stiffness and damping of contacts: all bodies are rigid": any(
            math.isfinite(body.stiffness) for body in take.scene.bodies
        ),
        "textures and colours of single faces: colours of vertices, or one colour, are in their place": not textures
        and any(shape.skin is not None for shape in take.scene.shapes),
    }
    return [line for line, missing in lines.items() if missing]


# --- glTF ---


def _glb(take: Take, out: Path, on_progress: StageProgress) -> Written:
    file, (middle, radius) = GltfWriter(), framed(take.scene)
    file.origin = np.round(far_middle(middle + radius * np.array([[-1.0], [1.0]])))
    # Bodies of the same shape, size and colour share a mesh; those of the same shape and size share its arrays. Nodes
    # have no scale, as the drafts of physics do not say whether it scales masses and velocities.
    arrays: dict[Any, tuple[dict[str, int], int]] = {}
    drawn: dict[tuple[str, Any], int] = {}
    painted: dict[str, int] = {}
    time = file.array(take.time) if take.moving else 0
    samplers, channels = [], []
    for k, (name, body, shape, color) in enumerate(take.each()):
        seen = shown(take.scene, k, take.plane_size())
        form = (body.shape, body.scale, k if is_infinite(shape) else -1)  # planes differ by what lies in them
        own = seen.colors is not None or seen.texture is not None
        if form not in arrays:
            mesh, normals = with_normals(seen)
            attributes = {"POSITION": file.array(body.scale * mesh.vertices), "NORMAL": file.array(normals)}
            if mesh.uv is not None:
                attributes["TEXCOORD_0"] = file.array(mesh.uv)
            if mesh.colors is not None:  # in 16 bits: for linear light, 8 are too few for dark colours
                shades = np.pad(light(mesh.colors), ((0, 0), (0, 1)), constant_values=1.0)
                attributes["COLOR_0"] = file.array(np.round(65535 * shades), "<u2")
            arrays[form] = attributes, file.array(mesh.faces.reshape(-1), "<u4")
        key = take.shapes[body.shape] + ("" if own else "-{:02x}{:02x}{:02x}".format(*color))
        if (key, form) not in drawn:
            if key not in painted:
                tint = np.ones(3) if own else light(color)
                painted[key] = file.material(key, tint, seen.texture, seen.maps, rough=0.8, lit=True)
            drawn[key, form] = file.mesh(key, *arrays[form], painted[key])
        place, turn = take.position[:, k] - file.origin, take.quat_xyzw[:, k]
        node = {"translation": place[0].tolist(), "rotation": turn[0].tolist()}
        file.nodes.append({"name": name, "mesh": drawn[key, form], **node})
        if take.moving and body.motion != "static":
            for path, values in (("translation", place), ("rotation", turn)):
                channels.append({"sampler": len(samplers), "target": {"node": k, "path": path}})
                samplers.append({"input": time, "output": file.array(values), "interpolation": "LINEAR"})
    if channels:
        file.animations.append({"name": "run", "samplers": samplers, "channels": channels})
    left_out = _missing(take, motion=True, textures=True)
    if take.moving:  # by the draft bodies then follow their motion; and Blender would show each collider
        left_out.insert(0, "masses, friction and everything else that is not visible: the export of the scene has them")
    else:
        _gltf_physics(take, file)
        left_out.insert(0, "gravity: glTF has none, programs use their own")
        left_out += jointed.gltf_joints(file, take.scene, _joint_names(take)) if take.scene.joints else []
    write_bytes(out, file.to_bytes())
    return [out], left_out


def _gltf_physics(take: Take, file: GltfWriter) -> None:
    """Add masses, velocities and colliders to the nodes of the bodies, which are the first ones, by the drafts of
    KHR_physics_rigid_bodies and KHR_implicit_shapes of October 2025 (github.com/eoineoineoin/glTF_Physics)."""
    forms: dict[Any, int] = {}
    surfaces: dict[tuple[float, float], int] = {}
    solids: dict[tuple[int, float], list[dict[str, Any]]] = {}
    group, allowed = contact_groups(take.scene.bodies)
    for k, (name, body, shape, _) in enumerate(take.each()):
        physics: dict[str, Any] = {"motion": {"isKinematic": True}} if body.motion == "kinematic" else {}
        if body.motion == "dynamic":
            moments, axes = _principal(body, shape)
            back = Rotation.from_quat(body.quat_xyzw).inv()  # the draft has velocities in the axes of the node
            physics["motion"] = {
                "mass": body.mass, "centerOfMass": (body.scale * shape.com).tolist(),
                "inertiaDiagonal": moments.tolist(), "inertiaOrientation": axes.as_quat().tolist(),
                "linearVelocity": back.apply(body.velocity).tolist(),
                "angularVelocity": back.apply(body.angular_velocity).tolist(),
            }  # fmt: skip
        if isinstance(shape.sdf, COMMON_FORMS):
            geometries = [{"shape": forms.setdefault(shape.sdf.scaled(body.scale), len(forms))}]
        elif body.motion != "dynamic":
            geometries = [{"node": k}]
        else:
            if (size := (body.shape, body.scale)) not in solids:
                solids[size] = _gltf_solids(file, take.shapes[body.shape], shape, body.scale)
            geometries = solids[size] or [{"node": k}]
        touch = {"physicsMaterial": surfaces.setdefault((body.friction, body.restitution), len(surfaces))}
        touch |= {} if allowed.all() else {"collisionFilter": int(group[k])}
        turn = {"rotation": UPRIGHT} if isinstance(shape.sdf, PlaneSdf | CapsuleSdf | CylinderSdf) else {}
        for number, geometry in enumerate(geometries):
            if len(geometries) == 1 and not turn:
                physics["collider"] = {"geometry": geometry, **touch}
                continue
            own = {jointed.GLTF_PHYSICS: {"collider": {"geometry": geometry, **touch}}}
            file.below(k, {"name": f"{name}-{number}", **turn, "extensions": own})
        if physics:
            file.nodes[k]["extensions"] = {jointed.GLTF_PHYSICS: physics}
    if forms:
        file.extensions["KHR_implicit_shapes"] = {"shapes": [_gltf_form(form) for form in forms]}
    how = {"frictionCombine": "multiply", "restitutionCombine": "multiply"}
    materials = [{"staticFriction": f, "dynamicFriction": f, "restitution": r, **how} for f, r in surfaces]
    file.extensions[jointed.GLTF_PHYSICS] = {"physicsMaterials": materials}
    if not allowed.all():
        apart = [[f"group_{other}" for other in np.flatnonzero(~row)] for row in allowed]
        filters = [
            {"collisionSystems": [f"group_{g}"]} | ({"notCollideWithSystems": others} if others else {})
            for g, others in enumerate(apart)
        ]
        file.extensions[jointed.GLTF_PHYSICS]["collisionFilters"] = filters


def _gltf_form(form: Any) -> dict[str, Any]:
    if isinstance(form, BoxSdf):
        sizes: dict[str, Any] = {"size": [2.0 * half for half in form.half]}
    elif isinstance(form, SphereSdf):
        sizes = {"radius": form.radius}
    elif isinstance(form, CapsuleSdf | CylinderSdf):
        sizes = {"height": 2.0 * form.half, "radiusBottom": form.radius, "radiusTop": form.radius}
    else:
        sizes = {}
    return {"type": form.KIND, form.KIND: sizes}


def _gltf_solids(file: GltfWriter, name: str, shape: Shape, scale: float) -> list[dict[str, Any]]:
    """The geometries of a moving body whose drawn mesh is not what touches: its convex pieces, or the closed mesh below
    its skin."""
    pieces, found = own_pieces(shape), []
    for number, solid in enumerate(pieces or ([shape.mesh] if shape.skin is not None else [])):
        called = f"{name}-solid_{number}"
        corners = file.array(solid.faces.reshape(-1), "<u4")
        mesh = file.mesh(called, {"POSITION": file.array(scale * solid.vertices)}, corners)
        node = file.below(-1, {"name": called, "mesh": mesh})
        file.aside.add(node)
        found.append({"node": node} | ({"convexHull": True} if pieces else {}))
    return found


# --- USD ---


def _usd(take: Take, out: Path, on_progress: StageProgress) -> Written:
    names = ("Gf", "Sdf", "Usd", "UsdGeom", "UsdPhysics", "UsdShade")
    gf, sdf, usd, geom, physics, shade = (_pxr(name) for name in names)
    stage = usd.Stage.CreateInMemory()
    geom.SetStageMetersPerUnit(stage, 1.0)
    geom.SetStageUpAxis(stage, geom.Tokens.z)
    physics.SetStageKilogramsPerUnit(stage, 1.0)
    stage.SetDefaultPrim(geom.Xform.Define(stage, "/World").GetPrim())
    for group in ("materials", "shapes"):
        stage.DefinePrim(f"/World/{group}", "Scope")
    strength = float(np.linalg.norm(take.scene.gravity))
    gravity = physics.Scene.Define(stage, "/World/physics")
    gravity.CreateGravityDirectionAttr(gf.Vec3f(*(take.scene.gravity / strength if strength else (0.0, 0.0, -1.0))))
    gravity.CreateGravityMagnitudeAttr(strength)
    codes = np.round(take.rate * take.time, 9)  # whole numbers at a given frame rate
    if take.moving:
        stage.SetTimeCodesPerSecond(take.rate)
        stage.SetFramesPerSecond(take.rate)
        stage.SetStartTimeCode(float(codes[0]))
        stage.SetEndTimeCode(float(codes[-1]))

    drawn: dict[tuple[int, bool], str] = {}
    materials: dict[tuple[float, float], Any] = {}
    for k, (name, body, shape, color) in enumerate(take.each()):
        prim = geom.Xform.Define(stage, f"/World/{name}").GetPrim()
        place = geom.Xformable(prim).AddTranslateOp()
        turn = geom.Xformable(prim).AddOrientOp(geom.XformOp.PrecisionDouble)
        animated = take.moving and body.motion != "static"
        for t in range(len(take.time) if animated else 1):
            code = usd.TimeCode(float(codes[t])) if animated else usd.TimeCode.Default()
            place.Set(gf.Vec3d(*take.position[t, k].tolist()), code)
            turn.Set(gf.Quatd(*_wxyz(take.quat_xyzw[t, k]).tolist()), code)
        tint = geom.PrimvarsAPI(prim).CreatePrimvar("displayColor", sdf.ValueTypeNames.Color3fArray)
        tint.Set([gf.Vec3f(*light(color).tolist())])
        if body.motion != "static":
            _usd_apply(prim, "PhysicsRigidBodyAPI", kinematicEnabled=body.motion == "kinematic")
        if body.motion == "dynamic":
            spin = np.rad2deg(body.angular_velocity)
            velocities = {"velocity": gf.Vec3f(*body.velocity.tolist()), "angularVelocity": gf.Vec3f(*spin.tolist())}
            _usd_apply(prim, "PhysicsRigidBodyAPI", **velocities)
            diagonal, axes = _principal(body, shape)
            com, turned = body.scale * shape.com, _wxyz(axes.as_quat())
            masses = {"mass": body.mass, "centerOfMass": gf.Vec3f(*com.tolist())}
            masses |= {"diagonalInertia": gf.Vec3f(*diagonal.tolist()), "principalAxes": gf.Quatf(*turned.tolist())}
            _usd_apply(prim, "PhysicsMassAPI", **masses)
        surface = (body.friction, body.restitution)
        if surface not in materials:
            materials[surface] = shade.Material.Define(stage, f"/World/materials/surface_{len(materials)}")
            made, (friction, restitution) = materials[surface].GetPrim(), surface
            values = {"staticFriction": friction, "dynamicFriction": friction, "restitution": restitution}
            _usd_apply(made, "PhysicsMaterialAPI", **values)
            # By default PhysX uses the mean of two bodies' coefficients. Its schema is not part of OpenUSD.
            made.AddAppliedSchema("PhysxMaterialAPI")
            for what in ("friction", "restitution"):
                made.CreateAttribute(f"physxMaterial:{what}CombineMode", sdf.ValueTypeNames.Token).Set("multiply")
        shade.MaterialBindingAPI.Apply(prim).Bind(materials[surface], materialPurpose="physics")

        of = (body.shape, body.motion == "dynamic")
        if of not in drawn:
            drawn[of] = f"/World/shapes/{take.shapes[body.shape]}" + ("" if of[1] else "_fixed")
            stage.CreateClassPrim(drawn[of])
            _usd_geometry(take, shape, of[1], stage, drawn[of])
        solid = geom.Xform.Define(stage, f"/World/{name}/geometry")
        solid.GetPrim().GetReferences().AddInternalReference(drawn[of])
        solid.AddScaleOp().Set(gf.Vec3f(body.scale))

    group, allowed = contact_groups(take.scene.bodies)
    if not allowed.all():
        stage.DefinePrim("/World/groups", "Scope")
    for g in range(len(allowed) if not allowed.all() else 0):
        made = physics.CollisionGroup.Define(stage, f"/World/groups/group_{g}")
        for k in np.flatnonzero(group == g):
            made.GetCollidersCollectionAPI().IncludePath(f"/World/{take.names[k]}")
        for other in np.flatnonzero(~allowed[g]):
            made.CreateFilteredGroupsRel().AddTarget(f"/World/groups/group_{other}")

    left_out = _missing(take, motion=True)
    if take.scene.joints:
        left_out += jointed.usd_joints(stage, physics, gf, take.scene, take.names, _joint_names(take))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"stage{out.suffix.lower()}"  # OpenUSD chooses the format by the ending
        if not stage.GetRootLayer().Export(str(file)):
            raise SdfsimError(f"{file}: OpenUSD cannot write it")
        write_bytes(out, file.read_bytes())
    return [out], left_out


def _usd_apply(prim: Any, schema: str, **values: Any) -> None:
    """Apply a UsdPhysics schema to a prim, with values for its attributes."""
    prim.ApplyAPI(schema)
    for name, value in values.items():
        prim.GetAttribute(f"physics:{name}").Set(value)


def _usd_geometry(take: Take, shape: Shape, dynamic: bool, stage: Any, path: str) -> None:
    """Write prims below `path` for display and collision."""
    gf, geom = _pxr("Gf"), _pxr("UsdGeom")
    form, solid = shape.sdf, f"{path}/solid"
    if isinstance(form, COMMON_FORMS):
        if isinstance(form, SphereSdf):
            sizes: dict[str, Any] = {"radius": form.radius}
        elif isinstance(form, BoxSdf):
            sizes = {"size": 2.0}
        elif isinstance(form, CapsuleSdf | CylinderSdf):
            sizes = {"axis": "Z", "radius": form.radius, "height": 2.0 * form.half}
        else:
            sizes = {"axis": "Z", "width": 2.0 * take.plane_size(), "length": 2.0 * take.plane_size()}
        prim = stage.DefinePrim(solid, "Cube" if isinstance(form, BoxSdf) else form.KIND.title())
        for name, value in sizes.items():
            prim.GetAttribute(name).Set(value)
        if isinstance(form, BoxSdf):
            geom.Xformable(prim).AddScaleOp().Set(gf.Vec3f(*form.half))
        _usd_apply(prim, "PhysicsCollisionAPI")
        return
    seen = _usd_mesh(stage, solid, shape.mesh)
    pieces = own_pieces(shape) if dynamic else []
    # Unless a moving body has pieces, engines sample distances from its surface themselves.
    colliders = [(seen, "sdf" if dynamic else "none")]
    if pieces:
        colliders = [(_usd_mesh(stage, f"{path}/piece_{k}", piece), "convexHull") for k, piece in enumerate(pieces)]
    elif dynamic:
        for schema, cells in USD_GRIDS.items():
            seen.AddAppliedSchema(schema)
            seen.CreateAttribute(cells, _pxr("Sdf").ValueTypeNames.Int).Set(USD_CELLS)
    for collider, approximation in colliders:
        if pieces:
            geom.Imageable(collider).CreatePurposeAttr(geom.Tokens.guide)
        _usd_apply(collider, "PhysicsCollisionAPI")
        _usd_apply(collider, "PhysicsMeshCollisionAPI", approximation=approximation)


def _usd_mesh(stage: Any, path: str, mesh: Mesh) -> Any:
    geom, vt = _pxr("UsdGeom"), _pxr("Vt")
    split, normals = with_normals(mesh)
    prim, points = geom.Mesh.Define(stage, path), vt.Vec3fArray.FromNumpy(mesh.vertices.astype(np.float32))
    prim.CreatePointsAttr(points)
    prim.CreateExtentAttr(geom.PointBased.ComputeExtent(points))
    prim.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, dtype=np.int32)))
    prim.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(mesh.faces.reshape(-1).astype(np.int32)))
    prim.CreateSubdivisionSchemeAttr(geom.Tokens.none)
    prim.CreateDoubleSidedAttr(True)
    prim.CreateNormalsAttr(vt.Vec3fArray.FromNumpy(normals[split.faces.reshape(-1)].astype(np.float32)))
    prim.SetNormalsInterpolation(geom.Tokens.faceVarying)
    if mesh.colors is not None:
        tint = prim.CreateDisplayColorPrimvar(geom.Tokens.vertex)
        tint.Set(vt.Vec3fArray.FromNumpy(light(mesh.colors).astype(np.float32)))
    return prim.GetPrim()


# --- MuJoCo ---


def _mjcf(take: Take, out: Path, on_progress: StageProgress) -> Written:
    # The scene's own start has this name.
    posed = {name: _posed(take.scene, name) for name in take.scene.keyframes if name != "start"}
    posed = {name: _refined(replace(take, scene=at))[0].scene for name, at in posed.items()}
    take, left_out = _refined(take)
    scene, left_out = take.scene, [*left_out, *_missing(take, frames=True)]
    sampled = take.collide == "sdf"
    seen, cut = _write_assets(take, out, lambda body: not sampled, on_progress)
    root = XML("mujoco", model=plain_names([out.stem])[0])
    folder = out.with_name(f"{out.stem}_assets").name
    add(root, "compiler", angle="radian", meshdir=folder, balanceinertia="true")
    add(root, "option", timestep=numbers(STEP), gravity=numbers(scene.gravity), cone="elliptic", impratio="10")
    if scene.joints:  # with the explicit default, stiff motors of light links chatter
        root[-1].set("integrator", "implicitfast")
    if sampled:  # number of starts and iterations with which MuJoCo searches the nearest points of two bodies
        root[-1].attrib |= {"sdf_initpoints": "40", "sdf_iterations": "10"}
    add(root, "size", memory="512M")  # of address space; contacts of many pieces need more than the default
    asset, world = add(root, "asset"), add(root, "worldbody")
    add(world, "light", directional="true", castshadow="false", pos="0 0 10", dir="-0.4 0.3 -0.9")
    group, allowed = contact_groups(scene.bodies)
    if len(allowed) > MOST_GROUPS:
        left_out.append(f"collides_with: {len(allowed)} groups of bodies (MuJoCo supports {MOST_GROUPS})")
        group, allowed = np.zeros_like(group), np.ones((1, 1), dtype=bool)
    meshes: set[str] = set()
    geoms: list[list[str]] = [[] for _ in take.names]
    tree, joint_names = jointed.trees(scene), _joint_names(take)
    nodes: dict[int, XML] = {-1: world}

    def mesh_of(file: Path, scale: float) -> str:
        name = file.stem + ("" if scale == 1.0 else f"-x{scale:.9g}")
        if name not in meshes:
            meshes.add(name)
            # "convex" and "shell" also work without an enclosed volume, which meshes for display may lack.
            inertia = "convex" if "-" in file.stem else "shell"
            add(asset, "mesh", name=name, file=file.name, scale=numbers([scale] * 3), inertia=inertia)
        return name

    every = list(take.each())
    for k in tree.order:
        (name, body, shape, color), above = every[k], tree.above.get(k)
        place, turned = jointed.mjcf_pose(scene, tree, k)
        node = add(nodes[above.parent if above else -1], "body", name=name, pos=numbers(place))
        node.set("quat", numbers(_wxyz(turned)))
        nodes[k] = node
        if body.motion == "kinematic":
            node.set("mocap", "true")
        elif body.motion == "dynamic":
            if above:
                jointed.mjcf_joint(node, above, joint_names[above.joint.name])
            else:
                add(node, "freejoint", name=f"{name}_free")
            com, tensor = body.scale * shape.com, _inertia(body, shape)
            full = numbers(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
            add(node, "inertial", pos=numbers(com), mass=numbers(body.mass), fullinertia=full)
        rgba = _rgba(shape, color)
        if body.shape in seen:
            mesh = mesh_of(seen[body.shape], body.scale)
            add(node, "geom", type="mesh", mesh=mesh, rgba=rgba, group="2", contype="0", conaffinity="0")
            solids = [{"type": "mesh", "mesh": mesh_of(file, body.scale), "group": "3"} for file in cut[body.shape]]
            if sampled:
                solids = [{"type": "sdf", "mesh": mesh, "group": "3"}]
        else:
            form: Any = shape.sdf
            sizes = (take.plane_size(),) * 3 if isinstance(form, PlaneSdf) else form.scaled(body.scale).sizes
            solids = [{"type": form.KIND, "size": numbers(sizes), "rgba": rgba}]
        mates = sum(1 << g for g in np.flatnonzero(allowed[group[k]]))
        surface = {"condim": "3", "contype": f"{1 << group[k]}", "conaffinity": f"{mates}"}
        surface |= _mjcf_surface(body.friction**2, body.restitution**2)
        geoms[k] = [f"{name}-{i}" for i in range(len(solids))]
        for solid, label in zip(solids, geoms[k], strict=True):
            add(node, "geom", name=label, **solid, **surface)

    for frame in scene.frames:
        site = add(nodes[frame.body], "site", name=frame.name, pos=numbers(frame.position), size="0.002")
        site.set("quat", numbers(_wxyz(frame.quat_xyzw)))

    # Between bodies of the same material the square is the product. Other pairs are written one by one, up to a limit:
    # first those of bodies with few geoms, as the floor is one.
    pairs, apart = [], {frozenset(joint.bodies) for joint in scene.joints if not joint.collides}
    surfaces = [(b.friction, b.restitution) for b in scene.bodies]
    order = sorted(range(len(geoms)), key=lambda k: len(geoms[k])) if len(set(surfaces)) > 1 else []
    for i, j in combinations(order, 2):
        one, other = scene.bodies[i], scene.bodies[j]
        if surfaces[i] == surfaces[j] or "dynamic" not in (one.motion, other.motion) or not allowed[group[i], group[j]]:
            continue
        if frozenset((i, j)) in apart:
            continue
        if len(pairs) + len(geoms[i]) * len(geoms[j]) > MOST_PAIRS:
            left_out.append(
                "friction and restitution of some pairs of unlike bodies: the larger friction of the two is used"
            )
            break
        surface = _mjcf_surface(one.friction * other.friction, one.restitution * other.restitution, pair=True)
        pairs += [{"geom1": a, "geom2": b, "condim": "3", **surface} for a in geoms[i] for b in geoms[j]]
    contact = add(root, "contact") if pairs else root
    for pair in pairs:
        add(contact, "pair", **pair)
    if scene.joints:
        ends = [nodes[k] for k in range(len(take.names))] + [world]
        left_out += jointed.mjcf_rest(root, ends, scene, tree, take.names, joint_names, STEP)
    keys = {name: jointed.mjcf_state(scene, at, tree) for name, at in {"start": scene, **posed}.items()}
    if keys["start"]:
        element = add(root, "keyframe")
        for name, key in keys.items():
            add(element, "key", name=name, **key)
    _write_xml(out, root)
    return [out, *seen.values(), *(file for files in cut.values() for file in files)], left_out


def _posed(scene: Scene, keyframe: str) -> Scene:
    """The scene with its bodies, joints and targets of motors as in a keyframe."""
    from sdfsim.simulate.record import at_frame
    from sdfsim.simulate.simulator import Simulator

    simulator = Simulator(replace(scene, model="solver", effects=Effects()))
    simulator.reset(keyframe=keyframe)
    with simulator.record() as run:
        return at_frame(scene, run.rollout)


def _refined(take: Take) -> tuple[Take, list[str]]:
    """The data for MuJoCo, and a line if lengths are in a finer unit than metres. All lengths are `FINER` times as
    large, and so is gravity, with the same densities and times; so the motion is the same, up to the softness of
    contacts."""
    scene, k = take.scene, FINER
    small = []
    for body in scene.bodies:
        shape = scene.shapes[body.shape]
        moment = np.linalg.eigvalsh(_inertia(body, shape))[0] if body.motion == "dynamic" else np.inf
        meshed = not isinstance(shape.sdf, COMMON_FORMS)
        size = body.scale * float(np.ptp(shape.mesh.vertices, axis=0).max()) if meshed else np.inf
        small += [body.name] if moment < LEAST_MOMENT or size < LEAST_SIZE else []
    if not small:
        return take, []
    bodies = tuple(
        replace(
            body, scale=k * body.scale, position=k * body.position, velocity=k * body.velocity, mass=k**3 * body.mass,
            inertia=None if body.inertia is None else k**5 * body.inertia,
        )
        for body in scene.bodies
    )  # fmt: skip
    along = [1.0 if joint.kind == "hinge" else k for joint in scene.joints]
    couplings = tuple(
        replace(c, ratio=c.ratio * along[c.joints[0]] / along[c.joints[1]], offset=c.offset * along[c.joints[0]])
        for c in scene.couplings
    )
    scene = replace(
        scene, bodies=bodies, joints=tuple(map(_refined_joint, scene.joints)), gravity=k * scene.gravity,
        frames=tuple(replace(frame, position=k * frame.position) for frame in scene.frames), couplings=couplings,
    )  # fmt: skip
    fall = numbers(np.linalg.norm(scene.gravity))
    line = (
        f"metres and kilograms, as MuJoCo refuses bodies as small as {small[0]}: lengths are in mm, masses in 1e-9 kg"
    )
    return replace(take, scene=scene), [f"{line}, gravity is {fall} mm/s^2"]


def _refined_joint(joint: Joint) -> Joint:
    k, turns = FINER, joint.kind in ("hinge", "ball")
    along = 1.0 if turns else k  # of what it measures: rad, or m
    push = k**5 if turns else k**4  # of what acts along it: N m, or N
    spring, motor, limits = joint.spring, joint.motor, joint.limits
    if spring is not None:
        spring = replace(spring, stiffness=spring.stiffness * push / along, rest=spring.rest * along)
    if motor is not None:
        speed, position = (None if goal is None else goal * along for goal in (motor.speed, motor.position))
        gain = None if motor.gain is None else motor.gain * push / along
        motor = replace(motor, max_force=motor.max_force * push, speed=speed, position=position, gain=gain)
    return replace(
        joint, anchor=k * joint.anchor, start=along * joint.start,
        limits=limits and (limits[0] * along, limits[1] * along),
        length=None if joint.length is None else k * joint.length, damping=joint.damping * push / along,
        friction=joint.friction * push, armature=joint.armature * push / along, spring=spring, motor=motor,
        breaks_force=k**4 * joint.breaks_force, breaks_torque=k**5 * joint.breaks_torque,
    )  # fmt: skip


def rebound(damping: np.ndarray) -> np.ndarray:
    """The part of the speed that a contact of MuJoCo returns, which is a spring that only pushes, by its damping z
    relative to the critical one: exp(-z arccos(2 z^2 - 1) / sqrt(1 - z^2)); also for z above 1, where arccos and root
    are imaginary."""
    turned = np.emath.arccos(2.0 * damping**2 - 1.0) / np.emath.sqrt(1.0 - damping**2)
    return np.exp(-damping * np.abs(turned))


def _mjcf_surface(friction: float, restitution: float, *, pair: bool = False) -> dict[str, str]:
    """Friction, and a contact as stiff as the step allows, damped so that bodies separate with the part `restitution`
    of their speed: MuJoCo has no restitution."""
    damping = (np.arange(1000) + 0.5) * SOFT / 2000  # up to the largest that MuJoCo does not change
    found = np.interp(-restitution, -rebound(damping), damping)
    sliding = [friction, friction, 0.005, 0.0001, 0.0001] if pair else [friction, 0.005, 0.0001]
    return {"friction": numbers(sliding), "solref": numbers(SOFT * STEP / found, found)}


# --- URDF ---


def _urdf(take: Take, out: Path, on_progress: StageProgress) -> Written:
    seen, cut = _write_assets(take, out, lambda body: body.motion != "static", on_progress)
    files: list[Path] = []
    single = len(take.names) == 1 and take.scene.path is None
    tree, joint_names, every = jointed.trees(take.scene), _joint_names(take), list(take.each())
    links = dict(enumerate(take.names)) | {-1: "world"}
    robots: dict[int, tuple[XML, Path]] = {}  # by their bodies
    roots: dict[int, str] = {}
    for k in tree.order:
        (name, body, shape, color), above = every[k], tree.above.get(k)
        if above is None or above.parent < 0:
            roots[k] = name
            robots[k] = XML("robot", name=name), out if single else out.with_name(f"{out.stem}.{name}.urdf")
            if above is not None:
                add(robots[k][0], "link", name="world")
            files.append(robots[k][1])
        else:
            robots[k] = robots[above.parent]
        root = robots[k][0]
        link = add(root, "link", name=name)
        # The origin of a link that a joint holds is at the joint.
        origin = np.zeros(3) if above is None else above.anchor
        surface = add(link, "contact")
        add(surface, "lateral_friction", value=numbers(body.friction))
        add(surface, "restitution", value=numbers(body.restitution))
        moves = body.motion == "dynamic"
        inertial = add(link, "inertial")
        add(inertial, "origin", xyz=numbers(body.scale * shape.com - origin), rpy="0 0 0")
        add(inertial, "mass", value=numbers(body.mass if moves else 0.0))
        tensor = _inertia(body, shape) if moves else np.zeros((3, 3))
        sides = {f"i{'xyz'[a]}{'xyz'[b]}": numbers(tensor[a, b]) for a in range(3) for b in range(a, 3)}
        add(inertial, "inertia", **sides)

        def part(tag: str, link: XML = link, origin: np.ndarray = origin, **keys: str) -> XML:
            made = add(link, tag, **keys)
            if np.any(origin):
                add(made, "origin", xyz=numbers(-origin), rpy="0 0 0")
            return made

        def mesh(element: XML, file: Path, scale: float = body.scale) -> None:
            path = f"{file.parent.name}/{file.name}"
            add(add(element, "geometry"), "mesh", filename=path, scale=numbers([scale] * 3))

        if body.shape not in seen:
            if isinstance(shape.sdf, PlaneSdf):  # PyBullet does not draw planes
                visual = add(link, "visual")
                add(visual, "origin", xyz="0 0 -0.001", rpy="0 0 0")
                add(add(visual, "geometry"), "box", size=numbers([2.0 * take.plane_size()] * 2, 0.002))
            else:
                visual = part("visual")
                _urdf_form(add(visual, "geometry"), shape.sdf, body.scale)
            _urdf_form(add(part("collision"), "geometry"), shape.sdf, body.scale)
        else:
            visual = part("visual")
            mesh(visual, seen[body.shape])
            if body.motion == "static":  # the triangles themselves, which PyBullet supports for static bodies
                mesh(part("collision", concave="yes"), seen[body.shape])
            for file in cut[body.shape] if body.motion != "static" else []:
                mesh(part("collision"), file)
        rgba = _rgba(shape, color)
        add(add(visual, "material", name=f"{name}_color"), "color", rgba=rgba)
        if above is not None:
            held_at = tree.above[above.parent].anchor if above.parent in tree.above else np.zeros(3)
            jointed.urdf_joint(root, above, k, joint_names, links, held_at, take.scene)
        for frame in (f for f in take.scene.frames if f.body == k and f.name not in take.names):
            # Without a mass, PyBullet takes a link for one of 1 kg.
            weight = add(add(root, "link", name=frame.name), "inertial")
            add(weight, "mass", value=numbers(WEIGHTLESS))
            small = numbers(WEIGHTLESS**2)
            add(weight, "inertia", ixx=small, iyy=small, izz=small, ixy="0", ixz="0", iyz="0")
            joint = add(root, "joint", name=f"{frame.name}_frame", type="fixed")
            add(joint, "parent", link=name)
            add(joint, "child", link=frame.name)
            rpy = numbers(Rotation.from_quat(frame.quat_xyzw).as_euler("xyz"))
            add(joint, "origin", xyz=numbers(frame.position - origin), rpy=rpy)
    for root, file in dict((id(root), (root, file)) for root, file in robots.values()).values():
        _write_xml(file, root)
    assets = [*seen.values(), *(file for found in cut.values() for file in found)]
    if single:
        return [*files, *assets], []
    poses = out.with_suffix(".poses.csv")  # not NAME.csv, which is what recordings are called
    position, quat = take.position[:1].copy(), take.quat_xyzw[:1].copy()
    held = [k for k in roots if k in tree.above]  # by a joint in the world, which is the first link of their files
    position[:, held], quat[:, held] = 0.0, (0.0, 0.0, 0.0, 1.0)
    start = replace(take, time=take.time[:1], position=position, quat_xyzw=quat)
    _write_poses(start, poses, roots)
    left_out = [
        "the poses of bodies: they are in the CSV",
        "gravity, velocities and collides_with",
        *_missing(take, frames=True),
    ]
    left_out += jointed.urdf_left_out(take.scene, tree)
    return [*files, poses, *assets], left_out


def _urdf_form(geometry: XML, form: Any, scale: float) -> None:
    form = form.scaled(scale)
    if isinstance(form, PlaneSdf):
        add(geometry, "plane", normal="0 0 1")
    elif isinstance(form, SphereSdf):
        add(geometry, "sphere", radius=numbers(form.radius))
    elif isinstance(form, BoxSdf):
        add(geometry, "box", size=numbers(2.0 * np.array(form.half)))
    else:
        add(geometry, form.KIND, radius=numbers(form.radius), length=numbers(2.0 * form.half))


# --- poses ---


def _csv(take: Take, out: Path, on_progress: StageProgress) -> Written:
    _write_poses(take, out, {k: body.name for k, body in enumerate(take.scene.bodies)})
    return [out], ["everything but poses"]


def _write_poses(take: Take, out: Path, names: dict[int, str]) -> None:
    """The poses of the bodies that have a name here."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for t, time in enumerate(take.time):
        for k, name in names.items():
            pose = np.concatenate([take.position[t, k], take.quat_xyzw[t, k]])
            writer.writerow([f"{time:.9g}", name, *(f"{value:.12g}" for value in pose)])
    write_text(out, text.getvalue())


# --- a page ---


def _html(take: Take, out: Path, on_progress: StageProgress) -> Written:
    """A page that plays the motion by itself. Poses are relative to a place near the scene, as viser draws in single
    precision, and of centres of mass."""
    from sdfsim.apps.page import film

    middle, radius = framed(take.scene)
    origin = np.round(far_middle(middle + radius * np.array([[-1.0], [1.0]])))
    bodies = tuple(replace(body, position=body.position - origin) for body in take.scene.bodies)
    com = np.array([body.scale * take.scene.shapes[body.shape].com for body in bodies])
    place = take.position - origin + pose.rotate(take.quat_xyzw, com)
    made = film(replace(take.scene, bodies=bodies), take.names, take.time, place, take.quat_xyzw)
    write_text(out, made.as_html())
    return [out], ["everything that is not visible, and frames between those of the run"]


FORMATS: dict[str, Callable[[Take, Path, StageProgress], Written]] = {
    ".glb": _glb,
    **dict.fromkeys((".usd", ".usda", ".usdc"), _usd),
    **dict.fromkeys((".xml", ".mjcf"), _mjcf),
    ".urdf": _urdf,
    ".csv": _csv,
    ".html": _html,
}
