"""A dataset's shapes: decomposed, centred, split by name; and the refusals of `make_dataset`."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pybullet")

from sdfsim.data import generate, shape_assets
from sdfsim.data.generate import make_dataset
from sdfsim.data.pybullet_sim import Teacher, TeacherBody
from sdfsim.data.shape_assets import COLLISION, VISUAL, decompose, origins, prepare, split_of, wavefront
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.engines import dataset_urdf
from sdfsim.files import locked
from sdfsim.shape import primitives
from sdfsim.shape.mesh import Mesh, signed_volume, write_ply
from tests.recordings import CUBE

NAMES = [f"shape {k}" for k in range(2000)]


def ignore(fraction: float, message: str) -> None:
    """No progress to show."""


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


def test_an_angle_becomes_convex_pieces_of_nearly_its_volume_without_a_word(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(shape_assets, "VHACD_CALL", shape_assets.VHACD_CALL.replace("1000000", "30000"))
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


def test_engine_files_can_be_moved(tmp_path, monkeypatch):
    """In whatever folder the engine works, and whatever lies there."""
    (tmp_path / "block").mkdir()
    for name in (VISUAL, COLLISION):
        (tmp_path / "block" / name).write_text(wavefront([primitives.box((1.0, 1.0, 1.0))]))
    engine = tmp_path / "first" / "shapes" / "engine"
    prepare(origins(tmp_path), engine / "own", ignore)
    prepare(origins(tmp_path, as_is=True), engine / "kubric", ignore)
    shutil.rmtree(tmp_path / "block")
    (tmp_path / "first").rename(tmp_path / "second")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "block.obj").write_text(wavefront([primitives.box((4.0, 4.0, 4.0))]))
    for kind in ("own", "kubric"):
        for start in (Path(), tmp_path):
            urdf = start / "second" / "shapes" / "engine" / kind / "block.urdf"
            assert dataset_urdf(tmp_path / "second", f"{kind}/block").samefile(urdf)
            with Teacher(np.array([0.0, 0.0, -10.0])) as teacher:
                teacher.add(TeacherBody(urdf, 1.0, 6.0, 0.5, 0.0), (0.0, 0.0, 2.0))
                assert teacher.inertia(0) == pytest.approx([1.0, 1.0, 1.0], rel=0.1)


def test_random_solids_are_numbered_and_no_name_is_taken_twice(tmp_path):
    assert [o.name for o in origins(None, 3)] == ["solid_000", "solid_001", "solid_002"]
    assert all(o.pieces is not None and o.pieces.exists() for o in origins(None, 1000))
    for name in ("one.ply", "one.off"):
        (tmp_path / name).write_text("")
    with pytest.raises(SdfsimError, match="two shapes are called 'one'"):
        origins(tmp_path)


def test_names_that_no_dataset_could_hold_are_refused_before_anything_is_made(tmp_path):
    (tmp_path / "cup (1).obj").write_text(CUBE)
    with pytest.raises(SdfsimError, match=r"'cup \(1\)' is no name of a Shape folder"):
        make_dataset("movi-c", tmp_path / "data", shapes=tmp_path, trajectories=1)
    assert not (tmp_path / "data").exists()
    for name in (VISUAL, COLLISION):
        (tmp_path / "a+b").mkdir(exist_ok=True)
        (tmp_path / "a+b" / name).write_text(CUBE)
    with pytest.raises(SdfsimError, match=r"'a\+b' is no name"):
        make_dataset("movi-b", tmp_path / "data", shapes=tmp_path, trajectories=1)


@pytest.mark.parametrize("recipe", ["movi-b", "pile"])
def test_another_shape_of_the_same_name_leaves_a_dataset_as_it_is(tmp_path, monkeypatch, recipe):
    """What its recordings were made with is never written over."""
    monkeypatch.setattr(generate, "fit_shapes", lambda *_: None)
    monkeypatch.setattr(generate, "_make_one", lambda *a: a[-1].write_text(""))
    monkeypatch.setattr(generate, "parallel", lambda work, jobs: ((k, work(*job)) for k, job in enumerate(jobs)))
    for name, mesh in (("first", primitives.box((1.0, 1.0, 1.0))), ("second", primitives.box((1.0, 1.0, 0.7)))):
        (tmp_path / name / "block").mkdir(parents=True)
        for file in (VISUAL, COLLISION):
            (tmp_path / name / "block" / file).write_text(wavefront([mesh]))
    out = tmp_path / "data"
    make_dataset(recipe, out, shapes=tmp_path / "first", trajectories=1)
    engine = out / "shapes" / "engine" / "block.obj"
    before = engine.read_bytes()
    with pytest.raises(SdfsimError, match="a dataset with another made_from"):
        make_dataset(recipe, out, shapes=tmp_path / "second", trajectories=2)
    assert engine.read_bytes() == before
    with locked(out), pytest.raises(SdfsimError, match="another run"):
        make_dataset(recipe, out, shapes=tmp_path / "first", trajectories=2)
    assert make_dataset(recipe, out, shapes=tmp_path / "first", trajectories=2)["made_now"] == 1


@pytest.mark.parametrize(
    ("recipe", "options", "complaint"),
    [
        ("movi-z", {}, "unknown recipe"),
        ("movi-b", {}, "movi-b needs shapes"),
        ("movi-c", {"fps": 30}, "--fps must be 50 or 60"),
        ("movi-c", {"random_solids": 3, "bodies": 5}, "--bodies goes with bowl and pile"),
        ("pile", {"random_solids": 3, "bodies": 513}, "is 1 to 512"),
        ("bowl", {"random_solids": 3}, "no use for --random-solids"),
        ("varied", {"random_solids": 1001}, "0 to 1000"),
    ],
)
def test_what_a_recipe_has_no_use_for_is_refused(tmp_path, recipe, options, complaint):
    with pytest.raises(SdfsimError) as error:
        make_dataset(recipe, tmp_path / "out", trajectories=1, **options)
    assert complaint in error.value.message and not (tmp_path / "out").exists()


def test_a_split_without_shapes_and_a_folder_without_any_are_refused(cube_meshes, tmp_path):
    with pytest.raises(SdfsimError, match="none of the 1 shapes belongs to the test split"):
        make_dataset("movi-c", tmp_path / "out", trajectories=1, shapes=cube_meshes, split="test")
    with pytest.raises(SdfsimError, match="no shapes found"):
        make_dataset("movi-c", tmp_path / "out", trajectories=1, shapes=tmp_path)
    with pytest.raises(SdfsimError, match="no shapes found"):
        make_dataset("movi-b", tmp_path / "out", trajectories=1, shapes=tmp_path)
