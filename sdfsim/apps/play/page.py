"""The page of a session or of a film in the browser, by viser."""

from __future__ import annotations

import io
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any, Protocol

import numpy as np

from sdfsim.apps.recording import body_colors, eye_around, framed, is_infinite, with_normals
from sdfsim.apps.viewer import LOOPBACK, free_port
from sdfsim.geometry.mesh import Mesh
from sdfsim.physics import pose
from sdfsim.scene.scene import Scene

PORT = 8080
RATE = 60.0  # poses a second, at most
FLOOR, LINES = (205, 209, 215), (170, 176, 184)  # colours of infinite planes
SKY = (236, 240, 245)
FOV = np.radians(45.0)


class Shown(Protocol):
    """What a page shows: a session, or a film."""

    frame: Any  # a `Frame`
    changed: threading.Condition


class Batch:
    """Bodies of one shape, which are drawn as copies of its mesh."""

    def __init__(self, handle: Any, rows: list[int], names: list[str]) -> None:
        self.handle, self.rows, self.names = handle, rows, names
        self._sent: tuple[np.ndarray, np.ndarray] | None = None

    def place(self, position: np.ndarray, orientation: np.ndarray) -> None:
        """Move the copies to the poses of their bodies among [N, 3] and [N, 4], if these have changed."""
        now = position[self.rows], orientation[self.rows]
        if self._sent is None or not all(np.array_equal(a, b) for a, b in zip(now, self._sent, strict=True)):
            self.handle.batched_positions = now[0].astype(np.float32)
            self.handle.batched_wxyzs = np.roll(now[1], 1, axis=1).astype(np.float32)
            self._sent = now


