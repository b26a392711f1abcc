"""The page on which a person plays with a session: the mouse, the keys and the panel."""

from __future__ import annotations

import tempfile
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.apps.page import Batch, Page
from sdfsim.apps.play.session import Session
from sdfsim.apps.recording import framed, is_infinite
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import convex_hull
from sdfsim.physics import pose
from sdfsim.scene.bundled import sample_folder
from sdfsim.scene.schema import UNITS
from sdfsim.shape.shape import own_pieces

ARROW, POINT, NODE = (214, 69, 65), (214, 69, 65), (30, 90, 180)
ANGLE = np.radians(15.0)  # that a key turns a body by
SLICE = 96  # px of a picture of the SDF
MOST_POINTS = 3000  # contact points that are shown
MOST_PIECES = 64

HELP = """**Drag** a body by any point. **Click** selects, **Shift** + click throws a ball there, **Ctrl** + click
pushes. Drag the background to turn the view, with the right button to move it.

Keys: **Space** pause · **N** one step · **0** reset · **B** back 1 s · **Z X** turn, **C V** tilt · **H** hold still ·
**K** copy · **Delete**"""


class Controls(Page):
    """The page of a session. `picked` is the name of the body that was clicked last."""

    def __init__(self, session: Session, port: int | None = None) -> None:
        self.session, self.picked, self.spot = session, "", framed(session.simulator.scene)[0]
        self.latencies: deque[float] = deque(maxlen=1000)  # s from a drag's message to the pose that it led to
        self._dragged: tuple[float, float] | None = None  # when a drag came, and when it acted
        self._uploads = tempfile.TemporaryDirectory(prefix="sdfsim-play-")
        super().__init__(session, port)
        for modifier, act in ((None, self._click), ("shift", self._throw), ("cmd/ctrl", self._push)):
            self.server.scene.on_click(modifier=modifier)(act)
        self._panel()
        self._keys()
        self.every(0.2, self._refresh)
        self.every(0.1, self._mark)

    def close(self) -> None:
        super().close()
        self._uploads.cleanup()

    def tell(self, text: str) -> None:
        """A short notice on the page."""
        for client in self.server.get_clients().values():
            client.add_notification("sdfsim", text, auto_close_seconds=8.0)

    def do(self, command: Callable[..., Any], *given: Any, **named: Any) -> Any:
        """Run a command of the session between two steps; an error becomes a notice."""
        try:
            return self.session.call(lambda: command(*given, **named))
        except SdfsimError as error:
            self.tell(f"{error.message}. {error.hint}" if error.hint else error.message)

    # --- mouse and keys ---

    def draggable(self, batch: Batch) -> None:
        async def drag(event: Any) -> None:  # async: phases come in their order
            name, came = batch.names[event.instance_index or 0], time.perf_counter()
            if event.phase == "start":
                self.session.post(self.session.grab, name, event.start_position, event.end_position)
                self._pick(name, np.array(event.start_position))
            elif event.phase == "end":
                self.session.post(self.session.release, name)
            else:
                self._note(self.session.post(self.session.drag, name, event.end_position), came)

        batch.handle.on_drag("left")(drag)

    def _note(self, done: Future, came: float) -> None:
        def acted(_: Future) -> None:
            if self._dragged is None:
                self._dragged = came, time.perf_counter()

        done.add_done_callback(acted)

    def after(self, frame: Any) -> None:
        if self._dragged is not None and frame.wall > self._dragged[1]:
            self.latencies.append(time.perf_counter() - self._dragged[0])
            self._dragged = None

    def _click(self, event: Any) -> None:
        origin, along = np.array(event.ray_origin), np.array(event.ray_direction)
        found = self.do(self.session.seen, origin, along)
        if found is not None:
            self._pick(found[0], origin + found[1] * along)

    def _throw(self, event: Any) -> None:
        self.do(self.session.throw, event.ray_origin, event.ray_direction)

    def _push(self, event: Any) -> None:
        origin, along = np.array(event.ray_origin), np.array(event.ray_direction)
        found = self.do(self.session.seen, origin, along)
        if found is not None:
            self._pick(found[0], origin + found[1] * along)
            self.do(self.session.push, found[0], self.spot, along)

    def _pick(self, name: str, spot: np.ndarray) -> None:
        self.spot = spot
        if name != self.picked:
            self.picked = name
            self._show_picked()

    def _keys(self) -> None:
        up = self.up(self.session.simulator.scene)
        across = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])

        def of_picked(command: Callable[..., Any], *more: Any) -> Callable[[], None]:
            return lambda: self.do(command, self.picked, *more) if self.picked else None

        session = self.session
        for key, label, act in (
            ("space", "pause or play", self._toggle),
            ("N", "one step", self._one_step),
            ("0", "reset", self._reset),
            ("B", "back 1 s", lambda: self.do(session.back, 1.0)),
            ("Z", "turn left", of_picked(session.turn, up, ANGLE)),
            ("X", "turn right", of_picked(session.turn, up, -ANGLE)),
            ("C", "tilt", of_picked(session.turn, across, ANGLE)),
            ("V", "tilt back", of_picked(session.turn, across, -ANGLE)),
            ("H", "hold still, or let go", self._hold),
            ("K", "copy", of_picked(session.copy)),
            ("delete", "delete", self._delete),
        ):
            self.server.gui.add_command(label, hotkey=key).on_trigger(lambda _, act=act: act())

    def _toggle(self) -> None:
        self.do(self.session.pause, paused=self.session.playing)

    def _faster(self, factor: float) -> None:
        self.do(self.session.set_speed, factor * self.session.speed or 1.0)

    def _one_step(self) -> None:
        self.do(self.session.pause)
        self.do(self.session.step)

    def _reset(self) -> None:
        self.do(self.session.reset)
        self._show_picked()

    def _hold(self) -> None:
        if self.picked:
            held = self.picked in self.session.hands
            self.do(self.session.hold, self.picked, held=not held)

    def _delete(self) -> None:
        if self.picked:
            self.do(self.session.delete, self.picked)
            self.picked = ""
            self._show_picked()

    # --- the panel ---

    def _panel(self) -> None:
        gui, session = self.server.gui, self.session
        self._status = gui.add_markdown("")
        acts = {
            "Play / Pause": self._toggle, "Step": self._one_step, "Reset": self._reset,
            "Slower": lambda: self._faster(0.5), "Real time": lambda: self._faster(0.0),
            "Faster": lambda: self._faster(2.0),
        }  # fmt: skip
        for label, names in (("Time", list(acts)[:3]), ("Speed", list(acts)[3:])):
            gui.add_button_group(label, names).on_click(lambda event: acts[event.target.value]())
        self._past = gui.add_slider("Back, s", 0.0, 60.0, 0.1, 0.0, hint="of the last minute; pauses")
        self._past.on_update(self._go_back)
        self._went = 0.0  # the time from which the slider counts
        tabs = gui.add_tab_group()
        with tabs.add_tab("Body"):
            self._body = gui.add_folder("Click a body")
        if session.simulator.scene.joints:
            with tabs.add_tab("Joints"):
                self._joints()
        with tabs.add_tab("Scene"):
            self._adding()
            self._saving()
        with tabs.add_tab("Show"):
            self._showing()
        with tabs.add_tab("Help"):
            gui.add_markdown(HELP)

    def _go_back(self, event: Any) -> None:
        if event.client is None:  # the page itself has set it
            return
        if self.session.playing:
            self.do(self.session.pause)
            self._went = self.session.simulator.si_state().time
        now = self.session.simulator.si_state().time
        self.do(self.session.back, event.target.value - (self._went - now))

    def _show_picked(self) -> None:
        """Fill the folder of the picked body anew."""
        gui, session, name = self.server.gui, self.session, self.picked
        for child in list(self._body._children.values()):
            child.remove()
        bodies = [body for body in session.simulator.scene.bodies if body.name == name]
        self._body.label = name or "Click a body"
        self._overlays()
        if not bodies:
            return
        with self._body:
            self._facts = gui.add_markdown("")
            numbers = [("friction", 0.0, 1000.0), ("restitution", 0.0, 1.0)]
            if bodies[0].motion == "dynamic":
                numbers.insert(0, ("mass", 1e-6, 1e9))
            for what, low, high in numbers:
                value = float(f"{getattr(bodies[0], what):.6g}")
                label = "mass, kg" if what == "mass" else what
                field = gui.add_number(label, value, min=low, max=high, step=1e-6 if what == "mass" else 0.01)
                field.on_update(lambda event, what=what: self.do(session.set, name, what, event.target.value))
            if bodies[0].motion == "dynamic":
                group = gui.add_button_group("", ("Hold", "Copy", "Delete"))
                acts = {"Hold": self._hold, "Copy": lambda: self.do(session.copy, name), "Delete": self._delete}
                group.on_click(lambda event: acts[event.target.value]())

    def _joints(self) -> None:
        simulator = self.session.simulator
        for joint in simulator.scene.joints:
            if joint.motor is None:
                continue
            handle, hinge = simulator.joint(joint.name), joint.kind == "hinge"
            unit = 180.0 / np.pi if hinge else 1.0
            low, high = joint.limits or ((-np.pi, np.pi) if hinge else (-1.0, 1.0))
            aim = handle.target
            aim = (handle.angle if hinge else handle.position) if aim is None else aim
            if joint.motor.speed is not None:
                low, high = -2.0 * abs(aim) - 1.0, 2.0 * abs(aim) + 1.0
            low, high, aim = (float(np.round(unit * value, 4)) for value in (low, high, aim))
            what = ("deg" if hinge else "m") + ("/s" if joint.motor.speed is not None else "")
            slider = self.server.gui.add_slider(
                f"{joint.name}, {what}", low, high, (high - low) / 500.0, min(max(aim, low), high)
            )
            slider.on_update(
                lambda event, name=joint.name, unit=unit: self.do(self.session.target, name, event.target.value / unit)
            )

    def _adding(self) -> None:
        gui, size = self.server.gui, 0.15 * framed(self.session.simulator.scene)[1]
        size = float(f"{size:.2g}")
        folders = {folder.name: folder for folder in sorted((sample_folder() / "shapes").glob("*/"))}
        self._shape = gui.add_dropdown("Shape", ("box", "sphere", "cylinder", "capsule", *folders))
        wide = gui.add_number("Size, m", size, min=1e-4, step=float(f"{size / 10:.1g}"))
        add = gui.add_button("Add above the last click", icon=None)

        def added(_: Any) -> None:
            kind, w = self._shape.value, float(wide.value)
            keys: dict[str, Any] = {
                "box": {"box": {"size": [w] * 3}}, "sphere": {"sphere": {"radius": w / 2}},
                "cylinder": {"cylinder": {"radius": w / 4, "height": w}},
                "capsule": {"capsule": {"radius": w / 4, "height": w}},
            }.get(kind) or {"asset": folders[kind]}  # fmt: skip
            if kind in folders:
                keys["wanted"] = w
            self._add(kind, **keys)

        add.on_click(added)
        units = gui.add_dropdown("Units of a mesh", tuple(UNITS), initial_value="m")
        upload = gui.add_upload_button("Upload a mesh", mime_type=".obj,.ply,.stl,.glb,.off")

        def uploaded(event: Any) -> None:
            given = event.target.value
            file = Path(self._uploads.name) / Path(given.name).name
            file.write_bytes(given.content)
            self.tell(f"{file.name} becomes a shape; a first fit takes up to a minute")
            self._add(file.stem, mesh=file, units=units.value, cap=True)

        upload.on_upload(uploaded)

    def _add(self, name: str, **keys: Any) -> None:
        try:
            self._pick(self.session.add(name, self.spot, **keys), self.spot)
        except SdfsimError as error:
            self.tell(f"{error.message}. {error.hint}")

    def _saving(self) -> None:
        gui = self.server.gui
        folder = gui.add_text("Folder", "played")
        group = gui.add_button_group(
            "Save", ("Scene", "Run"), hint="the scene as it is; the motion since its last change"
        )

        def saved(event: Any) -> None:
            save = self.session.save_scene if event.target.value == "Scene" else self.session.save_run
            try:
                self.tell(f"wrote {save(Path(folder.value))}")
            except SdfsimError as error:
                self.tell(f"{error.message}. {error.hint}")

        group.on_click(saved)

    def _showing(self) -> None:
        gui = self.server.gui
        self._with = {
            name: gui.add_checkbox(name, False)
            for name in (
                "Contact points",
                "Forces on the body",
                "Nodes of the body",
                "Pieces of the body",
                "Slice of its SDF",
            )
        }
        self._height = gui.add_slider("Slice at", 0.0, 1.0, 0.02, 0.5)
        for one in (*self._with.values(), self._height):
            one.on_update(lambda _: self._overlays())

    # --- what is drawn over the bodies ---

    def followed(self, frame: Any) -> None:
        rows = [k for k, body in enumerate(frame.scene.bodies) if body.name == self.picked]
        if rows and self._over is not None:
            self._over.position = frame.position[rows[0]]
            self._over.wxyz = np.roll(frame.orientation[rows[0]], 1)

    _over: Any = None

    def _overlays(self) -> None:
        """Draw the frame that follows the picked body anew, with a box around it and what is switched on."""
        scene, name = self.session.simulator.scene, self.picked
        if self._over is not None:
            self._over.remove()
            self._over = None
        rows = [k for k, body in enumerate(scene.bodies) if body.name == name]
        if not rows or is_infinite(scene.shapes[scene.bodies[rows[0]].shape]):
            return
        body, drawn = scene.bodies[rows[0]], self.server.scene
        shape, frame = scene.shapes[body.shape], self.session.frame
        self._over = drawn.add_frame("/picked", show_axes=False, position=frame.position[rows[0]],
                                     wxyz=np.roll(frame.orientation[rows[0]], 1))  # fmt: skip
        low, high = (shape.sdf.bounds - shape.com) * body.scale
        thin = 0.006 * float((high - low).max())
        drawn.add_line_segments("/picked/box", points=_edges(low, high), colors=(255, 150, 0), thickness=thin)
        if self._with["Nodes of the body"].value and len(shape.nodes):
            size = 0.004 * float((high - low).max())
            drawn.add_point_cloud("/picked/nodes", (shape.nodes - shape.com) * body.scale, NODE, point_size=2 * size,
                                  point_shape="circle")  # fmt: skip
        if self._with["Pieces of the body"].value:
            rng = np.random.default_rng(0)
            pieces = [convex_hull(p) for p in shape.pieces] if shape.pieces else own_pieces(shape)
            for k, piece in enumerate(pieces[:MOST_PIECES]):
                places, color = (piece.vertices - shape.com) * body.scale, tuple(rng.integers(60, 230, 3).tolist())
                drawn.add_mesh_simple(f"/picked/pieces/{k}", places, piece.faces, color=color, opacity=0.55,
                                      flat_shading=True)  # fmt: skip
        if self._with["Slice of its SDF"].value:
            image, at, width, height = _slice(shape, float(self._height.value))
            drawn.add_image("/picked/slice", image, body.scale * width, body.scale * height,
                            position=tuple((at - shape.com) * body.scale), wxyz=SIDEWAYS)  # fmt: skip

    def _mark(self) -> None:
        """Contact points and the forces on the picked body."""
        points, forces = self._with["Contact points"].value, self._with["Forces on the body"].value
        for name, on in (("/contacts", points), ("/forces", forces and bool(self.picked))):
            if not on and self.server.scene.get_handle_by_name(name) is not None:
                self.server.scene.remove_by_name(name)
        simulator = self.session.simulator
        if not (points or forces) or not simulator.stepper.forces:
            return
        found = self.do(simulator.contact_points)[:MOST_POINTS]
        size = 0.006 * framed(simulator.scene)[1]
        if points:
            places = np.array([contact.point for contact in found]).reshape(-1, 3)
            self.server.scene.add_point_cloud("/contacts", places, POINT, point_size=2 * size, point_shape="circle")
        if forces and self.session.movable(self.picked):
            mine = [(c.point, c.force if c.first == self.picked else -c.force) for c in found
                    if self.picked in (c.first, c.second)]  # fmt: skip
            body = simulator[self.picked]
            long = self.session.size(self.picked) / (body.mass * max(np.linalg.norm(simulator.scene.gravity), 1e-9))
            arrows = np.array([(at, at + long * force) for at, force in mine]).reshape(-1, 2, 3)
            self.server.scene.add_arrows("/forces", arrows, ARROW, shaft_radius=0.6 * size, head_radius=1.5 * size,
                                         head_length=3 * size)  # fmt: skip

    def _refresh(self) -> None:
        """The numbers of the panel."""
        session, frame = self.session, self.session.frame
        speed = f"**{session.ratio:.2f}** x real time" if session.playing else "**paused**"
        speed += "" if session.speed == 1.0 else f" (wanted {session.speed:g})"
        lines = [f"{frame.time:.2f} s · {speed} · {len(frame.scene.bodies)} bodies"]
        lines += [f"<span style='color:#d33'>⚠ {line}</span>" for line in session.broken[-3:]]
        text = "\n\n".join(lines)
        if text != self._status.content:
            self._status.content = text
        if session.playing and self._past.value != 0.0:
            self._past.value = 0.0
        if (
            self.picked
            and self.picked in {body.name for body in frame.scene.bodies}
            and self._body.label == self.picked
        ):
            body = session.simulator[self.picked]
            place, speed = body.centre, float(np.linalg.norm(body.velocity))
            state = "asleep" if body.asleep else "held" if self.picked in session.hands else f"{speed:.3g} m/s"
            spin = float(np.degrees(np.linalg.norm(body.angular_velocity)))
            self._facts.content = "at ({:.3f}, {:.3f}, {:.3f}) m · ".format(*place) + f"{state} · {spin:.3g} deg/s"


