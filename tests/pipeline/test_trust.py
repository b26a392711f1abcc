"""How far a surface and its hollows can be trusted, against closed forms and renderings whose answer is known."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh  # noqa: TID253

from pipeline.cameras import View
from pipeline.mesh.hollows import Hollow, hollow, hollow_line
from pipeline.mesh.trust import Evidence, evidence_of, information, next_photos, sigma_along, summary
from pipeline.mesh.visibility import Visibility
from pipeline.options import Options
from pipeline.records import Proposal
from pipeline.report import improvements, notes
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, joined
from sdfsim.geometry.mesh_io import read_attributes, write_ply
from tests.helpers.balls import ring
from tests.helpers.surfaces import cube, look_at, plate
from tests.pipeline import photo_sets
from tests.pipeline.photo_sets import orbit, still_life, studio

FLIP = np.diag([1.0, -1, -1])  # OpenGL camera axes to ours


def pair(baseline: float, away: float) -> list[View]:
    """Two cameras side by side, both looking straight down from a height."""
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    eyes = [np.array([x, 0, away]) for x in (-baseline / 2, baseline / 2)]
    return [replace(look_at(np.array([0.0, -1, 1])), rotation=down, translation=-down @ eye) for eye in eyes]


@pytest.mark.parametrize(("baseline", "away"), [(0.2, 2.0), (1.0, 3.0)])
def test_two_cameras_tell_depth_as_the_stereo_formula_says(baseline, away):
    """Depth = focal * baseline / disparity, and the disparity is off by the square root of two pixels."""
    views = pair(baseline, away)
    point, up, side = np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.array([[0.0, 1, 0]])
    total = information(views[0], point) + information(views[1], point)
    focal = views[0].focal
    assert sigma_along(total, up)[0] == pytest.approx(np.sqrt(2) * away**2 / (focal * baseline), rel=1e-9)
    # Across both lines of sight there are two measurements of one pixel each.
    assert sigma_along(total, side)[0] == pytest.approx(away / focal / np.sqrt(2), rel=1e-9)


def test_what_is_behind_something_is_guessed():
    floor = plate(20)
    wall = plate(4, z=0.5, half=0.2)
    views = [view for shift in (-0.2, 0.2) for view in pair(0.1 + abs(shift), 3.0)]
    found = evidence_of(Visibility(floor, 1e-3, Caster(joined([floor, wall]))), views)
    under = np.abs(floor.vertices[:, :2]).max(1) < 0.15
    beside = np.abs(floor.vertices[:, :2]).min(1) > 0.35
    assert np.isinf(found.uncertainty[under]).all() and (found.views[under] == 0).all()
    assert np.isfinite(found.uncertainty[beside]).all() and (found.views[beside] == 4).all()
    told = summary(floor, found)
    assert told.guessed == pytest.approx(0.2, abs=0.06)  # The wall's shadow is 0.48 m wide, and seen from two sides.
    assert sum(told.seen_by) == pytest.approx(1, abs=1e-3)


def test_the_guessed_part_of_a_body_is_reported():
    block = cube(0.4, (0, 0, 0.2))
    views = [look_at(np.array([2 * np.cos(a), 2 * np.sin(a), 1.2])) for a in np.arange(8) * np.pi / 4]
    found = evidence_of(Visibility(block, 1e-3, Caster(joined([block, plate(4)]))), views)
    told = summary(block, found)
    # A sixth, and a half of the lowest triangles around it.
    assert told.guessed == pytest.approx(1 / 6 + 1 / 24, abs=0.005)
    report = {"trust": {"scenery": told, "object1": told}, "weak": 0.0, "next_photos": []}
    lines = " / ".join(notes({"mesh": report}))
    assert "object1: 21% of its surface is guessed, fewer than two photos see it" in lines


def test_attributes_survive_and_other_programs_read_the_mesh(tmp_path):
    block = cube(0.4)
    block = replace(block, colors=np.full(block.vertices.shape, 90, np.uint8))
    sure = np.where(np.arange(len(block.vertices)) == 3, np.inf, 0.001).astype(np.float32)
    views, path = np.arange(len(sure), dtype=np.int32), tmp_path / "block.ply"
    path.write_bytes(write_ply(block, {"views": views, "uncertainty": sure}))
    found = read_attributes(path, ["views", "uncertainty"])
    assert np.array_equal(found[0], views) and np.array_equal(found[1], sure)
    theirs: Any = trimesh.load(path, force="mesh", process=False)
    np.testing.assert_array_equal(theirs.vertices, block.vertices)
    with pytest.raises(SdfsimError, match="without weight"):
        read_attributes(path, ["weight"])


class Photographed:
    """The box on a floor within four walls of `photo_sets`, as photos from some poses show it."""

    def __init__(self, poses: list[np.ndarray]) -> None:
        make = studio()
        # The walls are sheets that photos show from one side; here the box and its floor are enough.
        parts = still_life(make, 1)
        box = Mesh(np.asarray(parts[0].vertices, float), np.asarray(parts[0].faces, np.int64))
        self.box = finer(box)
        ground = trimesh.creation.box((3.0, 3.0, 0.1)).apply_translation((0, 0, -0.05))
        self.meshes = {"scene": finer(Mesh(np.asarray(ground.vertices), np.asarray(ground.faces))), "box": self.box}
        whole = joined(list(self.meshes.values()))
        self.caster, self.sight = Caster(whole), Visibility(whole, 2e-3, None)
        self.views = [view_of(make, pose, number) for number, pose in enumerate(poses)]
        self.vertices = whole.vertices

    def evidence(self, more: list[View] | None = None) -> Evidence:
        return evidence_of(self.sight, [*self.views, *(more or [])])

    def advice(self) -> tuple[list[Proposal], list[View], float]:
        counted = self.vertices[:, 2] > -1e-3
        return next_photos(self.meshes, self.evidence(), self.sight, self.caster, self.views, counted)

    def unseen(self, more: list[View] | None = None) -> float:
        """Share of the box's vertices above the floor that fewer than two photos see."""
        own = slice(len(self.vertices) - len(self.box.vertices), None)
        above = self.vertices[own, 2] > 0.01
        return float((self.evidence(more).views[own][above] < 2).mean())


