"""Features of photos, and the largest of them, as COLMAP reads them back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.sfm.poses import ORDINARY
from pipeline.sfm.worker import features


def found_in(folder: Path, largest: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Keypoints and descriptors of the photos in a folder."""
    import pycolmap

    group = {"width": 320, "height": 240, "focal": None, "names": ["0.jpg", "1.jpg"]}
    job = {**ORDINARY, "images": str(folder), "groups": [group], "masks": "", "max_features": 200, "largest": largest}
    database = folder / f"{largest}.db"
    for _ in range(2):  # the second time as a resumed run
        features(pycolmap, job, database)
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        return [(opened.read_keypoints(i.image_id), opened.read_descriptors(i.image_id).data) for i in images]


def test_no_more_than_the_largest_features_are_kept(tmp_path):
    rng = np.random.default_rng(0)
    for number, coarse in enumerate((24, 2)):  # the second has few features
        small = Image.fromarray(rng.integers(0, 255, (coarse, coarse), np.uint8))
        small.resize((320, 240), Image.Resampling.BICUBIC).save(tmp_path / f"{number}.jpg")
    every, some = found_in(tmp_path, 0), found_in(tmp_path, 90)
    assert len(every[0][0]) > 150 and len(every[1][0]) < 90
    area = np.abs(np.linalg.det(every[0][0][:, 2:].reshape(-1, 2, 2).astype(float)))
    kept = np.sort(np.argsort(-area, kind="stable")[:90])
    for values, wanted in zip(some[0], every[0], strict=True):
        np.testing.assert_array_equal(values, wanted[kept])
    for values, wanted in zip(some[1], every[1], strict=True):
        np.testing.assert_array_equal(values, wanted)
