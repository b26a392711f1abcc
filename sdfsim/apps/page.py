"""A scene on a page in the browser, by viser: live, or a run in one file that needs no server."""

import io
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any, Protocol

import numpy as np

from sdfsim.apps.viewer import LOOPBACK, free_port
from sdfsim.geometry.mesh import Mesh
from sdfsim.physics import pose
from sdfsim.scene.scene import Scene
from sdfsim.simulate.camera import eye_around
from sdfsim.simulate.looks import body_colors, framed, is_infinite, with_normals

PORT = 8080
RATE = 60.0  # poses a second, at most
FLOOR, LINES = (205, 209, 215), (170, 176, 184)  # colours of infinite planes
FOV = np.radians(45.0)
NAMES = "(names)"  # node of a film with a label at each body, hidden at first


class Batch:
    """Bodies of one shape, which are drawn as copies of its mesh; or one body, which is a node of its own."""

    def __init__(self, handle: Any, rows: list[int], names: list[str]) -> None:
        self.handle, self.rows, self.names = handle, rows, names
        self._sent: tuple[np.ndarray, np.ndarray] | None = None

    def place(self, position: np.ndarray, orientation: np.ndarray) -> bool:
        """Move the copies to the poses of their bodies among [N, 3] and [N, 4], if these have changed. Returns whether
        they have."""
        place, turn = position[self.rows], np.roll(orientation[self.rows], 1, axis=1)
        if self._sent is not None and np.array_equal(place, self._sent[0]) and np.array_equal(turn, self._sent[1]):
            return False
        self._sent = place, turn
        if len(self.rows) == 1:
            self.handle.position, self.handle.wxyz = place[0], turn[0]
        else:
            self.handle.batched_positions = place.astype(np.float32)
            self.handle.batched_wxyzs = turn.astype(np.float32)
        return True


class Drawing:
    """A server of viser that draws a scene.

    Args:
        scene: its bodies are where the scene has them.
        port: None: 8080, or a free one.
        names: [N] of the bodies on the page; with them, each body is a node of this name.
    """

    def __init__(self, scene: Scene, port: int | None = None, names: list[str] | None = None) -> None:
        import viser

        port = free_port(PORT) if port is None else port
        with redirect_stdout(io.StringIO()):  # it prints its own lines
            self.server: Any = viser.ViserServer(host=LOOPBACK, port=port, label="sdfsim", verbose=False)
        self.address = f"http://localhost:{self.server.get_port()}"
        self.scene, self._names = scene, names
        self.batches: dict[tuple[int, ...], Batch] = {}
        server = self.server
        server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        server.scene.set_up_direction(tuple(self.up(scene)))
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

    def stop(self) -> None:
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def draw(self, scene: Scene) -> None:
        """Draw the bodies of a scene; batches with the same bodies as before stay."""
        self.scene = scene
        found: dict[tuple[int, ...], list[int]] = {}
        for row, body in enumerate(scene.bodies):
            shape = scene.shapes[body.shape]
            if is_infinite(shape):
                self._plane(scene, row)
            else:
                alone = (row,) if self._names else ()
                found.setdefault((id(shape), body.motion == "dynamic", *alone), []).append(row)
        for key, batch in list(self.batches.items()):
            if [scene.bodies[row].name for row in found.get(key, [])] != batch.names:
                self.batches.pop(key).handle.remove()
        for key, rows in found.items():
            if key in self.batches:
                self.batches[key].rows = rows
            else:
                self.batches[key] = self._batch(scene, rows)

    def _batch(self, scene: Scene, rows: list[int]) -> Batch:
        self._drawn += 1  # viser may still know a node that was removed
        name = self._names[rows[0]] if self._names else f"bodies/{self._drawn}"
        bodies = [scene.bodies[row] for row in rows]
        shape = scene.shapes[bodies[0].shape]
        mesh = drawable(shape.shown)
        given: dict[str, Any] = {
            "batched_wxyzs": np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1)),
            "batched_positions": np.zeros((len(rows), 3)),
            "batched_scales": np.array([body.scale for body in bodies], np.float32),
            "lod": "off",
        }
        vertices = mesh.vertices - shape.com
        if mesh.colors is None and mesh.texture is None:
            given["batched_colors"] = np.array(body_colors(scene), np.uint8)[rows]
            handle = self.server.scene.add_batched_meshes_simple(f"/{name}", vertices, mesh.faces, **given)
        else:
            handle = self.server.scene.add_batched_meshes_trimesh(f"/{name}", dressed(vertices, mesh), **given)
        batch = Batch(handle, rows, [body.name for body in bodies])
        if bodies[0].motion == "dynamic":
            self.draggable(batch)
        return batch

    _drawn = 0

    def draggable(self, batch: Batch) -> None:
        """Called for each batch of bodies that move."""

    def _plane(self, scene: Scene, row: int) -> None:
        body, radius = scene.bodies[row], framed(scene)[1]
        cell = 10.0 ** np.floor(np.log10(radius))
        # A photographed floor may lie in the plane.
        sunk = body.position - 0.004 * radius * pose.rotate(body.quat_xyzw, np.array([0.0, 0.0, 1.0]))
        self.server.scene.add_grid(
            f"/{self._names[row] if self._names else f'planes/{row}'}", infinite_grid=True, plane="xy",
            cell_size=cell / 2, section_size=cell, cell_color=LINES, section_color=LINES, cell_thickness=0.0,
            section_thickness=1.0, plane_color=FLOOR, plane_opacity=1.0, shadow_opacity=0.45,
            fade_distance=14.0 * radius, fade_strength=1.5, position=tuple(sunk),
            wxyz=tuple(np.roll(body.quat_xyzw, 1)),
        )  # fmt: skip


