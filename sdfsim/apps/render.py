"""A run as a movie or a picture, without a screen or a graphics driver: rays are cast on the CPU."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.apps.beside import COLOR, OPACITY, between, rows_in
from sdfsim.apps.recording import Eye, body_colors, extent, eye_around, framed, is_infinite, shown, with_normals
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import replacing
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.builder import loaded
from sdfsim.scene.scene import Scene

if TYPE_CHECKING:
    from sdfsim.scene.builder import SceneBuilder

Place = Sequence[float] | np.ndarray
_Model = tuple[Mesh, np.ndarray]  # the mesh of a body about its centre of mass, with normals [V, 3]
SIZE = (960, 540)  # px, width and height
FRAMES = 30  # per second
FORMATS = (".mp4", ".png")
_TALL = np.tan(np.radians(20.0))  # half of the field of view's height, at distance 1
_MARGIN = 0.95  # part of the picture that is filled if the camera is chosen automatically
_SUN = np.array([0.35, -0.5, 0.8]) / np.linalg.norm([0.35, -0.5, 0.8])  # direction to the sun, in a frame with z up
_SKY = np.array([236.0, 240.0, 245.0], np.float32)  # colour of the background
_SHADE = 0.45  # light in the shadow
_SUB = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])  # px, extra samples at edges
_GRID = np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), -1).reshape(-1, 2)  # px


def render(
    scene: Scene | SceneBuilder | Path | str, rollout: Rollout | Path | str, out: Path | str, *,
    camera: Place | None = None, look_at: Place | None = None, at: float | None = None, beside: Rollout | None = None,
    on_progress: Progress = silent,
) -> None:  # fmt: skip
    """Write a movie (.mp4, H.264, as long as the run) or a picture (.png, at the time `at` s, by default the end) of a
    run.

    The camera and the point that it looks at, [3] m each, are as in `eye_of`. A recorded motion `beside` the run is
    shown with translucent bodies. Raises SdfsimError for another ending, a time outside the run, a camera at the point
    that it looks at, or a file that cannot be written.
    """
    out, scene = Path(out), loaded(scene)
    check_format(out)
    if isinstance(rollout, str | Path):
        rollout = Rollout.load(rollout)
    if not isinstance(rollout, Rollout):
        raise SdfsimError(f"rollout: must be a Rollout or the path of a rollout.npz (got a {type(rollout).__name__})")
    if at is not None and not rollout.time[0] <= at <= rollout.time[-1] + rollout.meta["dt"]:
        raise SdfsimError(f"--at {at:g}: the run holds {rollout.time[0]:g} to {rollout.time[-1]:g} s")
    studio = Studio(scene, eye_of(scene, rollout, camera, look_at), framed(scene, rollout)[1], beside)
    if out.suffix == ".png":
        from PIL import Image

        pixels = studio.picture_at(rollout, rollout.time[-1] if at is None else at)
        with replacing(out) as partial:
            Image.fromarray(pixels).save(partial, format="PNG")
        return
    count = max(1, round(float(rollout.time[-1] - rollout.time[0]) * FRAMES) + 1)

    def pictures() -> Iterator[np.ndarray]:
        for k in range(count):
            yield studio.picture_at(rollout, rollout.time[0] + k / FRAMES)
            on_progress((k + 1) / count, f"frame {k + 1} of {count}")

    write_movie(out, pictures())


def eye_of(
    scene: Scene, motion: Rollout | None = None, camera: Place | None = None, look_at: Place | None = None
) -> Eye:
    """The camera of a scene. If its position or target, [3] m each, is not given, one is chosen that shows the whole
    scene. Raises SdfsimError if the two are the same point, or not finite."""
    centre, radius = framed(scene, motion)
    eye = eye_around(centre if look_at is None else np.array(look_at, dtype=float), radius, -scene.gravity)
    if camera is None:
        eye = _far_enough(eye, np.stack(np.meshgrid(*extent(scene, motion).T), -1).reshape(-1, 3))
    else:
        eye = replace(eye, position=np.array(camera, dtype=float))
    sight = eye.target - eye.position
    if not np.isfinite(sight).all() or np.linalg.norm(sight) < 1e-9:
        raise SdfsimError("--camera and --look-at: must be two different points")
    # Looking straight down, the direction up is undefined.
    if np.linalg.norm(np.cross(sight, eye.up)) < 1e-3 * np.linalg.norm(sight):
        aside = np.cross(eye.up, eye.up[[1, 2, 0]] + [0.1, 0.2, 0.3])
        eye = replace(eye, position=eye.position + 1e-3 * np.linalg.norm(sight) * aside)
    return eye


def _far_enough(eye: Eye, points: np.ndarray) -> Eye:
    """The eye, moved along its line of sight to the least distance from which it sees all points [P, 3]."""
    axes = _axes(eye)
    right, down, ahead = axes @ (points - eye.target).T
    aside = np.maximum(np.abs(right) * SIZE[1] / SIZE[0], np.abs(down))
    distance = float((aside / (_MARGIN * _TALL) - ahead).max())
    return replace(eye, position=eye.target - distance * axes[2])


def _axes(eye: Eye) -> np.ndarray:
    """[3, 3]: unit vectors to the right, down, and into the picture."""
    forward = (eye.target - eye.position) / np.linalg.norm(eye.target - eye.position)
    right = np.cross(forward, eye.up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def check_format(out: Path) -> None:
    """Raises SdfsimError if the ending of a file is neither that of a movie nor of a picture."""
    if out.suffix not in FORMATS:
        raise SdfsimError(f"{out}: must end with {' or '.join(FORMATS)}")


def write_movie(out: Path, pictures: Iterator[np.ndarray]) -> None:
    """Write RGB pictures of `SIZE` [H, W, 3] uint8, `FRAMES` a second, as H.264."""
    import av

    with replacing(out) as partial, av.open(str(partial), "w", format="mp4") as movie:
        stream: Any = movie.add_stream("libx264", rate=Fraction(FRAMES), options={"crf": "20", "preset": "fast"})
        (stream.width, stream.height), stream.pix_fmt = SIZE, "yuv420p"
        for pixels in pictures:
            movie.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        movie.mux(stream.encode())


class _Cast:
    """The triangles of all bodies, each a mesh about its centre of mass with normals [V, 3], at places [N, 3] m with
    rotations `turns` [N, 3, 3]; `body` [F] is the body of each face."""

    def __init__(self, models: list[_Model], places: np.ndarray, turns: np.ndarray) -> None:
        self._meshes = [mesh for mesh, _ in models]
        self._starts = np.cumsum([0, *(len(m.vertices) for m in self._meshes)])
        vertices = np.concatenate([m.vertices @ r.T + t for m, r, t in zip(self._meshes, turns, places, strict=True)])
        normals = [normals @ r.T for (_, normals), r in zip(models, turns, strict=True)]
        self._normals = np.concatenate(normals, dtype=np.float32)
        self._colors = np.concatenate([np.asarray(m.colors, dtype=np.float32) for m in self._meshes])
        self._faces = np.concatenate([m.faces + start for m, start in zip(self._meshes, self._starts, strict=False)])
        self.body = np.repeat(np.arange(len(models)), [len(m.faces) for m in self._meshes])
        self.caster = Caster(Mesh(vertices, self._faces))

    def surface(self, face: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normals [R, 3] and colours [R, 3] at points on faces."""
        share = np.stack([1.0 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], -1)
        corners = self._faces[face]
        normal, color = (np.einsum("rk,rkc->rc", share, of[corners]) for of in (self._normals, self._colors))
        for body, mesh in enumerate(self._meshes):
            if mesh.uv is not None and mesh.texture is not None:
                on = np.flatnonzero(self.body[face] == body)
                size = np.array(mesh.texture.shape[1::-1])
                at = np.einsum("rk,rkc->rc", share[on], mesh.uv[corners[on] - self._starts[body]]) * size
                column, row = np.clip(at, 0, size - 1).astype(int).T
                color[on] = mesh.texture[row, column]
        length = np.sqrt(np.einsum("rc,rc->r", normal, normal))
        return normal / np.maximum(length, 1e-9)[:, None], color


