"""Makes the moving picture of the README: photos of a reconstruction on the left, a run of its scene on the right.

python scripts/animation.py runs/demo/scene runs/demo/rollout -o docs/images/photos-to-motion.webp --until 1.3 \\
    --camera -1.9 -1.9 1.4 --look-at -0.6 0.35 0.3
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from sdfsim.apps.render import picture_at
from sdfsim.apps.run import read_run
from sdfsim.base.errors import SdfsimError, run_main
from sdfsim.base.files import replacing
from sdfsim.simulate.camera import Camera, Style

HEIGHT = 360  # px; a photo and a picture side by side
RATE = 20  # frames a second
BEFORE, AFTER = 0.6, 1.0  # s, pauses at the start and at the end
EACH = 0.15  # s, display time of a photo
GAP = 8  # px between the two
MOST = 3 * 2**20  # bytes


def photos(room: Path) -> list[Image.Image]:
    """The photos of the reconstruction."""
    found = []
    for file in sorted((room / "photos" / "images").glob("*.jpg")):
        image = Image.open(file).convert("RGB")
        found.append(image.resize((round(image.width * HEIGHT / image.height), HEIGHT), Image.Resampling.LANCZOS))
    if not found:
        raise SdfsimError(f"{room}: no photos in it", "give the folder of a reconstruction")
    return found


def main() -> None:
    """Writes an animated WebP of at most three megabytes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", type=Path, help="folder of a reconstruction")
    parser.add_argument("run", type=Path, help="folder of a run of its scene")
    parser.add_argument("-o", "--out", type=Path, required=True, help="a .webp file")
    parser.add_argument("--camera", type=float, nargs=3, help="where from, m")
    parser.add_argument("--look-at", type=float, nargs=3, help="where to, m")
    parser.add_argument("--until", type=float, help="s (default: the end of the run)")
    given = parser.parse_args()

    seen = photos(given.room)
    scene, rollout = read_run(given.run, allow_outside=True)
    camera = Camera.fit(
        rollout, scene, position=given.camera, look_at=given.look_at, width=16 * HEIGHT // 9, height=HEIGHT
    )
    end = float(rollout.time[-1]) if given.until is None else given.until
    times = np.arange(0.0, end, 1.0 / RATE)
    moving = []
    for time in times:
        moving.append(Image.fromarray(picture_at(camera, scene, rollout, float(time), Style(smooth=True))))
        print(f"\r{len(moving)} of {len(times)}", end="", file=sys.stderr)
    pictures = [*[moving[0]] * round(BEFORE * RATE), *moving, *[moving[-1]] * round(AFTER * RATE)]
    frames = []
    for k, picture in enumerate(pictures):
        photo = seen[int(k / RATE / EACH) % len(seen)]
        frame = Image.new("RGB", (photo.width + GAP + picture.width, HEIGHT), "white")
        frame.paste(photo, (0, 0))
        frame.paste(picture, (photo.width + GAP, 0))
        frames.append(frame)
    for quality in (80, 70, 60, 50, 40, 30, 20):  # the best quality that is small enough
        with replacing(given.out) as partial:
            how = {"save_all": True, "append_images": frames[1:], "duration": round(1000 / RATE), "loop": 0}
            frames[0].save(partial, "WEBP", quality=quality, method=4, **how)
            size = partial.stat().st_size
        if size <= MOST:
            print(f"\nwrote {given.out}: {len(frames)} frames, {size / 2**20:.2f} MiB, quality {quality}")
            return
    raise SdfsimError(f"{given.out}: more than {MOST / 2**20:g} MiB", "give --until a shorter time")


if __name__ == "__main__":
    run_main(main)
