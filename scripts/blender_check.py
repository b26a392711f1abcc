"""Opens an exported run in Blender and compares it, frame by frame, with the same run as a CSV; ends with code 1 if
they differ. Needs a separate Python, with Blender as a module and without sdfsim:

    sdfsim export run -o run.glb --fps 24 && sdfsim export run -o run.csv --fps 24
    python3.11 -m venv blender && blender/bin/pip install bpy==5.0.1
    blender/bin/python scripts/blender_check.py run.glb run.csv 24
"""

import csv
import sys

NEAR = 1e-4  # m, and of a quaternion
HALF = 0.5**0.5


def main(glb: str, poses: str, fps: int) -> int:
    import bpy  # type: ignore[import-not-found]

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = fps
    bpy.ops.import_scene.gltf(filepath=glb)
    with open(poses, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = list(dict.fromkeys(row["body"] for row in rows))
    frames = [rows[k : k + len(names)] for k in range(0, len(rows), len(names))]
    there = {name: bpy.data.objects.get(name) for name in names}
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
    keys = {tuple(a.frame_range) for a in bpy.data.actions}
    if keys != {(0.0, float(len(frames) - 1))}:
        wrong.append(f"keys at frames {keys}, not 0 to {len(frames) - 1}")
    textures = [image.size[:] for image in bpy.data.images if image.size[0]]
    print(f"Blender {bpy.app.version_string}: {len(names)} objects, {len(frames)} frames at {fps} a second, ", end="")
    print(f"poses within {worst:.2g}, textures {textures}", *wrong, sep="\n  ")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], int(sys.argv[3])))
