"""A dataset's shapes: decomposed, centred, split by name; and the refusals of `make_dataset`."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pybullet")

from sdfsim.base.errors import SdfsimError
from sdfsim.data import shape_assets
from sdfsim.data.pybullet_sim import Teacher, TeacherBody
from sdfsim.data.shape_assets import COLLISION, VISUAL, decompose, origins, prepare, split_of, wavefront
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, signed_volume
from sdfsim.geometry.mesh_io import write_ply

NAMES = [f"shape {k}" for k in range(2000)]


def ignore(fraction: float, message: str) -> None:
    """No progress to show."""


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """V-HACD by 30,000 voxels, which takes a moment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shape_assets, "VHACD_CALL", shape_assets.VHACD_CALL.replace("1000000", "30000"))
        yield


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A block that is far off its origin, and a sheet: where they come from, their engine files, what came of them."""
    folder = tmp_path_factory.mktemp("plain")
    block = primitives.box((2.0, 1.0, 0.5))
    block = replace(block, vertices=block.vertices + np.array([5.0, 0.0, 0.0]))
    (folder / "block").mkdir()
    for name in (VISUAL, COLLISION):
        (folder / "block" / name).write_text(wavefront([block]))
    (folder / "sheet.ply").write_bytes(write_ply(primitives.box((1.0, 1.0, 0.004))))
    found = origins(folder)
    return found, folder / "engine", *prepare(found, folder / "engine", ignore)


def test_splits_are_eight_one_and_one_tenths_and_depend_on_the_name_alone():
    counts = {split: [split_of(n) for n in NAMES].count(split) for split in ("train", "validation", "test")}
    assert sum(counts.values()) == len(NAMES)
    assert counts["train"] == pytest.approx(0.8 * len(NAMES), rel=0.05)
    assert counts["test"] == pytest.approx(0.1 * len(NAMES), rel=0.2)
    assert [split_of(n) for n in ("cube", "cylinder", "gear")] == ["train", "validation", "test"]


def test_an_angle_becomes_convex_pieces_of_nearly_its_volume_without_a_word(tmp_path, capfd):
    outline = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], dtype=np.float64)
    cap = np.array([[0, k, k + 1] for k in range(1, 5)])
    side = np.array([[k, (k + 1) % 6, (k + 1) % 6 + 6, k + 6] for k in range(6)])
    faces = np.concatenate([cap[:, ::-1], cap + 6, side[:, [0, 1, 2]], side[:, [0, 2, 3]]])
    angle = Mesh(np.concatenate([np.column_stack([outline, np.full(6, z)]) for z in (0.0, 1.0)]), faces)
    assert signed_volume(angle) == pytest.approx(3.0)
    pieces = decompose(angle, tmp_path / "angle")
    assert len(pieces) > 1
    assert sum(signed_volume(piece) for piece in pieces) == pytest.approx(3.0, rel=0.1)  # its hull has 3.5
    assert capfd.readouterr() == ("", "") and not list(tmp_path.iterdir())


def test_prepared_shapes_are_centred_of_unit_extent_and_kept_and_sheets_are_left_out(prepared):
    found, engine, sources, left_out = prepared
    assert [s.name for s in sources] == ["block"] and list(left_out) == ["sheet"]
    assert [origin.how for origin in found] == ["own", "vhacd"] and "thinner" in left_out["sheet"]
    (block,) = sources
    assert np.ptp(block.vertices, axis=0) == pytest.approx([1.0, 0.5, 0.25])
    assert block.vertices.min(0) == pytest.approx(-block.vertices.max(0))
    assert block.volume == pytest.approx(0.125)
    assert block.com == pytest.approx([5.0, 0.0, 0.0], abs=1e-6) and block.size == pytest.approx(2.0)
    before = block.pieces.stat().st_mtime_ns
    again, same = prepare(found, engine, ignore)
    assert same == left_out and again[0].pieces.stat().st_mtime_ns == before


def test_the_engine_collides_the_pieces_about_their_centre_of_mass(prepared):
    (block,) = prepared[2]
    with Teacher(np.array([0.0, 0.0, -10.0])) as teacher:
        teacher.add(TeacherBody(block.urdf, 1.0, 3.0, 0.5, 0.0), (0.0, 0.0, 2.0))
        motion = teacher.run(100)
        assert teacher.inertia(0) == pytest.approx([0.25 * 0.3125, 0.25 * 1.0625, 0.25 * 1.25], rel=0.05)
    assert motion["position"][-1, 0, 2] == pytest.approx(0.125, abs=0.01)


def test_random_solids_are_numbered_and_no_name_is_taken_twice(tmp_path):
    assert [o.name for o in origins(None, 3)] == ["solid_000", "solid_001", "solid_002"]
    assert all(o.pieces is not None and o.pieces.exists() for o in origins(None, 1000))
    for name in ("one.ply", "one.off"):
        (tmp_path / name).write_text("")
    with pytest.raises(SdfsimError, match="'one'"):
        origins(tmp_path)
