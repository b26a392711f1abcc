"""report.json and report.html: complete, self-contained, also of a run that stopped."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline import stages
from pipeline.cameras import save_views
from pipeline.report import improvements
from pipeline.report_page import camera_plot, turntable_uri
from pipeline.sfm.pose_checks import judge, views_of
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.files import write_arrays
from sdfsim.shape.mesh import Mesh
from tests.pipeline.test_verdict import photo, result


class Page(HTMLParser):
    """Text, links and pictures of a page; fails where tags do not close."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text, self.sources = "", []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "<photos> & more"
    folder.mkdir()
    for k in range(6):
        pixels = np.random.default_rng(k).integers(0, 255, (96, 128, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"IMG_{k}.png")
    return folder


def poses_found(run, work: Path) -> dict:
    found = result(6, 5)
    verdict = judge(found, [photo(k) for k in range(6)])
    named = {f"IMG_{k}.JPG": f"IMG_{k}.png" for k in range(6)}
    verdict["left_out"] = [{**entry, "photo": named[entry["photo"]]} for entry in verdict["left_out"]]
    save_views(views_of(found, [photo(k) for k in range(6)]), work / "cameras.json")
    rng = np.random.default_rng(0)
    write_arrays(work / "sparse.npz", {"xyz": rng.normal(size=(50, 3)), "rgb": rng.integers(0, 255, (50, 3), np.uint8),
                                       "error": np.zeros(50), "point_of": np.zeros(0, int),
                                       "view_of": np.zeros(0, int)})  # fmt: skip
    return {**verdict, "attempts": [{"name": "ordinary", "posed": 5, "failures": []}]}


def test_the_page_needs_no_other_file_and_names_every_photo(photos, tmp_path, monkeypatch):
    monkeypatch.setitem(stages.ACTIONS, "poses", poses_found)
    report = stages.reconstruct(photos, tmp_path / "out", until_stage="poses")
    text = (tmp_path / "out" / "report.html").read_text()
    page = Page(text)
    assert all(source.startswith("data:image/") for source in page.sources) and len(page.sources) == 6
    assert "url(" not in text and "http" not in text.replace("http-equiv", "")
    assert "<photos> & more" in page.text
    for k in range(5):
        assert f"IMG_{k}.png: posed" in page.text
    assert "IMG_5.png: left out; too few matches" in page.text
    assert text.count('class="camera"') == 2 * 5
    assert report["paths"]["report"] == str(tmp_path / "out" / "report.html")
    assert [row["verdict"] for row in report["photos"]] == ["posed"] * 5 + ["left out"]


def test_a_run_that_stopped_says_where_and_why(photos, tmp_path, monkeypatch):
    def failing(run, work):
        (work / "verdict.json").write_text(json.dumps(judge(result(6, 1, features=20), [photo(k) for k in range(6)])))
        raise SdfsimError("camera poses: only 1 of 6", "take sharper photos", exit_code=EXIT_QUALITY)

    monkeypatch.setitem(stages.ACTIONS, "poses", failing)
    with pytest.raises(SdfsimError):
        stages.reconstruct(photos, tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["error"] == {
        "stage": "poses", "message": "camera poses: only 1 of 6", "hint": "take sharper photos",
    }  # fmt: skip
    assert report["poses"]["posed"] == 1 and any("too little to see" in line for line in report["improve"])
    page = Page((tmp_path / "out" / "report.html").read_text())
    assert "It stopped in the poses stage" in page.text and "take sharper photos" in page.text


def test_improvements_fit_what_is_wrong():
    rows = [{"photo": f"{k}.jpg", "fault": "blurred" if k == 3 else ""} for k in range(8)]
    report = {
        "photos": rows, "poses": judge(result(8, 8, span=60.0, error=1.5), [photo(k) for k in range(8)]),
        "stages": {"mesh": {"size": "assumed: widest side = 1 m"}}, "psnr": 15.0, "failed_checks": [],
    }  # fmt: skip
    lines = " / ".join(improvements(report))
    for words in ("blurred: 3.jpg", "8 are few", "walk further", "only within 1.5 px", "15.0 dB", "--size"):
        assert words in lines
    good = {**report, "photos": [{**row, "fault": ""} for row in rows] * 3, "psnr": 28.0, "stages": {},
            "poses": judge(result(8, 8), [photo(k) for k in range(8)])}  # fmt: skip
    assert improvements(good) == []


def test_cameras_are_drawn_where_they_stand():
    """From above, z up: a camera to the east is to the right of one to the west, and north is upwards."""
    views = [v.transformed(1.0, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3))
             for v in views_of(result(4, 4), [photo(k) for k in range(4)])]  # fmt: skip
    svg = camera_plot(views, np.zeros((1, 3)), np.array([[1, 2, 3]], np.uint8), {"IMG_1.JPG"}, top=True)
    starts = np.array([[float(v) for v in m] for m in re.findall(r'd="M([\d.]+),([\d.]+)L', svg)])
    centers = np.array([view.center[:2] for view in views])
    assert np.corrcoef(starts[:, 0], centers[:, 0])[0, 1] > 0.999
    assert np.corrcoef(starts[:, 1], -centers[:, 1])[0, 1] > 0.999
    assert svg.count('class="camera held"') == 1 and "#010203" in svg


def test_the_turntable_turns():
    """A box, red on its front (-y) and blue on its back: the first frame is red, the one half round is blue."""
    import base64
    import io

    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = np.array([[0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5],
                      [1, 5, 7], [1, 7, 3], [0, 2, 6], [0, 6, 4]])  # fmt: skip
    colors = np.where(corner[:, 1:2] < 0, [200, 0, 0], [0, 0, 200]).astype(np.uint8)
    uri = turntable_uri(Mesh(corner, faces, colors))
    image = Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1])))

    def middle(frame: int) -> np.ndarray:
        image.seek(frame)
        picture = np.asarray(image.convert("RGB")).astype(int)
        return picture[150:180, 170:190].mean((0, 1))

    assert middle(0)[0] > 2 * middle(0)[2] and middle(12)[2] > 2 * middle(12)[0]
