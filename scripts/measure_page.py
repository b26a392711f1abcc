"""Clicks in the page from `sdfsim measure`, and takes its picture for docs/vfx.md. It needs Chromium.

python scripts/measure_page.py
"""

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.measure import measure
from sdfsim.base.files import write_bytes
from tests.helpers.browser import Browser

ROOT = Path(__file__).resolve().parents[1]
PHOTOS = Path("samples/photos/table_vase/images")  # as in the page's command
PHOTO, WIDE = "026.jpg", 640  # px
# Two corners of the table, and the vase; px of the photo.
ENDS, BODY = ((50, 200), (428, 370)), (322, 165)


def main() -> None:
    """Writes docs/images/measure.jpg."""
    with tempfile.TemporaryDirectory() as folder:
        page = measure(ROOT / PHOTOS, Path(folder) / "measure.html")["page"]
        text = page.read_text(encoding="utf-8").replace(str(ROOT / PHOTOS), str(PHOTOS))
        page.write_text(text, encoding="utf-8")
        with Browser(Path(folder) / "profile") as browser:
            browser.open(page.as_uri())

            def at(x: float, y: float) -> tuple[float, float]:
                box = "document.getElementById('photo').getBoundingClientRect()"
                left, top, wide = browser.value(f"(b => [b.left, b.top, b.width])({box})")
                return left + (x + 0.95) * wide / WIDE, top + (y + 0.95) * wide / WIDE  # whole px of the window

            browser.value(
                f"[...document.querySelectorAll('#list button')].find(b => b.textContent.includes('{PHOTO}')).click()"
            )
            browser.wait("document.getElementById('photo').complete")
            browser.value("document.getElementById('list').querySelector('.now').scrollIntoView()")
            browser.value(
                "document.getElementById('metres').value = 1.2; document.getElementById('name').value = 'vase'"
            )
            browser.click(*at(*ENDS[0]))
            browser.value("document.getElementById('body').click()")
            browser.click(*at(*BODY))
            browser.value("document.getElementById('distance').click()")
            browser.click(*at(*ENDS[1]))
            browser.move(*at(*ENDS[1]))  # the lens disappears after a click
            browser.value("document.querySelector('#list .now').scrollIntoView()")
            told = browser.value("document.getElementById('option').textContent")
            picture = Image.open(browser.picture(Path(folder) / "page.png")).convert("RGB")
    packed = io.BytesIO()
    picture.save(packed, "JPEG", quality=85)
    write_bytes(ROOT / "docs" / "images" / "measure.jpg", packed.getvalue())
    print(told)


if __name__ == "__main__":
    main()