def film(scene: Scene, names: list[str], time: np.ndarray, position: np.ndarray, orientation: np.ndarray) -> Any:
    """A motion as a recording of viser, whose `as_html()` is a page that plays it without a server.

    Args:
        names: [N] of the bodies on the page, without slashes.
        time: [T] s.
        position, orientation: [T, N, 3] m, centres of mass; [T, N, 4] xyzw.
    """
    drawing = Drawing(scene, free_port(), names)
    labels, batches = {}, list(drawing.batches.values())
    drawing.server.scene.add_frame(f"/{NAMES}", show_axes=False, visible=False)
    for batch in batches:
        (row,) = batch.rows
        labels[row] = drawing.server.scene.add_label(f"/{NAMES}/{names[row]}", names[row], anchor="bottom-center")
    recorder = drawing.server.get_scene_serializer()
    for k, wait in enumerate(np.diff(time, prepend=time[0])):
        recorder.insert_sleep(float(wait))
        for batch in batches:
            (row,) = batch.rows
            if batch.place(position[k], orientation[k]):
                labels[row].position = position[k, row]
    drawing.stop()
    return recorder


class Shown(Protocol):
    """What a live page shows."""

    frame: Any  # a `Frame` of a session
    changed: threading.Condition


class Page(Drawing):
    """A page that follows the motion of bodies. `address` is where it is."""

    def __init__(self, shown: Shown, port: int | None = None) -> None:
        self.shown, self._closed = shown, False
        self._todo: deque[Callable[[], Any]] = deque()
        self._each: list[tuple[float, Callable[[], None]]] = []  # period s, and what is done so often
        super().__init__(shown.frame.scene, port)

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
        self.stop()

    def every(self, seconds: float, work: Callable[[], None]) -> None:
        """Do something again and again between poses."""
        self._each.append((seconds, work))

    def later(self, work: Callable[[], Any]) -> None:
        """Do something once between poses."""
        self._todo.append(work)
        with self.shown.changed:
            self.shown.changed.notify_all()

    def soon(self, act: Callable[[Any], Any]) -> Callable[[Any], None]:
        """A callback that does `act(event)` between poses."""
        return lambda event: self.later(lambda: act(event))

    def given(self, act: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """A callback that does `act(value)` between poses, with what a person has given an element of the panel."""

        async def queue(event: Any) -> None:  # async: at once, before the page changes the value
            value = event.target.value
            if event.client is not None:  # else the page itself has set it
                self.later(lambda: act(value))

        return queue

    def _send(self) -> None:
        number, due = -1, [0.0] * len(self._each)
        while not self._closed:
            with self.shown.changed:
                if self.shown.frame.number == number and not (self._closed or self._todo):
                    self.shown.changed.wait(timeout=0.1)
            frame, began = self.shown.frame, time.perf_counter()
            try:
                if frame.number != number:
                    number = frame.number
                    self._follow(frame)
                while self._todo:
                    self._todo.popleft()()
                for k, (period, work) in enumerate(self._each):
                    if began >= due[k]:
                        due[k] = began + period
                        work()
            except Exception:  # a bug, which must not end the page
                traceback.print_exc()
            time.sleep(max(0.0, began + 1.0 / RATE - time.perf_counter()))

    def _follow(self, frame: Any) -> None:
        with self.server.atomic():
            if frame.scene is not self.scene:
                self.draw(frame.scene)
            for batch in self.batches.values():
                batch.place(frame.position, frame.orientation)
            self.followed(frame)
        self.server.flush()

    def followed(self, frame: Any) -> None:
        """Called with each frame that is sent, before it is."""


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
    step = 2.0 ** np.floor(np.log2(np.ptp(vertices, axis=0).max()) - 15)  # numbers of fewer bits make small files
    made = trimesh.Trimesh(np.round(vertices / step) * step, mesh.faces, vertex_normals=normals, process=False)
    matt: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    if mesh.texture is not None and mesh.uv is not None:
        image, file = Image.fromarray(mesh.texture), io.BytesIO()
        image.thumbnail((2048, 2048))
        image.save(file, "JPEG")  # trimesh keeps the format
        uv = np.round((mesh.uv * (1, -1) + (0, 1)) * 2**13) / 2**13  # a fraction of a pixel, in fewer bits
        made.visual = TextureVisuals(uv, material=PBRMaterial(baseColorTexture=Image.open(file), **matt))
    else:
        made.visual = ColorVisuals(made, vertex_colors=mesh.colors)
    return made
