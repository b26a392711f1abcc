"""The page on which a person plays with a session: the mouse, the keys and the panel."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.apps.page import Batch, Page
from sdfsim.apps.play.session import MINUTE, Session
from sdfsim.base.errors import SdfsimError
from sdfsim.physics import pose
from sdfsim.scene.bundled import sample_folder
from sdfsim.scene.scene import Scene
from sdfsim.scene.schema import UNITS
from sdfsim.shape.shape import own_pieces
from sdfsim.simulate.looks import is_infinite

ARROW, POINT, NODE = (214, 69, 65), (214, 69, 65), (30, 90, 180)
ANGLE = np.radians(15.0)  # that a key turns a body by
SLICE = 96  # px of a picture of the SDF
MOST_POINTS = 3000  # contact points that are shown
MOST_PIECES = 64
NUMBERS = {
    "mass": ("mass, kg", 1e-6, 1e9, 1e-6),
    "friction": ("friction", 0.0, 1000.0, 0.01),
    "restitution": ("restitution", 0.0, 1.0, 0.01),
}  # label, smallest, largest, step
SHOWN = ("Contact points", "Forces on the body", "Nodes of the body", "Pieces of the body", "Slice of its SDF")

HELP = """**Drag** a body by any point. **Click** selects, **Shift** + click throws a ball there, **Ctrl** + click
pushes. Drag the background to turn the view, with the right button to move it.

