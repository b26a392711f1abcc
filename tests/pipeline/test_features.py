"""Features of photos, and the largest of them, as COLMAP reads them back."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import KDTree

from pipeline.sfm.poses import ORDINARY
from pipeline.sfm.worker import features

WIDE, HIGH = 320, 240


def found_in(folder: Path, most: int, **settings) -> list[tuple[np.ndarray, np.ndarray]]:
    """Keypoints [F, 4] and descriptors [F, 128] of the photos 0.jpg and 1.jpg of a folder."""
    import pycolmap

    group = {"width": WIDE, "height": HIGH, "focal": None, "names": ["0.jpg", "1.jpg"]}
    job = {**ORDINARY, "images": str(folder), "groups": [group], "masks": "", "features": most, **settings}
    database = folder / f"{most}.db"
    for _ in range(2):  # the second time as a resumed run
        features(pycolmap, job, database)
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        return [(opened.read_keypoints(i.image_id), opened.read_descriptors(i.image_id).data) for i in images]


def noise(coarse: int) -> Image.Image:
    """A picture of smooth noise of so many cells a side."""
    cells = np.random.default_rng(0).integers(0, 255, (coarse, coarse), np.uint8)
    return Image.fromarray(cells).resize((WIDE, HIGH), Image.Resampling.BICUBIC)


def test_no_more_than_the_largest_features_are_kept(tmp_path):
    noise(24).save(tmp_path / "0.jpg")
    noise(2).save(tmp_path / "1.jpg")  # has few features
    every, some = found_in(tmp_path, 10**6), found_in(tmp_path, 90)
    assert len(every[0][0]) > 150 and len(every[1][0]) < 90
    scale = every[0][0][:, 2]
    assert scale[:90].min() >= scale[90:].max()
    for few, all_, count in ((some[0], every[0], 90), (some[1], every[1], 90)):
        for values, wanted in zip(few, all_, strict=True):
            np.testing.assert_array_equal(values, wanted[:count])


def test_features_of_a_larger_and_turned_picture_are_at_the_same_places(tmp_path):
    """The truth is the warp; a shift of half a pixel, in either picture's scale, would show."""
    turn, middle = np.radians(30), np.array([WIDE, HIGH]) / 2
    warp = 1.7 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    picture = noise(40)
    inverse = np.linalg.inv(warp)
    shift = middle - inverse @ middle
    picture.save(tmp_path / "0.jpg", quality=95)
    coefficients = (*inverse[0], shift[0], *inverse[1], shift[1])
    turned = picture.transform(picture.size, Image.Transform.AFFINE, coefficients, Image.Resampling.BICUBIC)
    turned.save(tmp_path / "1.jpg", quality=95)
    (first, words), (second, others) = found_in(tmp_path, 10**6, pixels=WIDE * 3 // 4)
    distance, nearest = KDTree(others.astype(float)).query(words.astype(float), k=2)
    clear = distance[:, 0] < 0.7 * distance[:, 1]
    there = (first[clear][:, :2] - middle) @ warp.T + middle
    off = second[nearest[clear, 0], :2] - there
    close = np.linalg.norm(off, axis=1) < 3
    assert clear.sum() > 30 and close.mean() > 0.8
    assert np.abs(np.median(off[close], axis=0)).max() < 0.15
    assert np.median(np.linalg.norm(off[close], axis=1)) < 0.6


def test_no_feature_lies_outside_a_mask(tmp_path):
    (tmp_path / "masks").mkdir()
    for number in (0, 1):
        noise(40).save(tmp_path / f"{number}.jpg")
        shown = np.zeros((HIGH, WIDE), np.uint8)
        shown[:, WIDE // 2 :] = 255 * number
        Image.fromarray(shown).save(tmp_path / "masks" / f"{number}.jpg.png")
    (none, _), (half, words) = found_in(tmp_path, 10**6, masks=str(tmp_path / "masks"))
    assert len(none) == 0 and len(half) == len(words) > 30
    assert half[:, 0].min() > WIDE / 2 - 1


def test_a_run_that_was_killed_between_places_and_descriptors_goes_on(tmp_path):
    for number in (0, 1):
        noise(24 + number).save(tmp_path / f"{number}.jpg")
    whole = found_in(tmp_path, 90)
    with closing(sqlite3.connect(tmp_path / "90.db")) as opened:
        opened.execute("DELETE FROM descriptors WHERE image_id = 2")
        opened.commit()
    for values, wanted in zip(found_in(tmp_path, 90), whole, strict=True):
        for one, other in zip(values, wanted, strict=True):
            np.testing.assert_array_equal(one, other)
