"""The page for clicks: what it holds, and what it refuses. `tests/gates/test_browser.py` clicks in it."""

import io
import json
import re
from base64 import b64decode

import numpy as np
import pytest
from PIL import Image

from pipeline.inputs.photos import prepare_photos
from pipeline.measure import SIDE, measure
from sdfsim import SdfsimError
from tests.helpers.command import run


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, size in {"a.jpg": (2600, 1300), "<script>.jpg": (300, 200), "c.png": (640, 480)}.items():
        Image.fromarray(np.full((size[1], size[0], 3), 90, np.uint8)).save(folder / name)
    return folder


def content(page) -> dict:
    found = re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    return json.loads(found[1]) if found else {}


def test_the_page_has_every_photo_by_its_name_and_whole_size(photos, tmp_path):
    report = measure(photos, tmp_path / "new" / "page.html")
    known, _ = prepare_photos(photos, tmp_path / "prepared")
    found = content(report["page"])["photos"]
    assert [(p["name"], (p["width"], p["height"])) for p in found] == [(p.source, p.original) for p in known]
    for photo in found:
        shown = Image.open(io.BytesIO(b64decode(photo["data"].partition(",")[2])))
        assert max(shown.size) == min(SIDE, max(photo["width"], photo["height"]))
        assert shown.width / shown.height == pytest.approx(photo["width"] / photo["height"], rel=0.01)
    text = report["page"].read_text(encoding="utf-8")
    assert text.count("<script") == 2  # no name of a file is markup
    assert not re.search(r"(?:src|href)=[\"']?https?:|url\(https?:|fetch\(", text)  # needs no network


def test_what_it_refuses(photos, tmp_path):
    for out, told in (("page.txt", "end it in .html"), ("photos/deep", "end it in .html")):
        with pytest.raises(SdfsimError) as caught:
            measure(photos, tmp_path / out)
        assert caught.value.hint == told
    done = run("measure", tmp_path / "nothing", "-o", tmp_path / "page.html")
    assert done.exit_code == 1 and "no such folder" in done.stderr and not (tmp_path / "page.html").exists()
    done = run("measure", photos, "-o", tmp_path / "page.html", "--json")
    assert json.loads(done.stdout)["photos"] == 3
