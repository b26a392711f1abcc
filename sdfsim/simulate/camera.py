"""Pictures of scenes as arrays (colour, depth, which body), without a screen or a graphics driver.

Rays are cast on the CPU. Each shape has a tree of its triangles in its own frame, made once: an image moves rays into
the frames of bodies, so nothing is built again when bodies move.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sdfsim.base.errors import SdfsimError, nearest
from sdfsim.base.lazy import made_once
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, lattice
from sdfsim.physics import pose
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.builder import SceneBuilder, loaded
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import ClosedForm
from sdfsim.shape.shape import Shape
from sdfsim.simulate.looks import body_colors, extent, framed, is_infinite, with_normals

if TYPE_CHECKING:
    from sdfsim.simulate.simulator import Simulator

Numbers = Sequence[float] | np.ndarray
SKY = (236, 240, 245)  # RGB
LARGEST = 16_384  # px, sides of a picture
_MARGIN = 0.95  # part of the picture that is filled if the camera is chosen automatically
_SUN = np.array([0.35, -0.5, 0.8])  # to the sun, in a frame with x to the right of the camera and z up
_SHADE = 0.42  # light in the shadow
_NEAR = 1e-6  # part of the distance to the target before which nothing is seen
_SOFT = 0.03  # rad, radius of the sun: edges of shadows are as soft as this
_FAR_EDGE = 0.012  # part of the picture's height around edges of shadows that gets several samples
_SUB = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])  # px, samples of such places


class Image(NamedTuple):
    """What a camera sees."""

    color: np.ndarray  # [H, W, 3] uint8 sRGB; [H, W, 4] with an alpha channel if the background is transparent
    depth: np.ndarray  # [H, W] float32 m along the camera's axis (not along the ray); inf where nothing is
    segmentation: np.ndarray  # [H, W] int32 index of the body in the scene; -1 where none is


@dataclass(frozen=True)
class Style:
    """How pictures are drawn.

    Attributes:
        light: [3] direction to the sun, world; None: over the camera's right shoulder.
        background: RGB from 0 to 255; None: transparent.
        opacity: of bodies by their names, from 0 (left out) to 1. What is not opaque has no depth, no segmentation and
            no shadow.
        smooth: several samples at edges, and soft shadows.
    """

    light: Numbers | None = None
    background: Sequence[int] | None = SKY
    opacity: Mapping[str, float] = field(default_factory=dict)
    smooth: bool = False


class Ghosts(NamedTuple):
    """Bodies of a scene that are drawn once more, in one colour and elsewhere."""

    rows: np.ndarray  # [D] int64 bodies
    position: np.ndarray  # [D, 3] m
    orientation: np.ndarray  # [D, 4]
    color: tuple[int, int, int]
    opacity: float


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

        camera = sdfsim.Camera((2, -2, 1.5), look_at=(0, 0, 0.3), width=128, height=128)
        color, depth, segmentation = camera.image(simulator)

    Raises SdfsimError for values that no camera has.

    Attributes:
        position: [3] m.
        look_at: [3] m, a point straight ahead.
        up: [3] the direction that is upwards in the picture.
        fov: degrees, from the upper to the lower edge; unless `focal` is given.
        width, height: px.
        focal: px, along rows and columns (fx, fy).
        principal: px (cx, cy), the picture's place straight ahead; None: its middle. The centre of the first pixel is
            (0.5, 0.5), as in COLMAP; OpenCV calls it (0, 0).
    """

    position: Numbers
    look_at: Numbers = (0.0, 0.0, 0.0)
    up: Numbers = (0.0, 0.0, 1.0)
    fov: float = 40.0
    width: int = 960
    height: int = 540
    focal: tuple[float, float] | None = None
    principal: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("position", "look_at", "up"):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise SdfsimError(f"camera: {name} must be three finite numbers (got {getattr(self, name)})")
            object.__setattr__(self, name, value)
        if not np.linalg.norm(np.subtract(self.look_at, self.position)) > 1e-9:
            raise SdfsimError("camera: position and look_at must be two different points")
        if not (np.linalg.norm(self.up) > 0 and 0.0 < self.fov < 180.0):
            raise SdfsimError(f"camera: up must not be zero, and fov between 0 and 180 degrees (got {self.fov:g})")
        if not (min(self.width, self.height) >= 1 and min(self.focal or (1.0,)) > 0):
            raise SdfsimError("camera: width, height and focal must be above zero")
        if max(self.width, self.height) > LARGEST:
            raise SdfsimError(f"camera: {self.width} x {self.height} px (at most {LARGEST:,} a side)")

    @classmethod
    def posed(
        cls, rotation: np.ndarray, translation: Numbers, focal: tuple[float, float], width: int, height: int,
        principal: tuple[float, float] | None = None,
    ) -> Camera:  # fmt: skip
        """The camera of a photo without distortion, with the world-to-camera rotation [3, 3] and translation [3] m of
        COLMAP and OpenCV (x right, y down, z ahead), for example `image.cam_from_world()` of pycolmap."""
        rotation = np.asarray(rotation, dtype=np.float64)
        position = -rotation.T @ np.asarray(translation, dtype=np.float64)
        return cls(position, position + rotation[2], -rotation[1], 40.0, width, height, focal, principal)

    @classmethod
    def fit(
        cls, motion: Simulator | Rollout | None, scene: Scene | SceneBuilder | None = None, *,
        position: Numbers | None = None, look_at: Numbers | None = None, fov: float = 40.0, width: int = 960,
        height: int = 540,
    ) -> Camera:  # fmt: skip
        """A camera that has in sight what matters of a simulator, or of a run of a scene: the bodies at the start and
        where they go, but not one that rolls away. Its position and target, [3] m each, may be given."""
        if motion is not None and not isinstance(motion, Rollout):
            motion, scene = motion.initial_rollout(), motion.scene
        known = loaded(_needed(scene))
        centre, radius = framed(known, motion)
        camera = eye_around(centre if look_at is None else np.array(look_at), radius, -known.gravity)
        camera = replace(camera, fov=fov, width=width, height=height)
        if position is None:  # the least distance from which all is in sight
            corners = lattice(*extent(known, motion).T)
            right, down, ahead = camera.rotation @ (corners - camera.look_at).T
            aside = np.maximum(np.abs(right) * height / width, np.abs(down))
            away = float((aside / (_MARGIN * np.tan(np.radians(fov / 2))) - ahead).max())
            position = camera.look_at - away * camera.rotation[2]
        return replace(camera, position=position)

    @cached_property
    def rotation(self) -> np.ndarray:
        """[3, 3] from the world to the camera: its rows are unit vectors to the right, down, and ahead."""
        ahead = np.subtract(self.look_at, self.position)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, self.up)
        if np.linalg.norm(right) < 1e-6 * np.linalg.norm(self.up):  # straight up or down
            right = _aside(ahead)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(ahead, right), ahead])

    @cached_property
    def lens(self) -> np.ndarray:
        """[2, 2]: focal lengths, and the principal point, px."""
        usual = self.height / 2 / np.tan(np.radians(self.fov / 2))
        return np.array([self.focal or (usual, usual), self.principal or (self.width / 2, self.height / 2)])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points [..., 3] m of the world are in the picture, [..., 2] px (column, row), and their depth [...] m.
        Points that are not ahead of the camera have a depth of at most 0, and no place (nan)."""
        seen = (points - self.position) @ self.rotation.T
        ahead = seen[..., 2:]
        return seen[..., :2] / np.where(ahead > 0, ahead, np.nan) * self.lens[0] + self.lens[1], ahead[..., 0]

    def image(
        self, motion: Simulator | Rollout, scene: Scene | SceneBuilder | None = None, *, frame: int = -1,
        style: Style = Style(),
    ) -> Image:  # fmt: skip
        """What it sees of a simulator now, or of a frame of a run of a scene. Raises SdfsimError if the scene of a run
        is missing or another one, or if `style` names a body that the scene does not have."""
        if not isinstance(motion, Rollout):
            now = motion.si_state()
            return self.picture(motion.scene, now.position, now.orientation, style)
        known = loaded(_needed(scene))
        if len(known.bodies) != motion.position.shape[1]:
            raise SdfsimError(
                f"camera: the run has {motion.position.shape[1]} bodies, the scene {len(known.bodies)}",
                "give the scene of the run",
            )
        return self.picture(known, motion.position[frame], motion.orientation[frame], style)

    def picture(
        self, scene: Scene, position: np.ndarray, orientation: np.ndarray, style: Style, ghosts: Ghosts | None = None
    ) -> Image:
        """What it sees of the bodies of a scene with these centres of mass [N, 3] m and orientations [N, 4]."""
        drawn = _Drawing(self, scene, position, orientation, style, ghosts)
        wide, tall = self.width, self.height
        pixels, label, depth, body = drawn.look(self._grid, drawn.sun)
        pixels, label = pixels.reshape(tall, wide, 4), label.reshape(tall, wide)
        if style.smooth:
            edge, shadow = _edges(label), _edges(np.where(label >= 0, label % 2, -1)) & ~_edges(label // 2)
            from scipy.ndimage import maximum_filter  # slow to load

            often = np.flatnonzero(edge | maximum_filter(shadow, 2 * max(1, round(_FAR_EDGE * tall)) + 1))
            if len(often):
                again, *_ = drawn.look((self._grid[often][:, None] + _SUB).reshape(-1, 2), drawn.suns(often, wide))
                pixels.reshape(-1, 4)[often] = again.reshape(-1, len(_SUB), 4).mean(1)
        return Image(_finished(pixels, style.background), depth.reshape(tall, wide), body.reshape(tall, wide))

    @cached_property
    def _grid(self) -> np.ndarray:
        """[H * W, 2] px, the centres of all pixels."""
        return np.stack(np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5), -1).reshape(-1, 2)


def eye_around(centre: np.ndarray, radius: float, up: np.ndarray) -> Camera:
    """A camera that has a ball in sight."""
    length = np.linalg.norm(up)
    up = up / length if length > 0 else np.array([0.0, 0.0, 1.0])
    side = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    away = 1.6 * np.cross(up, side) + 1.1 * side + 0.9 * up
    return Camera(centre + radius * away, centre, up)


def _aside(direction: np.ndarray) -> np.ndarray:
    """A unit vector [3] at a right angle to another."""
    made = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    return made / np.linalg.norm(made)


def _needed(scene: Scene | SceneBuilder | None) -> Scene | SceneBuilder:
    if scene is None:
        raise SdfsimError("camera: a run needs its scene", "give it too: camera.image(rollout, scene)")
    return scene


def _edges(label: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels whose label differs from that of a neighbour."""
    edge = np.zeros(label.shape, bool)
    for axis in (0, 1):
        differs = np.diff(label, axis=axis) != 0
        edge[: differs.shape[0], : differs.shape[1]] |= differs
        edge[axis == 0 :, axis == 1 :] |= differs
    return edge


