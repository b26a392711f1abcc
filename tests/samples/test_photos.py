"""What samples/photos/make.py draws is solid."""

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.reconstruct import PHOTOS, drawn

sys.path.insert(0, str(Path(__file__).parents[2] / "samples" / "photos"))
import make


@pytest.mark.parametrize("part", [make.leaves, make.cloth])
def test_leaves_and_cloth_are_closed_and_face_outwards(part):
    import trimesh

    mesh = trimesh.Trimesh(part().vertices, part().faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert all(piece.volume > 0 for piece in mesh.split())


@pytest.mark.parametrize("name", make.TURNED)
def test_what_is_turned_is_closed_and_has_the_volume_of_its_profile(name):
    """Pappus: between two rings the radius goes evenly, so the mean of its square is (a^2 + ab + b^2) / 3."""
    import trimesh

    (outer, inner), _, segments = make.TURNED[name]
    mesh = trimesh.Trimesh(*make.turned_solid(outer, inner, segments), process=False)
    line = np.vstack([make.smooth_profile(outer, 500), make.smooth_profile(inner, 500)])
    (a, b), rise = (line[:-1, 0], line[1:, 0]), np.diff(line[:, 1])
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.pi * ((a**2 + a * b + b**2) / 3 * rise).sum(), rel=0.01)


def test_names_of_sets_are_folders_and_other_folders_stay(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(make, "make_set", lambda name, folder: made.append((name, folder)))
    other = next(name for name in make.SETS if name != make.BUNDLED)
    assert drawn(Path(make.BUNDLED), tmp_path / "run") == PHOTOS and not made
    assert drawn(Path(other), tmp_path / "run") == tmp_path / f"run-{other}"
    assert made == [(other, tmp_path / f"run-{other}")]
    assert drawn(tmp_path, tmp_path / "run") == tmp_path and len(made) == 1
