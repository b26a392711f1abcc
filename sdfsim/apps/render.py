"""A run as a movie or a picture, without a screen or a graphics driver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdfsim.apps.beside import COLOR, OPACITY, between, rows_in
from sdfsim.base.errors import EXIT_USAGE, SdfsimError
from sdfsim.base.files import replacing
from sdfsim.base.parallel import Progress, silent
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.builder import loaded
from sdfsim.scene.scene import Scene
from sdfsim.simulate.camera import SKY, Camera, Ghosts, Numbers, Style

if TYPE_CHECKING:
    from sdfsim.scene.builder import SceneBuilder

SIZE = (960, 540)  # px, width and height
FRAMES = 30  # per second
FORMATS = (".mp4", ".png")
TRANSPARENT = "none"  # the background of a picture with an alpha channel


def render(
    scene: Scene | SceneBuilder | Path | str, rollout: Rollout | Path | str, out: Path | str, *,
    camera: Camera | Numbers | None = None, look_at: Numbers | None = None, at: float | None = None,
    size: tuple[int, int] | None = None, fps: float = FRAMES, light: Numbers | None = None,
    background: str | Sequence[int] = SKY, opacity: Mapping[str, float] | None = None, beside: Rollout | None = None,
    on_progress: Progress = silent,
) -> None:  # fmt: skip
    """Write a movie (.mp4, H.264, as long as the run) or a picture (.png, at the time `at` s, by default the end) of a
    run.

    The camera is a `Camera`, or its position [3] m, and by default one that fits the run (`Camera.fit`); `look_at` [3]
    m is its target, `size` its width and height in px. `light` [3] points to the sun. `background` is RGB, the name of
    a colour, #rrggbb, or "none": transparent, for pictures only. `opacity` is that of bodies by their names, 0 to 1.
    A recorded motion `beside` the run is shown with translucent bodies. Raises SdfsimError for another ending, a time
    outside the run, values that a camera, a light or a movie cannot have, or a file that cannot be written.
    """
    out, scene = Path(out), loaded(scene)
    check_format(out)
    if isinstance(rollout, str | Path):
        rollout = Rollout.load(rollout)
    if not isinstance(rollout, Rollout):
        raise SdfsimError(f"rollout: must be a Rollout or the path of a rollout.npz (got a {type(rollout).__name__})")
    if at is not None and not rollout.time[0] <= at <= rollout.time[-1] + rollout.meta["dt"]:
        raise SdfsimError(f"--at {at:g}: the run holds {rollout.time[0]:g} to {rollout.time[-1]:g} s")
    if not isinstance(camera, Camera):
        wide, tall = size or SIZE
        camera = Camera.fit(rollout, scene, position=camera, look_at=look_at, width=wide, height=tall)
    elif look_at is not None or size is not None:
        raise SdfsimError("look_at and size: a Camera has its own")
    style = Style(light, _rgb(background), opacity or {}, smooth=True)
    if out.suffix == ".png":
        from PIL import Image

        pixels = picture_at(camera, scene, rollout, rollout.time[-1] if at is None else at, style, beside)
        with replacing(out) as partial:
            Image.fromarray(pixels).save(partial, format="PNG")
        return
    for fault, given in (
        ("--background: a movie cannot be transparent", style.background is None),
        (f"--fps {fps:g}: must be above zero", not fps > 0),
        (f"--size {camera.width} {camera.height}: a movie needs even sizes", camera.width % 2 or camera.height % 2),
    ):
        if given:
            raise SdfsimError(fault)
    count = max(1, round(float(rollout.time[-1] - rollout.time[0]) * fps) + 1)

    def pictures() -> Iterator[np.ndarray]:
        for k in range(count):
            yield picture_at(camera, scene, rollout, rollout.time[0] + k / fps, style, beside)
            on_progress((k + 1) / count, f"frame {k + 1} of {count}")

    write_movie(out, pictures(), camera, fps)


def picture_at(
    camera: Camera, scene: Scene, rollout: Rollout, time: float, style: Style, beside: Rollout | None = None
) -> np.ndarray:
    """[H, W, 3 or 4] uint8 for a moment of a run, s, with the recorded motion at that time."""

    def at(motion: Rollout) -> tuple[np.ndarray, np.ndarray]:
        place, turn = between(motion.time, motion.position, motion.orientation, np.array([time]))
        return place[0], turn[0]

    ghosts = None if beside is None else Ghosts(rows_in(scene, beside), *at(beside), COLOR, OPACITY)
    return camera.picture(scene, *at(rollout), style, ghosts).color


def _rgb(background: str | Sequence[int]) -> Sequence[int] | None:
    """RGB from 0 to 255; None if it is transparent."""
    if not isinstance(background, str):
        return background
    from PIL import ImageColor

    try:
        return None if background == TRANSPARENT else ImageColor.getrgb(background)[:3]
    except ValueError as error:
        hint = f"give a name such as white, #rrggbb, or {TRANSPARENT} for transparency"
        raise SdfsimError(f"--background {background}: no such colour", hint) from error


def shares(given: Sequence[str]) -> dict[str, float]:
    """Opacities of bodies, each written as NAME=SHARE. Raises SdfsimError for what is not."""
    found = {}
    for text in given:
        name, _, share = text.rpartition("=")
        try:
            found[name] = float(share)
        except ValueError as error:
            raise SdfsimError(f"--opacity {text}: must be NAME=SHARE, such as box=0.3", exit_code=EXIT_USAGE) from error
    return found


def check_format(out: Path) -> None:
    """Raises SdfsimError if the ending of a file is neither that of a movie nor of a picture."""
    if out.suffix not in FORMATS:
        raise SdfsimError(f"{out}: must end with {' or '.join(FORMATS)}")


def write_movie(out: Path, pictures: Iterator[np.ndarray], camera: Camera, fps: float) -> None:
    """Write RGB pictures of a camera [H, W, 3] uint8, `fps` a second, as H.264."""
    import av

    with replacing(out) as partial, av.open(str(partial), "w", format="mp4") as movie:
        rate = Fraction(fps).limit_denominator(1001)
        stream: Any = movie.add_stream("libx264", rate=rate, options={"crf": "20", "preset": "fast"})
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
        for pixels in pictures:
            movie.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        movie.mux(stream.encode())
