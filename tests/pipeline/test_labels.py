"""Masks by object and label images: found, turned and straightened with their photos, refused where they are no use."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.inputs.labels import UNKNOWN, load_labels, load_names
from pipeline.inputs.photos import prepare_photos
from pipeline.inputs.sources import find_source
from sdfsim.base.errors import SdfsimError
from tests.helpers.photos import noise, write_transforms

NAMES = ["0.jpg", "1.jpg", "2.jpg"]


def mask(path: Path, columns: slice) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.zeros((90, 120), np.uint8)
    pixels[:, columns] = 255
    Image.fromarray(pixels).save(path)


def test_masks_by_object_become_labels_and_say_nothing_where_there_are_none(tmp_path):
    folder = noise(tmp_path / "in" / "images", NAMES)
    mask(tmp_path / "in" / "masks" / "cup" / "0.png", slice(0, 60))
    mask(tmp_path / "in" / "masks" / "vase" / "0.jpg.png", slice(50, 100))
    mask(tmp_path / "in" / "masks" / "vase" / "1.png", slice(50, 100))
    mask(tmp_path / "in" / "masks" / "vase" / "z.png", slice(50, 100))
    out = tmp_path / "out"
    out.mkdir()
    prepared, notes = prepare_photos(folder, out)
    assert load_names(out) == ["cup", "vase"]
    both, one = load_labels(out, "0000.jpg"), load_labels(out, "0001.jpg")
    assert both is not None and one is not None and load_labels(out, "0002.jpg") is None
    assert [both[5, x] for x in (10, 55, 80, 110)] == [1, UNKNOWN, 2, 0]
    assert [one[5, x] for x in (10, 80)] == [UNKNOWN, 2]  # the photo may show a cup that nobody marked
    assert [note.endswith("masks/vase belong to no photo (first: z.png)") for note in notes] == [True]
    assert not any(photo.mask for photo in prepared)
    assert tmp_path / "in" / "masks" / "cup" / "0.png" in find_source(folder).files()


@pytest.mark.parametrize("kind", ["palette", "8 bits", "16 bits"])
def test_label_images_keep_their_numbers_as_names(tmp_path, kind):
    folder = noise(tmp_path / "in", NAMES)
    values = np.zeros((90, 120), np.uint16 if kind == "16 bits" else np.uint8)
    values[:40], values[40:60] = 7, 1000 if kind == "16 bits" else 9
    image = Image.fromarray(values)
    if kind == "palette":
        image.putpalette(list(range(256)) * 3)
    (folder / "labels").mkdir()
    image.save(folder / "labels" / "1.png")
    prepare_photos(folder, tmp_path, long_side=60)
    assert load_names(tmp_path) == ["object7", "object1000" if kind == "16 bits" else "object9"]
    found = load_labels(tmp_path, "0001.jpg")
    assert found is not None and found.shape == (45, 60)
    assert [found[y, 3] for y in (5, 25, 40)] == [1, 2, 0] and set(np.unique(found)) == {0, 1, 2}


def test_labels_are_straightened_with_the_lens(tmp_path):
    """A grey photo that shows the labels themselves has them in the same places afterwards."""
    folder = noise(tmp_path / "in", NAMES)
    pixels = np.zeros((90, 120), np.uint8)
    pixels[20:70, 30:100] = 200
    Image.fromarray(pixels).convert("RGB").save(folder / "0.jpg", quality=98)
    (folder / "labels").mkdir()
    Image.fromarray(pixels).save(folder / "labels" / "0.png")
    prepare_photos(write_transforms(folder, NAMES, k1=0.2, k2=-0.05), tmp_path)
    found = load_labels(tmp_path, "0000.jpg")
    with Image.open(tmp_path / "images" / "0000.jpg") as image:
        shown = np.asarray(image.convert("L")) > 100
    assert found is not None and (found > 0).sum() > 1000
    assert ((found > 0) != shown).mean() < 0.02 and not np.array_equal(found > 0, pixels > 0)


@pytest.mark.parametrize(
    ("name", "file", "why"),
    [("cup", "z.png", "belong to no photo"), ("my cup", "0.png", "no body can have this name"),
     ("no", "0.png", "no body can have this name"), ("scene", "0.png", "no body can have this name")],
)  # fmt: skip
def test_masks_of_no_use_are_refused(tmp_path, name, file, why):
    folder = noise(tmp_path / "in", NAMES)
    mask(folder / "masks" / name / file, slice(0, 9))
    with pytest.raises(SdfsimError, match=why):
        find_source(folder)
