"""Writes a page in which clicks on photos become options: a known distance, and bodies."""

import base64
import io
import json
import tempfile
from pathlib import Path

from PIL import Image

from pipeline.inputs.photos import opened, pictures
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import check_writable, write_text
from sdfsim.base.parallel import Progress, silent

SIDE = 1280  # px, the longer side of a photo on the page
QUALITY = 82  # of JPEG: 48 photos of the bundled set are 5 MB
PAGE = Path(__file__).with_name("measure.html")
MARK = "__PHOTOS__"  # where the page has its photos


def measure(given: Path | str, out: Path | str, *, on_progress: Progress = silent) -> dict:
    """Write one HTML file that contains the photos (any input of `reconstruct`) and works offline.

    Two clicks in it give `--distance PLACE PLACE METRES`, one gives `--body NAME=PHOTO:X,Y`; pixels are those of the
    user's upright photo, not of the page. Returns `page`, `photos` and `mib`. Raises SdfsimError if `reconstruct` would
    refuse the photos, or if the page cannot be written.
    """
    given, out = Path(given), Path(out)
    if out.suffix.lower() not in (".html", ".htm"):
        raise SdfsimError(f"{out}: not the name of a page", "end it in .html")
    if out.is_dir():
        raise SdfsimError(f"{out}: is a folder", "choose another -o")
    check_writable(out.parent)
    photos = []
    with tempfile.TemporaryDirectory() as folder, opened(given, Path(folder)) as source:
        for name, picture, _, fraction in pictures(source):
            image = Image.fromarray(picture.pixels)
            image.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
            packed = io.BytesIO()
            image.save(packed, "JPEG", quality=QUALITY)
            width, height = picture.original
            data = "data:image/jpeg;base64," + base64.b64encode(packed.getvalue()).decode()
            photos.append({"name": name, "width": width, "height": height, "data": data})
            on_progress(fraction, f"{len(photos)} photos")
    # No file name can end the element that contains this.
    content = json.dumps({"given": str(given), "photos": photos}).replace("<", "\\u003c")
    out.parent.mkdir(parents=True, exist_ok=True)
    page = PAGE.read_text(encoding="utf-8").replace(MARK, content)
    write_text(out, page)
    return {"page": out, "photos": len(photos), "mib": round(len(page) / 2**20, 1)}
