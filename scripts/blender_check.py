"""Installs the add-on samples/blender_sdfsim.py in Blender, opens a run with it, and compares every frame with the same
run as a CSV; ends with code 1 if they differ. Needs a separate Python, with Blender as a module and without sdfsim:

    python3.11 -m venv blender && blender/bin/pip install bpy==5.0.1
    blender/bin/python scripts/blender_check.py RUN .venv/bin/sdfsim
"""

import csv
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

NEAR = 1e-4  # m, and of a quaternion
HALF = 0.5**0.5
BASE = 1.001  # of the rate: 24 / 1.001 frames a second, as films have
FPS = 24 / BASE
ADDON = Path(__file__).resolve().parent.parent / "samples" / "blender_sdfsim.py"


def main(run: str, program: str, folder: str) -> int:
    os.environ["BLENDER_USER_RESOURCES"] = folder  # the add-on goes there
    import bpy  # type: ignore[import-not-found]

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.preferences.addon_install(filepath=str(ADDON))
    bpy.ops.preferences.addon_enable(module=ADDON.stem)
    bpy.context.preferences.addons[ADDON.stem].preferences.program = str(Path(program).absolute())
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = 24, BASE
    bpy.ops.import_scene.sdfsim(filepath=str(Path(run) / "rollout.npz"), allow_outside=True)
    poses = Path(folder) / "run.csv"
    subprocess.run([program, "export", run, "-o", poses, "--fps", repr(FPS), "--allow-outside"], check=True)
    with open(poses, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = list(dict.fromkeys(row["body"] for row in rows))
    frames = [rows[k : k + len(names)] for k in range(0, len(rows), len(names))]
    there = {name: bpy.data.objects.get(re.sub(r"^(?=\d)|\W+", "_", name)) for name in names}
    wrong = [f"no object {name}" for name in names if there[name] is None]
    worst = 0.0
    for number, frame in enumerate(frames):
        scene.frame_set(number)
        for row in frame:
            found = there[row["body"]]
            if found is None:
                continue
            place, turn, _ = found.matrix_world.decompose()
            w, x, y, z = (float(row[c]) for c in ("qw", "qx", "qy", "qz"))
            # Blender turns a mesh from y up to z up, and its object back.
            wanted = [HALF * (w + x), HALF * (x - w), HALF * (y - z), HALF * (z + y)]
            sign = 1.0 if sum(a * b for a, b in zip(turn, wanted, strict=True)) > 0 else -1.0
            off = [abs(a - float(row[c])) for a, c in zip(place, "xyz", strict=True)]
            off += [abs(sign * a - b) for a, b in zip(turn, wanted, strict=True)]
            # A floor in the same plane as scenery is drawn a little lower.
            worst = max(worst, *off) if found.animation_data else worst
    if worst > NEAR:
        wrong.append(f"poses differ by {worst:.2g}")
    keys = {tuple(a.frame_range) for a in bpy.data.actions} | {(float(scene.frame_start), float(scene.frame_end))}
    if any(abs(start) > NEAR or abs(end - len(frames) + 1) > NEAR for start, end in keys):
        wrong.append(f"keys at frames {keys}, not 0 to {len(frames) - 1}")
    textures = [image.size[:] for image in bpy.data.images if image.size[0]]
    print(
        f"Blender {bpy.app.version_string}: {len(names)} objects, {len(frames)} frames at {FPS:.5g} a second, ", end=""
    )
    print(f"poses within {worst:.2g}, textures {textures}", *wrong, sep="\n  ")
    return 1 if wrong else 0


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as home:
        sys.exit(main(sys.argv[1], sys.argv[2], home))