class Studio:
    """A scene with a camera and a sun, for taking pictures. `radius` m is the radius of everything shown, `beside` a
    recorded motion that is shown too. `axes` [3, 3] are unit vectors to the right, down, and into the picture; `sun`
    [3] points to the sun."""

    def __init__(self, scene: Scene, eye: Eye, radius: float, beside: Rollout | None = None) -> None:
        self._eye, self._radius, self._beside = eye, radius, beside
        shapes = [scene.shapes[b.shape] for b in scene.bodies]
        self._floors = np.array([is_infinite(shape) for shape in shapes])
        self._models: list[_Model] = []
        for k, (body, shape, color) in enumerate(zip(scene.bodies, shapes, body_colors(scene), strict=True)):
            mesh, normals = with_normals(shown(scene, k, 40.0 * radius))
            colors = np.broadcast_to(color, mesh.vertices.shape) if mesh.colors is None else mesh.colors
            vertices = body.scale * (mesh.vertices - shape.com)
            self._models.append((replace(mesh, vertices=vertices, colors=colors), normals))
        self._ghosts: list[_Model] = []
        for k in () if beside is None else rows_in(scene, beside):
            mesh, normals = self._models[k]
            self._ghosts.append((Mesh(mesh.vertices, mesh.faces, np.broadcast_to(COLOR, mesh.vertices.shape)), normals))
        self.axes = _axes(eye)
        right = self.axes[0]
        self.sun = _SUN @ np.stack([right, np.cross(eye.up, right), eye.up])
        self._through = self._rays(_GRID)

    def picture_at(self, rollout: Rollout, time: float) -> np.ndarray:
        """[H, W, 3] uint8 for a moment of a run, with the recorded motion at that time."""

        def at(motion: Rollout) -> tuple[np.ndarray, np.ndarray]:
            place, turn = between(motion.time, motion.position, motion.orientation, np.array([time]))
            return place[0], turn[0]

        if self._beside is None:
            return self.picture(*at(rollout))
        place, turn = at(self._beside)
        return self.picture(*at(rollout), _Cast(self._ghosts, place, Rotation.from_quat(turn).as_matrix()))

    def picture(self, position: np.ndarray, orientation: np.ndarray, ghosts: _Cast | None = None) -> np.ndarray:
        """[H, W, 3] uint8 for bodies with these centres of mass [N, 3] m and orientations [N, 4], and `ghosts`."""
        cast = _Cast(self._models, position, Rotation.from_quat(orientation).as_matrix())
        wide, tall = SIZE
        pixels, label = self._look(cast, ghosts, self._through)
        pixels, label = pixels.reshape(tall, wide, 3), label.reshape(tall, wide)
        edge = np.zeros((tall, wide), bool)
        for axis in (0, 1):
            differs = np.diff(label, axis=axis) != 0
            edge[: tall - (axis == 0), : wide - (axis == 1)] |= differs
            edge[axis == 0 :, axis == 1 :] |= differs
        if edge.any():
            again, _ = self._look(cast, ghosts, self._rays((_GRID[edge.reshape(-1)][:, None] + _SUB).reshape(-1, 2)))
            pixels[edge] = again.reshape(-1, len(_SUB), 3).mean(1)
        return np.clip(pixels + 0.5, 0, 255).astype(np.uint8)

    def _rays(self, at: np.ndarray) -> np.ndarray:
        """[R, 6] float32 origins and unit directions through points [R, 2] px of the picture."""
        flat = (at - np.array(SIZE) / 2) / (SIZE[1] / 2) * _TALL
        direction = np.concatenate([flat, np.ones((len(at), 1))], 1) @ self.axes
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return np.concatenate([np.broadcast_to(self._eye.position, direction.shape), direction], 1, dtype=np.float32)

    def _look(self, cast: _Cast, ghosts: _Cast | None, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colours [R, 3] along rays [R, 6], and numbers [R] that differ between bodies, and between light and shade."""
        far, face, uv = cast.caster.cast(rays)
        away, there = far, np.flatnonzero(np.isfinite(far))
        away, face, direction = away[there, None], face[there], rays[there, 3:]
        body = cast.body[face]
        normal, color = cast.surface(face, uv[there])
        facing = np.where(np.einsum("rc,rc->r", normal, direction)[:, None] > 0.0, -normal, normal)
        point, toward = rays[there, :3] + away * direction, facing @ self.sun.astype(np.float32)
        # Infinite planes get a checkerboard, so that motion over them is visible.
        floor = np.flatnonzero(self._floors[body])
        square = np.floor(point[floor] / 10.0 ** np.floor(np.log10(self._radius)) + 1e-4).sum(1)
        color[floor[square % 2 != 0]] *= 0.93
        start = point + 1e-3 * self._radius * facing
        to_sun = np.concatenate([start, np.broadcast_to(self.sun, start.shape)], 1, dtype=np.float32)
        dark = (toward <= 0.0) | cast.caster.anything(to_sun)
        light = _SHADE + 0.1 * (facing @ self._eye.up.astype(np.float32)) + np.where(dark, 0.0, (1.0 - _SHADE) * toward)
        # Far away the floor fades into the background.
        clear = 2.0 * (self._radius + float(np.linalg.norm(self._eye.target - self._eye.position)))
        fog = np.clip((away / clear - 1.0) / 2.0, 0.0, 1.0)
        pixels, label = np.tile(_SKY, (len(rays), 1)), np.full(len(rays), -1)
        pixels[there] = (1.0 - fog) * np.clip(light, 0.0, 1.1)[:, None] * color + fog * _SKY
        label[there] = 2 * body + dark
        if ghosts is not None:  # they are lit, but cast no shadow
            away, face, uv = ghosts.caster.cast(rays)
            front = np.flatnonzero(away < far - 1e-4 * self._radius)
            normal, color = ghosts.surface(face[front], uv[front])
            light = _SHADE + (1.0 - _SHADE) * np.clip(normal @ self.sun.astype(np.float32), 0.0, 1.0)
            pixels[front] = (1.0 - OPACITY) * pixels[front] + OPACITY * light[:, None] * color
            label[front] = label[front] + 2 * len(self._models) * (1 + ghosts.body[face[front]])
        return pixels, label