def _finished(pixels: np.ndarray, background: Sequence[int] | None) -> np.ndarray:
    """Colours uint8 from [..., 4]: RGB that are multiplied by alpha (0 to 1), and alpha."""
    color, alpha = pixels[..., :3], pixels[..., 3:]
    if background is None:
        color = np.concatenate([color / np.maximum(alpha, 1e-6), 255.0 * alpha], -1)
    else:
        color = color + (1.0 - alpha) * np.asarray(background, np.float32)
    return np.clip(color + 0.5, 0, 255).astype(np.uint8)


def _looks(scene: Scene) -> tuple[float, np.ndarray]:
    """Radius m of a ball around a scene, and the colours [N, 3] of its bodies."""
    return framed(scene)[1], np.array(body_colors(scene), np.float32)


class _Model:
    """The triangles of a shape about its centre of mass, at scale 1."""

    def __init__(self, shape: Shape) -> None:
        mesh, normals = with_normals(shape.shown)
        vertices = mesh.vertices - shape.com
        self.caster = Caster(Mesh(vertices, mesh.faces))
        self.faces, self.normals = mesh.faces.astype(np.int32), normals.astype(np.float32)
        self.uv, self.texture = (None, None) if mesh.uv is None else (mesh.uv.astype(np.float32), mesh.texture)
        self.colors = None if mesh.colors is None else mesh.colors.astype(np.float32)
        low, high = vertices.min(0), vertices.max(0)
        self.box = lattice(*np.stack([low, high]).T)  # its corners

    def surface(self, face: np.ndarray, uv: np.ndarray, color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals [R, 3] and colours [R, 3] at points of faces; `color` [3] if it has none of its own."""
        share = np.stack([1.0 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], 1)
        corners = self.faces[face]

        def mixed(of: np.ndarray) -> np.ndarray:
            return np.einsum("rk,rkc->rc", share, of[corners])

        normal = mixed(self.normals)
        normal /= np.maximum(np.sqrt(np.einsum("rc,rc->r", normal, normal)), 1e-9)[:, None]
        if self.texture is not None and self.uv is not None:
            size = np.array(self.texture.shape[1::-1])
            column, row = np.clip(mixed(self.uv) * size, 0, size - 1).astype(int).T
            return normal, self.texture[row, column].astype(np.float32)
        return normal, np.tile(color, (len(face), 1)) if self.colors is None else mixed(self.colors)


class _Hits(NamedTuple):
    """What R rays meet first."""

    depth: np.ndarray  # [R] float32 m along the camera's axis; inf: nothing
    row: np.ndarray  # [R] int32 row of the drawing; -1: nothing
    face: np.ndarray  # [R] int64
    uv: np.ndarray  # [R, 2] float32, where in the face


class _Drawing:
    """A scene at an instant, seen by a camera. Its rows are the scene's bodies, then ghosts."""

    def __init__(
        self, camera: Camera, scene: Scene, position: np.ndarray, orientation: np.ndarray, style: Style,
        ghosts: Ghosts | None,
    ) -> None:  # fmt: skip
        self.camera, self.count = camera, len(scene.bodies)
        rows = np.arange(self.count)
        opacity = np.ones(self.count)
        names = {body.name: k for k, body in enumerate(scene.bodies)}
        for name, value in style.opacity.items():
            if name not in names:
                raise SdfsimError(f"opacity: no body is called {name!r}{nearest(name, names)}")
            if not 0.0 <= value <= 1.0:
                raise SdfsimError(f"opacity of {name!r}: must be from 0 to 1 (got {value:g})")
            opacity[names[name]] = value
        self.radius, colors = made_once(scene, _looks)
        if ghosts is not None:
            rows, opacity = np.append(rows, ghosts.rows), np.append(opacity, [ghosts.opacity] * len(ghosts.rows))
            position = np.concatenate([position, ghosts.position])
            orientation = np.concatenate([orientation, ghosts.orientation])
            colors = np.concatenate([colors, np.tile(np.array(ghosts.color, np.float32), (len(ghosts.rows), 1))])
        bodies = [scene.bodies[k] for k in rows]
        shapes = [scene.shapes[body.shape] for body in bodies]
        flat = np.array([is_infinite(shape) for shape in shapes], bool)
        self.opacity, self.colors = opacity, colors
        self.turn = pose.to_matrix(np.asarray(orientation, np.float64)).reshape(-1, 3, 3)
        self.away = np.asarray(position, np.float64) - camera.position  # [N, 3] m from the camera
        self.scale = np.array([body.scale for body in bodies])
        axes = camera.rotation
        self.up = -scene.gravity / max(np.linalg.norm(scene.gravity), 1e-9) if scene.gravity.any() else -axes[1]
        right = np.cross(axes[2], self.up)
        right = axes[0] if np.linalg.norm(right) < 1e-6 else right / np.linalg.norm(right)
        sun = _SUN @ np.stack([right, np.cross(self.up, right), self.up])
        sun = sun if style.light is None else np.array(style.light, dtype=np.float64)
        if sun.shape != (3,) or not 0.0 < np.linalg.norm(sun) < np.inf:
            raise SdfsimError(f"light: must be a direction, three numbers (got {style.light})")
        self.sun = (sun / np.linalg.norm(sun)).astype(np.float32)
        across = _aside(self.sun)
        self.across = np.stack([across, np.cross(self.sun, across)], 1).astype(np.float32)  # [3, 2] axes aside
        self.models: list[_Model | None] = [
            None if plane or not len(shape.shown.faces) else made_once(shape, _Model)
            for shape, plane in zip(shapes, flat, strict=True)
        ]
        meshed = [k for k, model in enumerate(self.models) if model is not None and opacity[k] > 0.0]
        planes = [k for k in range(len(bodies)) if flat[k] and opacity[k] > 0.0]
        self.layers = [  # opaque, and not
            ([k for k in meshed if (opacity[k] < 1.0) == glass], [k for k in planes if (opacity[k] < 1.0) == glass])
            for glass in (False, True)
        ]
        # Photographed floors may lie in a plane, or a little below it.
        self.scenery = np.array([b.motion == "static" and not isinstance(s.sdf, ClosedForm)
                                 for b, s in zip(bodies, shapes, strict=True)])  # fmt: skip
        self.to_body = np.swapaxes(self.turn, 1, 2) / self.scale[:, None, None]
        self.boxes = {k: self._box(model, k) for k, model in enumerate(self.models) if model is not None}

    def suns(self, pixel: np.ndarray, wide: int) -> np.ndarray:
        """[P * S, 3] directions to points of the sun's disc, for the samples of pixels [P] (numbers)."""
        # Each pixel turns the pattern (interleaved gradient noise), so that no bands are visible.
        turn = 52.9829189 * ((0.06711056 * (pixel % wide) + 0.00583715 * (pixel // wide)) % 1.0)
        k = np.arange(len(_SUB))
        angle = 2.0 * np.pi * (turn[:, None] + 0.61803399 * k)
        spread = _SOFT * np.sqrt((k + 0.5) / len(_SUB))
        x, y = (spread * np.cos(angle)).reshape(-1, 1), (spread * np.sin(angle)).reshape(-1, 1)
        return (self.sun + x * self.across[:, 0] + y * self.across[:, 1]).astype(np.float32)

    def _box(self, model: _Model, k: int) -> np.ndarray | None:
        """[2, 2] px: the lowest and highest row and column that a body can reach; None if it is behind the camera."""
        camera = self.camera
        seen = (self.scale[k] * model.box @ self.turn[k].T + self.away[k]) @ camera.rotation.T
        if (seen[:, 2] <= 0.0).all():
            return None
        if (seen[:, 2] <= _NEAR * self.radius).any():
            return np.array([[0, 0], [camera.height, camera.width]])
        at = (seen[:, :2] / seen[:, 2:] * camera.lens[0] + camera.lens[1])[:, ::-1]
        return np.clip([at.min(0) - 1.0, at.max(0) + 1.0], -1, [camera.height + 1, camera.width + 1])

    def look(self, at: np.ndarray, sun: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """For places [R, 2] px in the order of their pixels: colours [R, 4] times alpha, and alpha; numbers [R] that
        differ between bodies, and between light and shade; depths [R] and bodies [R]."""
        camera = self.camera
        lens = np.ones((len(at), 3), np.float32)
        lens[:, :2] = (at - camera.lens[1]) / camera.lens[0]
        ray = lens @ camera.rotation.astype(np.float32)  # as long as one metre of depth
        pixel = np.floor(at[:, ::-1]).astype(np.int32)
        hits = self._nearest(ray, pixel, *self.layers[0])
        pixels, dark = self._shaded(ray, hits, sun)
        label = np.where(hits.row < 0, -1, 2 * hits.row + dark)
        if any(self.layers[1]):  # lit, but without shadows
            glass = self._nearest(ray, pixel, *self.layers[1])
            hidden = glass.depth >= hits.depth - np.float32(1e-4 * self.radius)
            glass.row[hidden] = -1
            front, _ = self._shaded(ray, glass, None)
            share = np.where(glass.row < 0, 0.0, self.opacity[glass.row])[:, None].astype(np.float32)
            pixels = (1.0 - share) * pixels + share * front
            label = label + 2 * len(self.models) * (1 + glass.row)
        return pixels, label, hits.depth, hits.row

    def _nearest(self, ray: np.ndarray, pixel: np.ndarray, meshed: list[int], planes: list[int]) -> _Hits:
        count = len(ray)
        hits = _Hits(
            np.full(count, np.inf, np.float32), np.full(count, -1, np.int32), np.zeros(count, np.int64),
            np.zeros((count, 2), np.float32),
        )  # fmt: skip
        for k in meshed:
            model, box = self.models[k], self.boxes[k]
            if model is None or box is None or not len(some := _inside(pixel, box)):
                continue
            into = self.to_body[k]
            local = np.empty((len(some), 6), np.float32)
            local[:, :3], local[:, 3:] = -(into @ self.away[k]), ray[some] @ into.T.astype(np.float32)
            depth, face, uv = model.caster.cast(local)
            near = np.flatnonzero(depth < hits.depth[some])
            some = some[near]
            hits.depth[some], hits.row[some], hits.face[some], hits.uv[some] = depth[near], k, face[near], uv[near]
        for k in planes:
            normal = self.turn[k][:, 2]
            sinks = ray @ normal.astype(np.float32)
            with np.errstate(divide="ignore"):
                depth = np.float32(self.away[k] @ normal) / sinks
            # What lies in a plane, or a little below it, covers it.
            low = self.scenery[hits.row] & (hits.row >= 0) & ((hits.depth - depth) * np.abs(sinks) < 0.02 * self.radius)
            near = np.flatnonzero((depth > 0.0) & (depth < hits.depth) & ~low & np.isfinite(depth))
            hits.depth[near], hits.row[near] = depth[near], k
        return hits

    def _shaded(self, ray: np.ndarray, hits: _Hits, sun: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Colours [R, 4] times alpha, and alpha; and whether [R] a place is in the shade. Without a sun the light is
        the same, but nothing throws shadows."""
        pixels, dark = np.zeros((len(ray), 4), np.float32), np.zeros(len(ray), bool)
        there = np.flatnonzero(hits.row >= 0)
        there = there[np.argsort(hits.row[there], kind="stable")]
        starts = np.searchsorted(hits.row[there], np.arange(len(self.models) + 1))
        color, toward, lift = np.empty((len(there), 3), np.float32), *np.empty((2, len(there)), np.float32)
        point, up = ray[there] * hits.depth[there, None], self.up.astype(np.float32)  # from the camera
        beam = self.sun[None] if sun is None or sun.ndim == 1 else sun[there]  # [1 or R, 3]
        for k in np.flatnonzero(np.diff(starts)).tolist():
            rows, model, turn = slice(starts[k], starts[k + 1]), self.models[k], self.turn[k].astype(np.float32)
            some, sunny = there[rows], beam if len(beam) == 1 else beam[rows]
            if model is None:
                above = turn[:, 2] @ self.away[k] < 0.0  # the side of the plane that is seen
                normal, color[rows] = turn[None, :, 2] * (1 if above else -1), self._pattern(k, point[rows])
            else:
                normal, shown = model.surface(hits.face[some], hits.uv[some], self.colors[k])
                normal = normal @ turn.T
                normal = np.where(np.einsum("rc,rc->r", normal, ray[some])[:, None] > 0.0, -normal, normal)
                point[rows] += 1e-3 * np.minimum(hits.depth[some], np.float32(self.radius))[:, None] * normal
                color[rows] = self.colors[k] if k >= self.count else shown
            toward[rows] = normal @ sunny[0] if len(sunny) == 1 else (normal * sunny).sum(1)
            lift[rows] = normal @ up
        shade = toward <= 0.0
        if sun is not None:
            lit = np.flatnonzero(~shade)
            shade[lit] = self._blocked(point[lit], beam if len(beam) == 1 else beam[lit])
        light = _SHADE + 0.12 * lift + np.where(shade, 0.0, (1.0 - _SHADE) * np.maximum(toward, 0.0))
        # Far away the floor fades into the background.
        clear = 2.0 * (self.radius + float(np.linalg.norm(np.subtract(self.camera.look_at, self.camera.position))))
        fog = np.clip((np.sqrt(np.einsum("rc,rc->r", point, point)) / clear - 1.0) / 2.0, 0.0, 1.0)
        pixels[there, :3] = ((1.0 - fog) * np.clip(light, 0.0, 1.1))[:, None] * color
        pixels[there, 3], dark[there] = 1.0 - fog, shade
        return pixels, dark

    def _pattern(self, k: int, point: np.ndarray) -> np.ndarray:
        """Colours [R, 3] of a plane at points [R, 3] m from the camera: a checkerboard, so that motion over it is
        visible."""
        place = (point - self.away[k].astype(np.float32)) @ self.turn[k][:, :2].astype(np.float32)
        cell = 10.0 ** np.floor(np.log10(self.radius))
        square = np.floor(place * np.float32(1.0 / cell) + np.float32(1e-4))
        odd = (square[:, 0] + square[:, 1]).astype(np.int32) & 1
        # Where a pixel is about as large as a square, the two colours mix.
        height = max(abs(float(self.turn[k][:, 2] @ self.away[k])), 1e-9)
        blur = np.einsum("rc,rc->r", point, point) * np.float32(2.0 / (height * self.camera.lens[0, 1] * cell))
        return self.colors[k] * (1.0 - 0.09 * (0.5 + (odd - np.float32(0.5)) * np.clip(2.0 - blur, 0.0, 1.0)))[:, None]

    def _blocked(self, point: np.ndarray, sun: np.ndarray) -> np.ndarray:
        """[R] whether an opaque body is between points [R, 3] m from the camera and the sun [1 or R, 3]."""
        flat = point @ self.across
        order = np.argsort(flat[:, 0])
        flat, dark = flat[order], np.zeros(len(point), bool)
        spread = 0.0 if len(sun) == 1 else 4.0 * _SOFT * self.radius
        for k in self.layers[0][0]:
            model, into, away = self.models[k], self.to_body[k].T.astype(np.float32), self.away[k].astype(np.float32)
            assert model is not None
            corners = (self.scale[k] * model.box @ self.turn[k].T + self.away[k]) @ self.across
            some = order[_inside(flat, np.array([corners.min(0) - spread, corners.max(0) + spread]))]
            some = some[~dark[some]]
            if len(some):
                local = np.empty((len(some), 6), np.float32)
                local[:, :3], local[:, 3:] = (point[some] - away) @ into, (sun if len(sun) == 1 else sun[some]) @ into
                dark[some] = model.caster.anything(local)
        return dark


def _inside(places: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Indices of places [R, 2], whose first coordinates ascend, in a box [2, 2]."""
    start, stop = np.searchsorted(places[:, 0], [box[0, 0], box[1, 0] + 1e-9])
    second = places[start:stop, 1]
    return start + np.flatnonzero((second >= box[0, 1]) & (second <= box[1, 1]))
