"""What the report says of hollow bodies: depth, floor and wall, and whether photos see them, by rays."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest

from pipeline.mesh.hollows import Hollow, hollow, hollow_line
from pipeline.mesh.trust import Evidence, evidence_of
from pipeline.mesh.visibility import Visibility
from sdfsim.geometry.mesh import Mesh
from tests.helpers.balls import ring
from tests.pipeline import photo_sets


def turned(profile: Sequence[tuple[float, float]]) -> Mesh:
    """A solid of revolution with vertices every few millimetres along its profile."""
    corners = np.array(profile, float)
    line = [corners[:1]]
    for start, end in pairwise(corners):
        count = max(1, int(np.linalg.norm(end - start) / 0.008))
        line.append(start + (end - start) * np.arange(1, count + 1)[:, None] / count)
    return Mesh(*photo_sets.studio().lathe(np.concatenate(line)))


CUP = turned([(0, 0), (0.08, 0), (0.08, 0.16), (0.062, 0.16), (0.062, 0.03), (0, 0.03)])
FILLED = turned([(0, 0), (0.08, 0), (0.08, 0.16), (0.062, 0.16), (0.062, 0.12), (0, 0.12)])


def seen(mesh: Mesh, elevation: float, count: int = 12) -> Evidence:
    views = ring(count, 1.0, elevation, 640, 480, 1500.0, (0, 0, 0.1))
    return evidence_of(Visibility(mesh, 1e-3), views)


def told(mesh: Mesh, *evidence: Evidence) -> tuple[Hollow, str]:
    found = hollow(mesh, 0.01, *evidence)
    assert found is not None
    return found, hollow_line("cup", found)


def test_a_cup_is_as_deep_and_as_thick_as_it_is():
    found, line = told(CUP, seen(CUP, 75))
    assert (found.depth, found.below) == (pytest.approx(0.13, abs=1e-3), pytest.approx(0.03, abs=1e-3))
    assert found.wall == pytest.approx(0.018, rel=0.02)
    start = "cup: hollow, 0.13 m deep below its rim, on a floor 0.03 m thick; "
    assert line.startswith(f"{start}{found.seen} photos see its bottom")


def test_whether_photos_see_the_bottom_is_a_matter_of_rays():
    """The opening is 0.124 m wide and the bottom 0.13 m below it: its middle is in sight from 64.5 degrees up."""
    assert told(CUP, seen(CUP, 72))[0].seen >= 6
    low, line = told(CUP, seen(CUP, 40))
    assert low.seen == 0 and "; no photo sees its bottom" in line
    assert told(CUP)[0].seen == 0


def test_what_is_below_a_shallow_hollow_is_solid_only_if_photos_see_its_bottom():
    steep, line = told(FILLED, seen(FILLED, 70))
    assert steep.depth == pytest.approx(0.04, abs=1e-3) and steep.seen >= 3
    assert "hollow to 0.04 m below its rim; " in line and "the 0.12 m below that are solid" in line
    flat, line = told(FILLED, seen(FILLED, 15))
    assert flat.seen == 0
    assert "0.04 m below its rim or deeper; no photo sees its bottom, the 0.12 m below are a guess" in line


def test_a_wall_is_as_thick_as_it_is_only_where_photos_see_both_its_sides():
    both = np.concatenate([seen(CUP, 60).views[None], seen(CUP, 15).views[None]]).sum(0)
    evidence = seen(CUP, 60)
    together = Evidence(evidence.vertices, evidence.normals, both, evidence.information)
    found, line = told(CUP, together)
    assert found.wall_seen > 0.5 and line.endswith("; its wall is 18 mm thick")
    found, line = told(CUP, seen(CUP, 10))
    assert found.wall_seen < 0.1 and "the thickness of its wall is unknown" in line


def test_what_holds_no_water_is_not_hollow():
    assert hollow(FILLED, 0.05) is None
    assert hollow(Mesh(*photo_sets.ring((0, 0, 0.05), 0.1, 0.04)), 0.01) is None


def test_a_small_hole_in_a_thin_floor_does_not_hide_the_hollow():
    """As where a field lost the floor of a vase: 32 mm of a bottom of 124 mm. A tube, open below, holds no water."""
    import trimesh

    near = np.linalg.norm(CUP.vertices[:, :2], axis=1)[CUP.faces].max(1) < 0.018
    found, line = told(Mesh(CUP.vertices, CUP.faces[~(near & (CUP.vertices[CUP.faces][..., 2].max(1) < 0.031))]))
    assert found.depth == pytest.approx(0.13, abs=1e-3)
    assert found.holes == pytest.approx((16 / 62) ** 2, abs=0.015) and "% of its floor was not found" in line
    assert told(CUP)[0].holes == 0 and "hole" not in told(CUP)[1]
    tube = trimesh.creation.annulus(r_min=0.05, r_max=0.08, height=0.16)
    assert hollow(Mesh(np.asarray(tube.vertices), np.asarray(tube.faces, np.int64)), 0.01) is None