def finer(mesh: Mesh) -> Mesh:
    """The mesh in triangles of 7 cm at most."""
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, 0.07)[:2]
    made = trimesh.Trimesh(vertices, faces, process=True)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces, np.int64))


def view_of(make, pose: np.ndarray, number: int) -> View:
    rotation = FLIP @ pose[:3, :3].T
    name = f"{number:03d}.jpg"
    return View(name, name, make.WIDTH, make.HEIGHT, make.FOCAL, make.WIDTH / 2, make.HEIGHT / 2, 0.0, rotation,
                -rotation @ pose[:3, 3])  # fmt: skip


def test_photos_of_one_half_ask_for_the_other_half():
    """Photos from the side of +y alone: the proposals stand at -y, and with them little of the box is left unseen."""
    set_up = Photographed(orbit(12, span=180.0))
    photos, views, weak = set_up.advice()
    assert len(photos) == 3 and weak > 0.05
    places = np.array([view.center for view in views])
    assert (places[:, 1] < -0.3).all() and (places[:, 2] > 0.05).all()
    gains = [photo.gain for photo in photos]
    assert gains == sorted(gains, reverse=True) and 0.5 < sum(gains) <= 1
    before, after = set_up.unseen(), set_up.unseen(views)
    assert before > 0.2 and after < 0.5 * before
    for photo, view in zip(photos, views, strict=True):
        assert "stand where 0" in photo.words and "around the scene to your" in photo.words
        assert "looking at " in photo.words
        # The camera does look there.
        pixels, depth = view.project(np.array([photo.looking_at]))
        np.testing.assert_allclose(pixels[0], [view.cx, view.cy], atol=1e-6)
        assert depth[0] > 0
    text = " / ".join(improvements({
        "poses": {}, "photos": [], "psnr": None, "failed_checks": [],
        "stages": {"mesh": {"next_photos": photos}},
    }, Options()))  # fmt: skip
    assert photos[0].words in text and f"{places[0][0]:.2f}" in text


def test_where_all_is_photographed_nothing_is_asked_for():
    set_up = Photographed(orbit(36))
    photos, _, weak = set_up.advice()
    assert photos == []
    told = notes({"mesh": {"trust": {}, "weak": weak, "next_photos": []}})
    assert any("no single photo would help much" in line for line in told)


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
