"""`play`: a scene, a room, a shape, a mesh or a robot runs live on a page in the browser. `show`: a run that is
over."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sdfsim.apps.export import plain_names
from sdfsim.apps.page import film
from sdfsim.apps.play.controls import Controls
from sdfsim.apps.play.session import Session
from sdfsim.apps.run import read_run
from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import StageProgress, of_stage, silent_stages
from sdfsim.geometry.mesh_io import MESH_SUFFIXES
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.builder import SceneBuilder, loaded
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import RECORD_FILE
from sdfsim.simulate.simulator import Simulator

ROBOTS = (".urdf", ".xml", ".mjcf")
HEIGHT = 600  # px, in a notebook


class Playing:
    """A page that is open. In a notebook it shows itself; `close` ends it.

    Attributes:
        address: of the page, on this machine.
        session: what is played.
        page: the page.
    """

    def __init__(self, session: Session, page: Controls) -> None:
        self.session, self.page, self.address = session, page, page.address
        session.begin()
        page.begin()

    @property
    def simulator(self) -> Simulator:
        """The simulator that is played with. Use it in `session.call(...)`, or in the callback of each step."""
        return self.session.simulator

    def close(self) -> None:
        """End the page and the session."""
        self.session.close()
        self.page.close()

    def __enter__(self) -> "Playing":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.address}" width="100%" height="{HEIGHT}" style="border:0"></iframe>'


def play(
    source: Scene | SceneBuilder | Simulator | Path | str,
    *,
    model: str | Path | None = None,
    on_step: Callable[[Simulator], object] | None = None,
    paused: bool = False,
    port: int | None = None,
    allow_outside: bool = False,
    on_progress: StageProgress = silent_stages,
) -> Playing:
    """Open a page in which a scene runs live, and return at once: `address` is where it is, `close` ends it.

    Args:
        source: a simulator, a scene, or what `opened` takes.
        model: as for `Simulator`.
        on_step: called with the simulator after each step, in the thread that makes the steps.
        paused: whether time stands still at first.
        port: of the page; None: 8080, or a free one.
        allow_outside: whether a scene file may use files outside its folder.
        on_progress: called while shapes are fitted.

    Raises SdfsimError if the source cannot be read or simulated.
    """
    if not isinstance(source, Simulator):
        if isinstance(source, str | Path):
            source = opened(source, allow_outside=allow_outside, on_progress=on_progress)
        source = Simulator(loaded(source, of_stage(on_progress, "shapes")), model)
    source.snapshot()
    source.step(1)  # compiles
    source.reset()
    session = Session(source, on_step)
    session.playing = not paused
    return Playing(session, Controls(session, port))


def show(rollout: Rollout | Path | str, scene: Scene | SceneBuilder | Path | str | None = None) -> None:
    """Open a page that plays a run: a rollout and its scene, or a run folder, whose scene is known. It appears in the
    notebook, or in the browser. `sdfsim.export(run, "run.html")` writes the same page. Raises SdfsimError if there is
    no run, or no scene."""
    if isinstance(rollout, Rollout):
        if scene is None:
            raise SdfsimError("a rollout does not hold its scene", "sdfsim.show(rollout, scene), or a run folder")
        known, motion = loaded(scene), rollout
    else:
        file = Path(scene) if isinstance(scene, str | Path) else None
        known, motion = read_run(Path(rollout), file)
    names = plain_names([body.name for body in known.bodies])
    film(known, names, motion.time, motion.position, motion.orientation).show(height=HEIGHT)


def opened(
    source: Path | str, *, allow_outside: bool = False, on_progress: StageProgress = silent_stages
) -> Scene | SceneBuilder:
    """The scene of a scene.yaml, a sample's name, a room or run folder, a Shape folder or a mesh (which falls on a
    floor), or a robot's URDF or MJCF file (a URDF with its root fixed). Raises SdfsimError if it is none of these."""
    path = Path(source)
    shapes = of_stage(on_progress, "shapes")
    if path.suffix.lower() in ROBOTS:
        from sdfsim.apps.import_robot import import_robot

        fixed = path.suffix.lower() == ".urdf"
        with tempfile.TemporaryDirectory(prefix="sdfsim-play-") as folder:
            out = Path(folder) / "scene.yaml"
            import_robot(path, out, fixed=fixed, floor=fixed, on_progress=on_progress)
            return load_scene(out, shapes)
    if path.suffix.lower() in MESH_SUFFIXES or (path / RECORD_FILE).is_file():
        keys: dict[str, Any] = {"asset": path} if path.is_dir() else {"mesh": path}
        alone = SceneBuilder().add(path.stem, **keys).load(shapes)
        low, high = alone.shapes[0].sdf.bounds
        size, middle = float((high - low).max()), 0.5 * (low + high)
        scene = SceneBuilder(duration=10.0).add("floor", plane={}, friction=0.8)
        return scene.add(path.stem, **keys, position=(-middle[0], -middle[1], 0.3 * size - low[2]))
    if path.is_dir() and not (path / "scene.yaml").is_file():
        raise SdfsimError(f"{path}: neither a room, a run with its scene nor a Shape folder", "it has no scene.yaml")
    return load_scene(path / "scene.yaml" if path.is_dir() else path, shapes, allow_outside=allow_outside)
