"""Simulates samples and the large scenes, and takes their pictures for docs/tutorial.md and RESULTS.md.

python scripts/gallery.py [NAME ...]     # samples, or heaps, knots and shoes, which take minutes
"""

import sys
import tempfile
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from samples.large import HEAPS, write_scene
from sdfsim.apps.render import render
from sdfsim.apps.run import ending_lines, summary
from sdfsim.base.files import replacing
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.simulate.camera import Numbers
from sdfsim.simulate.simulator import Simulator

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
SMALL = (480, 270)  # px, size of a sample's picture
# Time, camera and target, in s and m.
PICTURES = {
    "bounce": (0.62, (0.0, -1.1, 0.45), (0.0, 0.0, 0.25)),
    "slope": (0.45, (0.3, -0.95, 0.2), (0.25, 0.05, -0.05)),
    "marble_run": (1.9, (0.3, -1.0, 0.8), (0.03, 0.0, 0.4)),
    "dominoes": (0.42, (-0.15, -0.32, 0.2), (0.0, 0.0, 0.02)),
    "spinning_plate": (1.5, (0.1, -0.8, 0.4), (0.05, -0.05, 0.08)),
    "tower": (4.0, (0.5, -0.8, 0.5), (0.0, 0.0, 0.18)),
    "heavy_on_light": (3.0, (-0.1, -1.1, 0.45), (-0.05, 0.0, 0.1)),
    "paddle": (0.9, (-0.3, -0.9, 0.7), (0.1, 0.0, 0.0)),
    "scan": (0.25, (0.25, -0.5, 0.35), (0.0, 0.0, 0.12)),
    "knocked_vase": (0.45, (-0.1, -1.4, 0.95), (0.15, 0.0, 0.6)),
    "pile": (1.0, (-1.0, -1.2, 0.7), (0.0, 0.0, 0.02)),
    "toss": (0.33, (0.05, -0.6, 0.25), (0.05, 0.0, 0.06)),
    "door": (1.0, (0.4, -4.0, 2.5), (0.55, 0.0, 1.0)),
    "cradle": (0.95, (0.1, -0.75, 0.62), (0.1, 0.0, 0.53)),
    "ragdoll": (1.1, (3.2, -3.4, 2.4), (1.2, 0.0, 0.8)),
    "cart": (0.75, (0.35, -1.5, 0.55), (0.85, 0.0, 0.12)),
    "gripper": (1.2, (0.3, -0.75, 0.4), (0.0, 0.0, 0.24)),
    "conveyor": (1.25, (0.65, -1.15, 0.95), (0.15, 0.0, 0.28)),
    "mobile_arm": (4.6, (0.9, -2.3, 1.25), (1.35, 0.0, 0.5)),
    "spheres_in_bowl": (4.0, (0.5, -0.9, 1.0), (0.0, 0.0, 0.3)),
}
# Camera and target, m, at the end.
LARGE = {
    "heaps": ((-4.2, -6.6, 3.6), (0.2, 0.2, 0.3)),
    "knots": ((-3.0, -4.6, 2.5), (0.05, 0.0, 0.2)),
    "shoes": ((-2.1, -3.3, 1.8), (0.05, 0.0, 0.05)),
}


def picture(
    scene: Scene, rollout: Rollout, name: str, camera: Numbers, look_at: Numbers,
    at: float | None = None, size: tuple[int, int] | None = None,
) -> None:  # fmt: skip
    """Writes NAME.jpg, in the renderer's own size or this one."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "picture.png"
        render(scene, rollout, whole, camera=camera, look_at=look_at, at=at)
        shown = Image.open(whole).convert("RGB")
    if size is not None:
        shown = shown.resize(size, Image.Resampling.LANCZOS)
    with replacing(IMAGES / f"{name}.jpg") as partial:
        shown.save(partial, "JPEG", quality=82)


def sample(name: str) -> None:
    """The picture of a sample; the console shows the final state of its bodies."""
    at, camera, look_at = PICTURES[name]
    scene = load_scene(ROOT / "samples" / f"{name}.yaml")
    rollout = Simulator(scene).run()
    print(name, *ending_lines(summary(scene, rollout, 0.0)), sep="\n  ")
    picture(scene, rollout, f"sample-{name}", camera, look_at, min(at, rollout.time[-1]), SMALL)


def large(name: str) -> None:
    """The picture of a large scene."""
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(write_scene(name, Path(folder)))
    rollout = Simulator(scene).run(steps=HEAPS[name].steps)
    print(f"{name}: {len(rollout)} steps")
    picture(scene, rollout, name, *LARGE[name])


if __name__ == "__main__":
    for chosen in sys.argv[1:] or [*PICTURES, *LARGE]:
        (large if chosen in LARGE else sample)(chosen)
