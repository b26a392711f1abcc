"""Pages in a real browser: clicks into photos become options, and a run is watched."""

import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageDraw

from pipeline.inputs.photos import prepare_photos
from pipeline.measure import measure
from pipeline.mesh.placement import check_distance
from pipeline.options import options_of
from sdfsim import Scene, Simulator
from sdfsim.apps.film.camera import read_points
from sdfsim.apps.recording import save_rollout
from sdfsim.simulate.looks import body_colors
from tests.helpers.browser import Browser

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.gate
RED = (255, 0, 0)
# Where the dots are, px of the upright photo, by the photo.
DOTS = {"wide & big.jpg": (3010, 411), "turned.jpg": (200, 1105), "<b>it's.png": (33, 300)}


@pytest.fixture
def photos(tmp_path):
    """A large photo, one that was taken on its side, and a small one; each with a dot on grey."""
    folder = tmp_path / "my photos"
    folder.mkdir()
    sizes = {"wide & big.jpg": (4000, 1500), "turned.jpg": (900, 1200), "<b>it's.png": (420, 380)}
    for name, size in sizes.items():
        image = Image.new("RGB", size, (120, 120, 120))
        pen, (x, y), wide = ImageDraw.Draw(image), DOTS[name], max(size) / 100
        pen.ellipse((x - wide, y - wide, x + wide, y + wide), fill=RED)
        exif = Image.Exif()
        if name == "turned.jpg":
            image = image.transpose(Image.Transpose.ROTATE_90)
            exif[ExifTags.Base.Orientation] = 6  # to be turned clockwise by a quarter
        image.save(folder / name, quality=95, exif=exif)
    return folder


def dot(picture: Path) -> tuple[float, float]:
    """Where the browser shows the red dot, px of its window. Marks are of another red, and lie elsewhere."""
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    red = (pixels[..., 0] > 235) & (pixels[..., 1:].max(-1) < 30)
    red[:, :180] = False  # the list of all photos
    rows, columns = np.nonzero(red)
    return float(columns.mean()), float(rows.mean())


def test_clicks_give_the_options_to_paste(photos, tmp_path):
    page = measure(photos, tmp_path / "measure.html")["page"]
    found, _ = prepare_photos(photos, tmp_path / "prepared")
    names = [photo.source for photo in found]
    assert set(names) == set(DOTS)
    with Browser(tmp_path / "profile") as browser:
        browser.open(page.as_uri())

        def option() -> list[str]:
            return shlex.split(browser.value("document.getElementById('option').textContent"))

        def click_dot(name: str) -> None:
            browser.value(f"document.getElementById('list').children[{names.index(name)}].click()")
            browser.wait("document.getElementById('photo').complete")
            browser.click(*dot(browser.picture(tmp_path / "page.png")))

        command = ["sdfsim", "reconstruct", str(photos), "-o", "room", "--preset", "quick"]
        assert option() == command
        for part in ("nav", "main"):
            wide = f"document.querySelector('{part}').scrollWidth - document.querySelector('{part}').clientWidth"
            assert browser.value(wide) == 0
        browser.value("document.getElementById('metres').value = 1.25")
        click_dot("wide & big.jpg")
        click_dot("turned.jpg")
        *start, flag, first, second, metres = option()
        assert start == command
        assert flag == "--distance" and metres == "1.25"
        check_distance((first, second, float(metres)), found)  # as the command checks it
        browser.value("document.getElementById('body').click(); document.getElementById('name').value = 'cup'")
        click_dot("<b>it's.png")
        *_, flag, body = option()
        assert flag == "--body" and options_of(body=[body]).body == {"cup": [body[4:]]}
        for text, name in ((first, "wide & big.jpg"), (second, "turned.jpg"), (body[4:], "<b>it's.png")):
            assert text.rpartition(":")[0] == name
            at = np.array(text.rpartition(":")[2].split(","), dtype=float)
            long_side = max(next(photo.original for photo in found if photo.source == name))
            assert np.abs(at - DOTS[name]).max() < 0.003 * long_side + 1
        browser.value("document.getElementById('undo').click()")
        assert option()[:-4] == command and option()[-4] == "--distance"
        # Known places of a film: the file that `identify --points` reads.
        browser.value("document.getElementById('known').click()")
        places = [[0, 0, 0], [0.297, 0, 0], [0.297, 0.21, 0], [0, 0.21, -0.5]]
        browser.value(f"document.getElementById('list').children[{names.index('wide & big.jpg')}].click()")
        browser.wait("document.getElementById('photo').complete")
        browser.value("document.querySelectorAll('.mark').forEach((mark) => mark.remove())")
        at = dot(browser.picture(tmp_path / "page.png"))  # the marks of clicks hide it
        for place in places:
            browser.value(f"document.getElementById('xyz').value = '{str(place)[1:-1]}'")
            browser.click(*at)
        file = tmp_path / "points.yaml"
        file.write_text(browser.value("document.getElementById('option').textContent"))
        found = read_points(file)
        assert found.places.tolist() == places and found.focal is None and not len(found.horizon)
        assert np.abs(found.pixels - np.add(DOTS["wide & big.jpg"], 0.5)).max() < 0.003 * 4000 + 1
        assert not browser.errors


def test_a_recording_is_watched_in_the_browser(tmp_path):
    """The page that `view --web` serves shows the ball: rerun draws it on the processor here, which takes a while."""
    scene = Scene(duration=0.2)
    scene.add("floor", plane={})
    scene.add("ball", sphere={"radius": 0.5}, position=(0, 0, 0.5))
    loaded = scene.load()
    rollout = Simulator(loaded).run()
    save_rollout(loaded, rollout, tmp_path / "rollout.rrd")
    command = [sys.executable, "-m", "cli", "view", str(tmp_path / "rollout.rrd"), "--web"]
    # A shell that starts the tests in the background has them ignore Ctrl-C, and what they start.
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    shown = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, before)
    try:
        assert shown.stderr
        told = next(line for line in shown.stderr if line.startswith("watch it at "))  # the viewer has its own lines
        page = told.removeprefix("watch it at ").strip()
        assert page.startswith("http://localhost:")
        hue = np.array(body_colors(loaded)[1], dtype=float)
        with Browser(tmp_path / "profile") as browser:
            browser.open(page)
            end = time.monotonic() + 400
            while True:
                pixels = np.asarray(Image.open(browser.picture(tmp_path / "page.png")).convert("RGB"), dtype=float)
                # Light and shade change how bright the ball is, not its hue.
                along = pixels @ hue / np.linalg.norm(hue)
                aside = np.linalg.norm(pixels - along[..., None] * hue / np.linalg.norm(hue), axis=-1)
                ball = (along > 60) & (aside < 0.15 * along)
                if ball[:, :900].sum() > 2000:
                    break
                assert time.monotonic() < end, "no ball on the page"
                time.sleep(2.0)
            rows, columns = np.nonzero(ball[:, :900])
            assert 0.7 < np.ptp(columns) / np.ptp(rows) < 1.4  # round
    finally:
        shown.send_signal(signal.SIGINT)
        shown.wait()
    assert shown.returncode in (0, 130)
