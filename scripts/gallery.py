"""Simulates every sample and takes its picture for docs/samples.md: python scripts/gallery.py [NAME ...]"""

import sys
import tempfile
from pathlib import Path

from PIL import Image

from sdfsim.apps.render import render
from sdfsim.apps.run import ending_lines, summary
from sdfsim.scene.load import load_scene
from sdfsim.simulate.simulator import Simulator

ROOT = Path(__file__).resolve().parents[1]
# When, from where and at what, in s and m.
PICTURES = {
    "bounce": (0.62, (0.0, -1.1, 0.45), (0.0, 0.0, 0.25)),
    "slope": (0.45, (0.75, -0.8, 0.45), (0.2, 0.05, -0.05)),
    "marble_run": (1.9, (0.3, -0.85, 0.75), (0.0, 0.0, 0.36)),
    "dominoes": (0.42, (-0.15, -0.32, 0.2), (0.0, 0.0, 0.02)),
    "spinning_plate": (1.5, (0.1, -0.8, 0.4), (0.05, -0.05, 0.08)),
    "tower": (4.0, (0.5, -0.8, 0.5), (0.0, 0.0, 0.18)),
    "heavy_on_light": (3.0, (-0.1, -1.1, 0.45), (-0.05, 0.0, 0.1)),
    "paddle": (0.9, (-0.3, -0.9, 0.7), (0.1, 0.0, 0.0)),
    "scan": (0.25, (0.25, -0.5, 0.35), (0.0, 0.0, 0.12)),
    "knocked_vase": (0.45, (-0.1, -1.4, 0.95), (0.15, 0.0, 0.6)),
    "pile": (1.0, (-1.0, -1.0, 0.6), (0.0, 0.0, 0.05)),
    "toss": (0.33, (0.0, -1.1, 0.4), (0.0, 0.0, 0.08)),
    "door": (1.0, (0.4, -3.4, 2.4), (0.5, 0.0, 0.9)),
    "cradle": (0.95, (0.5, -1.6, 0.9), (0.0, 0.0, 0.7)),
    "ragdoll": (1.1, (3.2, -3.4, 2.4), (1.2, 0.0, 0.8)),
    "spheres_in_bowl": (4.0, (0.5, -0.9, 1.0), (0.0, 0.0, 0.3)),
}


def main(names: list[str]) -> None:
    for name in names or PICTURES:
        at, camera, look_at = PICTURES[name]
        scene = load_scene(ROOT / "samples" / f"{name}.yaml")
        rollout = Simulator(scene).run()
        print(name, *ending_lines(summary(scene, rollout, 0.0)), sep="\n  ")
        with tempfile.TemporaryDirectory() as folder:
            picture = Path(folder) / "picture.png"
            render(scene, rollout, picture, camera=camera, look_at=look_at, at=min(at, rollout.time[-1]))
            small = Image.open(picture).convert("RGB").resize((480, 270), Image.Resampling.LANCZOS)
        small.save(ROOT / "docs" / "images" / f"sample-{name}.jpg", quality=82)


if __name__ == "__main__":
    main(sys.argv[1:])