class Page:
    """A page that draws bodies and follows their motion. `address` is where it is."""

    def __init__(self, shown: Shown, port: int | None = None) -> None:
        import viser

        port = free_port(PORT) if port is None else port
        with redirect_stdout(io.StringIO()):  # it prints its own lines
            self.server: Any = viser.ViserServer(host=LOOPBACK, port=port, label="sdfsim", verbose=False)
        self.address = f"http://localhost:{self.server.get_port()}"
        self.shown, self._closed, self.scene = shown, False, None
        self.batches: dict[tuple[int, bool], Batch] = {}
        self.sent: deque[float] = deque(maxlen=1000)  # when poses were sent, s
        self._each: list[tuple[float, Callable[[], None]]] = []  # period s, and what is done so often
        server, scene = self.server, shown.frame.scene
        server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        server.scene.set_up_direction(tuple(self.up(scene)))
        server.scene.configure_environment_map("studio", environment_intensity=0.12)
        server.scene.configure_default_lights(cast_shadow=True)
        centre, radius = framed(scene)
        eye = eye_around(centre, radius, -scene.gravity)
        away = eye.position - centre
        camera = server.initial_camera
        camera.fov, camera.look_at, camera.up = FOV, tuple(centre), tuple(eye.up)
        camera.position = tuple(centre + away * (1.25 / np.tan(FOV / 2) * radius / np.linalg.norm(away)))
        camera.near, camera.far = 0.01 * radius, 200.0 * radius
        self.draw(scene)

    @staticmethod
    def up(scene: Scene) -> np.ndarray:
        strength = float(np.linalg.norm(scene.gravity))
        return -scene.gravity / strength if strength else np.array([0.0, 0.0, 1.0])

    def begin(self) -> None:
        """Start to send poses."""
        self._thread = threading.Thread(target=self._send, daemon=True, name="play page")
        self._thread.start()

    def close(self) -> None:
        """End the page."""
        self._closed = True
        with self.shown.changed:
            self.shown.changed.notify_all()
        self._thread.join(timeout=5.0)
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def every(self, seconds: float, work: Callable[[], None]) -> None:
        """Do something again and again between poses."""
        self._each.append((seconds, work))

    # --- drawing ---

    def draw(self, scene: Scene) -> None:
        """Draw the bodies of a scene; batches with the same bodies as before stay."""
        self.scene = scene
        found: dict[tuple[int, bool], list[int]] = {}
        for row, body in enumerate(scene.bodies):
            if not is_infinite(scene.shapes[body.shape]):
                found.setdefault((id(scene.shapes[body.shape]), body.motion == "dynamic"), []).append(row)
        for key, batch in list(self.batches.items()):
            if [scene.bodies[row].name for row in found.get(key, [])] != batch.names:
                self.batches.pop(key).handle.remove()
        for key, rows in found.items():
            if key in self.batches:
                self.batches[key].rows = rows
            else:
                self.batches[key] = self._batch(scene, rows, f"/bodies/{len(self.sent)}_{key[0]}_{key[1]:d}")
        for row, body in enumerate(scene.bodies):
            if is_infinite(scene.shapes[body.shape]):
                self._plane(scene, row)

    def _batch(self, scene: Scene, rows: list[int], name: str) -> Batch:
        frame, shape = self.shown.frame, scene.shapes[scene.bodies[rows[0]].shape]
        mesh = drawable(shape.shown)
        given: dict[str, Any] = {
            "batched_wxyzs": np.roll(frame.orientation[rows], 1, axis=1),
            "batched_positions": frame.position[rows],
            "batched_scales": np.array([scene.bodies[row].scale for row in rows], np.float32),
            "lod": "off",
        }
        vertices = mesh.vertices - shape.com
        if mesh.colors is None and mesh.texture is None:
            colors = body_colors(scene)
            given["batched_colors"] = np.array([colors[row] for row in rows], np.uint8)
            handle = self.server.scene.add_batched_meshes_simple(name, vertices, mesh.faces, **given)
        else:
            handle = self.server.scene.add_batched_meshes_trimesh(name, dressed(vertices, mesh), **given)
        batch = Batch(handle, rows, [scene.bodies[row].name for row in rows])
        if scene.bodies[rows[0]].motion == "dynamic":
            self.draggable(batch)
        return batch

    def draggable(self, batch: Batch) -> None:
        """Called for each batch of bodies that move."""

    def _plane(self, scene: Scene, row: int) -> None:
        body, radius = scene.bodies[row], framed(scene)[1]
        cell = 10.0 ** np.floor(np.log10(radius))
        # A photographed floor may lie in the plane.
        sunk = body.position - 0.004 * radius * pose.rotate(body.quat_xyzw, np.array([0.0, 0.0, 1.0]))
        self.server.scene.add_grid(
            f"/planes/{row}", infinite_grid=True, plane="xy", cell_size=cell / 2, section_size=cell, cell_color=LINES,
            section_color=LINES, cell_thickness=0.0, section_thickness=1.0, plane_color=FLOOR, plane_opacity=1.0,
            shadow_opacity=0.45, fade_distance=14.0 * radius, fade_strength=1.5, position=tuple(sunk),
            wxyz=tuple(np.roll(body.quat_xyzw, 1)),
        )  # fmt: skip

    # --- following ---

    def _send(self) -> None:
        number, due = -1, [0.0] * len(self._each)
        while not self._closed:
            with self.shown.changed:
                if self.shown.frame.number == number and not self._closed:
                    self.shown.changed.wait(timeout=0.1)
            frame, began = self.shown.frame, time.perf_counter()
            if frame.number != number:
                number = frame.number
                with self.server.atomic():
                    if frame.scene is not self.scene:
                        self.draw(frame.scene)
                    for batch in self.batches.values():
                        batch.place(frame.position, frame.orientation)
                    self.followed(frame)
                self.server.flush()
                self.after(frame)
                self.sent.append(time.perf_counter())
            for k, (period, work) in enumerate(self._each):
                if began >= due[k]:
                    due[k] = began + period
                    work()
            time.sleep(max(0.0, began + 1.0 / RATE - time.perf_counter()))

    def followed(self, frame: Any) -> None:
        """Called with each frame that is sent, before it is."""

    def after(self, frame: Any) -> None:
        """Called with each frame after it was sent."""


def drawable(mesh: Mesh) -> Mesh:
    """The mesh with its vertices split along creases only: the page computes smooth normals of what is left."""
    split, normals = with_normals(mesh)
    if split.uv is not None:
        return split
    rows = np.round(np.column_stack([split.vertices, normals]), 5)
    _, first, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    colors = None if split.colors is None else split.colors[first]
    return Mesh(split.vertices[first], place.reshape(-1)[split.faces], colors)


def dressed(vertices: np.ndarray, mesh: Mesh) -> Any:
    """A mesh of trimesh with the texture or the colours of `mesh`; photos contain their light, so it does not shine."""
    import trimesh
    from PIL import Image
    from trimesh.visual import ColorVisuals, TextureVisuals
    from trimesh.visual.material import PBRMaterial

    normals = with_normals(Mesh(vertices, mesh.faces))[1] if mesh.uv is None else None
    if normals is not None and len(normals) != len(vertices):
        normals = None
    made = trimesh.Trimesh(vertices, mesh.faces, vertex_normals=normals, process=False)
    matt: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    if mesh.texture is not None and mesh.uv is not None:
        image = Image.fromarray(mesh.texture)
        image.thumbnail((2048, 2048))
        uv = mesh.uv * (1, -1) + (0, 1)
        made.visual = TextureVisuals(uv, material=PBRMaterial(baseColorTexture=image, **matt))
    else:
        made.visual = ColorVisuals(made, vertex_colors=mesh.colors)
    return made