SIDEWAYS = tuple(np.roll(pose.from_rotvec(np.array([0.5 * np.pi, 0.0, 0.0])), 1))  # a picture in x, y -> in x, z


def _edges(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[12, 2, 3] the edges of a box."""
    corner = np.array([[(low, high)[(k >> axis) & 1][axis] for axis in range(3)] for k in range(8)])
    pairs = [(k, k | 1 << axis) for k in range(8) for axis in range(3) if not k >> axis & 1]
    return corner[np.array(pairs)]


def _slice(shape: Any, part: float) -> tuple[np.ndarray, np.ndarray, float, float]:
    """A picture [H, W, 3] of the SDF in a plane of equal y, at a `part` of the shape's depth: orange inside, blue
    outside, with a line each twentieth of its size; its middle [3] m, width and height m, all at scale 1."""
    low, high = shape.sdf.bounds
    margin = 0.15 * float((high - low).max())
    low, high = low - margin, high + margin
    y = low[1] + part * (high[1] - low[1])
    x, z = np.meshgrid(np.linspace(low[0], high[0], SLICE), np.linspace(high[2], low[2], SLICE))
    points = np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()])
    away = np.asarray(shape.sdf(points)[0], float).reshape(x.shape) / float((high - low).max())
    shade = 0.55 + 0.45 * np.exp(-8.0 * np.abs(away))[..., None]
    color = np.where(away[..., None] < 0.0, (255, 140, 40), (70, 130, 220)) * shade
    color[(np.abs(away) % 0.05 < 0.004) | (np.abs(away) < 0.006)] = 20
    middle = np.array([(low[0] + high[0]) / 2, y, (low[2] + high[2]) / 2])
    return color.astype(np.uint8), middle, float(high[0] - low[0]), float(high[2] - low[2])