Keys: **Space** pause · **N** one step · **0** reset · **B** back 1 s · **Z X** turn, **C V** tilt · **H** hold still ·
**K** copy · **Delete**"""


class Controls(Page):
    """The page of a session. `picked` is the name of the body that was clicked last, and `spot` [3] m where.

    What a person does on the page is done in the page's thread, between two poses: other threads only queue it.
    """

    def __init__(self, session: Session, port: int | None = None) -> None:
        self.session, self.picked, self.spot = session, "", session.middle
        self._uploads = tempfile.TemporaryDirectory(prefix="sdfsim-play-")
        self._over: Any = None  # the frame that follows the picked body
        super().__init__(session, port)
        self.acts = self._acts()
        for modifier, act in ((None, self._clicked), ("shift", self._throw), ("cmd/ctrl", self._push)):
            self.server.scene.on_click(modifier=modifier)(self.soon(act))
        for label, (key, act) in self.acts.items():
            if key:
                self.server.gui.add_command(label, hotkey=key).on_trigger(self.soon(act))
        self._panel()
        self.every(0.2, self._refresh)
        self.every(0.1, self._mark)

    def close(self) -> None:
        super().close()
        self._uploads.cleanup()

    def tell(self, error: SdfsimError | str) -> None:
        """A short notice on the page."""
        text = error if isinstance(error, str) else ". ".join(filter(None, (error.message, error.hint)))
        for client in self.server.get_clients().values():
            client.add_notification("sdfsim", text, auto_close_seconds=8.0)

    def do(self, command: Callable[..., Any], *given: Any, **named: Any) -> Any:
        """Run a command of the session between two steps; an error becomes a notice."""
        try:
            return self.session.call(lambda: command(*given, **named))
        except SdfsimError as error:
            self.tell(error)

    # --- mouse and keys ---

    def draggable(self, batch: Batch) -> None:
        async def drag(event: Any) -> None:  # async: phases come in their order
            name, session = batch.names[event.instance_index or 0], self.session
            if event.phase == "start":
                session.post(session.grab, name, event.start_position, event.end_position)
                self.later(lambda: self._pick(name, np.array(event.start_position)))
            elif event.phase == "end":
                session.post(session.release, name)
            else:
                session.post(session.drag, name, event.end_position)

        batch.handle.on_drag("left")(drag)

    def _clicked(self, event: Any) -> bool:
        origin, along = np.array(event.ray_origin), np.array(event.ray_direction)
        found = self.do(self.session.seen, origin, along)
        if found is not None:
            self._pick(found[0], origin + found[1] * along)
        return found is not None

    def _throw(self, event: Any) -> None:
        self.do(self.session.throw, event.ray_origin, event.ray_direction)

    def _push(self, event: Any) -> None:
        if self._clicked(event):
            self.do(self.session.push, self.picked, self.spot, event.ray_direction)

    def _acts(self) -> dict[str, tuple[str, Callable[..., Any]]]:
        """What buttons and keys do, by the names of the buttons; and the keys."""
        session, up = self.session, self.up(self.session.simulator.scene)
        across = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])

        def of_picked(command: Callable[..., Any], *more: Any) -> Callable[..., Any]:
            return lambda *_: self.do(command, self.picked, *more) if self.picked else None

        def now(command: Callable[..., Any], *given: Any) -> Callable[..., Any]:
            return lambda *_: self.do(command, *given)

        def returned(command: Callable[..., Any], *given: Any) -> Callable[..., Any]:
            return lambda *_: (self.do(command, *given), self._show_picked())

        return {
            "Play / Pause": ("space", lambda *_: self.do(session.pause, paused=session.playing)),
            "Step": ("N", now(session.one_step)),
            "Reset": ("0", returned(session.reset)),
            "Back 1 s": ("B", returned(session.back, 1.0)),
            "Slower": ("", lambda *_: self.do(session.set_speed, 0.5 * session.speed)),
            "Real time": ("", now(session.set_speed, 1.0)),
            "Faster": ("", lambda *_: self.do(session.set_speed, 2.0 * session.speed)),
            "Turn left": ("Z", of_picked(session.turn, up, ANGLE)),
            "Turn right": ("X", of_picked(session.turn, up, -ANGLE)),
            "Tilt": ("C", of_picked(session.turn, across, ANGLE)),
            "Tilt back": ("V", of_picked(session.turn, across, -ANGLE)),
            "Hold": ("H", of_picked(session.hold_or_let_go)),
            "Copy": ("K", of_picked(session.copy)),
            "Delete": ("delete", of_picked(session.delete)),
        }

    def _buttons(self, label: str, *names: str) -> None:
        self.server.gui.add_button_group(label, names).on_click(self.given(lambda name: self.acts[name][1]()))

    def _pick(self, name: str, spot: np.ndarray) -> None:
        self.spot = spot
        if name != self.picked:
            self.picked = name
            self._show_picked()

    # --- the panel ---

    def _panel(self) -> None:
        gui, scene = self.server.gui, self.session.simulator.scene
        self._status = gui.add_markdown("")
        self._buttons("Time", "Play / Pause", "Step", "Reset")
        self._buttons("Speed", "Slower", "Real time", "Faster")
        self._past = gui.add_slider("Back, s", 0.0, MINUTE, 0.1, 0.0, hint="of the last minute; pauses")
        self._past.on_update(self.given(self._go_back))
        self._went = 0.0  # the time from which the slider counts
        tabs = gui.add_tab_group()
        with tabs.add_tab("Body"):
            self._body = gui.add_folder("Click a body")
        if scene.joints:
            with tabs.add_tab("Joints"):
                self._joints()
        with tabs.add_tab("Scene"):
            self._adding()
            self._folder = gui.add_text("Folder", "played")
            hint = "the scene as it is; the motion since its last change"
            gui.add_button_group("Save", ("Scene", "Run"), hint=hint).on_click(self._saved)
        with tabs.add_tab("Show"):
            self._with = {name: gui.add_checkbox(name, False) for name in SHOWN}
            self._height = gui.add_slider("Slice at", 0.0, 1.0, 0.02, 0.5)
            for one in (*self._with.values(), self._height):
                one.on_update(self.given(lambda _: self._overlays()))
        with tabs.add_tab("Help"):
            gui.add_markdown(HELP)

    def _go_back(self, seconds: float) -> None:
        if self.session.playing:
            self.do(self.session.pause)
            self._went = self.session.frame.time
        self.do(lambda: self.session.back(self.session.now + seconds - self._went))
        self._show_picked()

    def draw(self, scene: Scene) -> None:
        super().draw(scene)
        if self.picked and self.picked not in {body.name for body in scene.bodies}:
            self._pick("", self.spot)

    def _show_picked(self) -> None:
        """Fill the folder of the picked body anew."""
        gui, session, name = self.server.gui, self.session, self.picked
        for child in list(self._body._children.values()):
            child.remove()
        found = self.do(session.facts, name) if name else None
        self._body.label = name if found else "Click a body"
        self._overlays()
        if not found:
            return
        with self._body:
            self._facts = gui.add_markdown(found[0])
            for what, value in found[1].items():
                label, low, high, step = NUMBERS[what]
                field = gui.add_number(label, value, min=low, max=high, step=step)
                field.on_update(self.given(lambda value, what=what: self.do(session.set, name, what, value)))
            if "mass" in found[1]:
                self._buttons("", "Hold", "Copy", "Delete")

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
            slider.on_update(self.given(
                lambda value, name=joint.name, unit=unit: self.do(self.session.target, name, value / unit)
            ))  # fmt: skip

    def _adding(self) -> None:
        gui, size = self.server.gui, float(f"{0.15 * self.session.wide:.2g}")
        folders = {folder.name: folder for folder in sorted((sample_folder() / "shapes").glob("*/"))}
        kinds = gui.add_dropdown("Shape", ("box", "sphere", "cylinder", "capsule", *folders))
        wide = gui.add_number("Size, m", size, min=1e-4, step=float(f"{size / 10:.1g}"))

        def added(_: Any) -> None:
            kind, w = kinds.value, float(wide.value)
            keys: dict[str, Any] = {
                "box": {"box": {"size": [w] * 3}}, "sphere": {"sphere": {"radius": w / 2}},
                "cylinder": {"cylinder": {"radius": w / 4, "height": w}},
                "capsule": {"capsule": {"radius": w / 4, "height": w}},
            }.get(kind) or {"asset": folders[kind], "wanted": w}  # fmt: skip
            self._add(kind, **keys)

        gui.add_button("Add above the last click", icon=None).on_click(added)
        units = gui.add_dropdown("Units of a mesh", tuple(UNITS), initial_value="m")

        def uploaded(event: Any) -> None:
            given = event.target.value
            file = Path(self._uploads.name) / Path(given.name).name
            file.write_bytes(given.content)
            self.tell(f"{file.name} becomes a shape; a first fit takes up to a minute")
            self._add(file.stem, mesh=file, units=units.value, cap=True)

        gui.add_upload_button("Upload a mesh", mime_type=".obj,.ply,.stl,.glb,.off").on_upload(uploaded)

    def _add(self, name: str, **keys: Any) -> None:
        """In a thread of viser's, as it may take a while."""
        try:
            made = self.session.add(name, self.spot, **keys)
            self.later(lambda: self._pick(made, self.spot))
        except SdfsimError as error:
            self.tell(error)

    def _saved(self, event: Any) -> None:
        save = self.session.save_scene if event.target.value == "Scene" else self.session.save_run
        try:
            self.tell(f"wrote {save(Path(self._folder.value))}")
        except SdfsimError as error:
            self.tell(error)

    # --- what is drawn over the bodies ---

    def followed(self, frame: Any) -> None:
        rows = [k for k, body in enumerate(frame.scene.bodies) if body.name == self.picked]
        if rows and self._over is not None:
            self._over.position = frame.position[rows[0]]
            self._over.wxyz = np.roll(frame.orientation[rows[0]], 1)

    def _overlays(self) -> None:
        """Draw the frame that follows the picked body anew, with a box around it and what is switched on."""
        frame, name = self.session.frame, self.picked
        if self._over is not None:
            self._over.remove()
            self._over = None
        body = next((body for body in frame.scene.bodies if body.name == name), None)
        if body is None or is_infinite(frame.scene.shapes[body.shape]):
            return
        shape, drawn, on = frame.scene.shapes[body.shape], self.server.scene, self._with
        self._over = drawn.add_frame("/picked", show_axes=False)
        self.followed(frame)
        low, high = (shape.sdf.bounds - shape.com) * body.scale
        thin = 0.006 * float((high - low).max())
        drawn.add_line_segments("/picked/box", points=_edges(low, high), colors=(255, 150, 0), thickness=thin)
        if on["Nodes of the body"].value and len(shape.nodes):
            drawn.add_point_cloud("/picked/nodes", (shape.nodes - shape.com) * body.scale, NODE, point_size=thin,
                                  point_shape="circle")  # fmt: skip
        if on["Pieces of the body"].value:
            rng = np.random.default_rng(0)
            for k, piece in enumerate(own_pieces(shape)[:MOST_PIECES]):
                places, color = (piece.vertices - shape.com) * body.scale, tuple(rng.integers(60, 230, 3).tolist())
                drawn.add_mesh_simple(f"/picked/pieces/{k}", places, piece.faces, color=color, opacity=0.55,
                                      flat_shading=True)  # fmt: skip
        if on["Slice of its SDF"].value:
            image, at, width, height = _slice(shape, float(self._height.value))
            drawn.add_image("/picked/slice", image, body.scale * width, body.scale * height,
                            position=tuple((at - shape.com) * body.scale), wxyz=SIDEWAYS)  # fmt: skip

    def _mark(self) -> None:
        """Contact points and the forces on the picked body."""
        points, forces = self._with["Contact points"].value, self._with["Forces on the body"].value
        for name, on in (("/contacts", points), ("/forces", forces and self.picked)):
            if not on and self.server.scene.get_handle_by_name(name) is not None:
                self.server.scene.remove_by_name(name)
        simulator = self.session.simulator
        if not (points or forces) or not simulator.stepper.forces:
            return
        found = self.do(simulator.contact_points)[:MOST_POINTS]
        size = 0.003 * self.session.wide
        if points:
            places = np.array([contact.point for contact in found]).reshape(-1, 3)
            self.server.scene.add_point_cloud("/contacts", places, POINT, point_size=2 * size, point_shape="circle")
        if forces and self.picked and (long := self.do(self.session.metres_per_newton, self.picked)) is not None:
            mine = [(c.point, c.force if c.first == self.picked else -c.force) for c in found
                    if self.picked in (c.first, c.second)]  # fmt: skip
            arrows = np.array([(at, at + long * force) for at, force in mine]).reshape(-1, 2, 3)
            self.server.scene.add_arrows("/forces", arrows, ARROW, shaft_radius=size, head_radius=2.5 * size,
                                         head_length=5 * size)  # fmt: skip

    def _refresh(self) -> None:
        """The numbers of the panel."""
        session, frame = self.session, self.session.frame
        speed = f"**{session.ratio:.2f}** x real time" if session.playing else "**paused**"
        speed += "" if session.speed == 1.0 else f" (wanted {session.speed:g})"
        lines = [f"{frame.time:.2f} s · {speed} · {len(frame.scene.bodies)} bodies"]
        lines += [f"<span style='color:#d33'>⚠ {line}</span>" for line in session.broken[-3:]]
        _update(self._status, "content", "\n\n".join(lines))
        if session.playing:
            _update(self._past, "value", 0.0)
        if self.picked:
            found = self.do(session.facts, self.picked)
            if found:
                _update(self._facts, "content", found[0])


def _update(handle: Any, what: str, value: Any) -> None:
    """Send a change to the page, if it is one."""
    if getattr(handle, what) != value:
        setattr(handle, what, value)


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
