"""Shape folders: what is saved comes back, what is spoiled is told."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import replacing
from sdfsim.sdf.closed_forms import BoxSdf, PlaneSdf, SphereSdf
from sdfsim.shape import shape as shape_module
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import Shape, load_shape, scaled
from tests.helpers.shapes import fitted


def test_a_saved_shape_comes_back_bit_for_bit(tmp_path: Path) -> None:
    shape = fitted()
    shape.save(tmp_path / "deep" / "ring")
    back = load_shape(tmp_path / "deep" / "ring")
    assert sorted(p.name for p in (tmp_path / "deep" / "ring").iterdir()) == [
        "mesh.ply",
        "shape.json",
        "shape.safetensors",
    ]
    assert (back.name, back.volume, back.certificate, back.source) == (
        shape.name,
        shape.volume,
        shape.certificate,
        shape.source,
    )
    for key in ("nodes", "com", "inertia"):
        np.testing.assert_array_equal(getattr(back, key), getattr(shape, key))
    for key in ("vertices", "faces", "colors"):
        np.testing.assert_array_equal(getattr(back.mesh, key), getattr(shape.mesh, key))
    for piece, expected in zip(back.pieces, shape.pieces, strict=True):
        np.testing.assert_array_equal(piece, expected)
    np.testing.assert_array_equal(back.sdf.bounds, shape.sdf.bounds)
    points = torch.rand(50, 3, dtype=torch.float64) + torch.tensor([0.5, 1.5, 2.5])
    for one, other in zip(back.sdf(points), shape.sdf(points), strict=True):
        assert torch.equal(one, other)
    record = json.loads((tmp_path / "deep" / "ring" / "shape.json").read_text())
    assert record["units"] == "m"
    assert record["scale"] == 0.3


@pytest.mark.parametrize(
    "shape",
    [
        analytic_shape("plane"),
        analytic_shape("sphere", radius=0.2),
        analytic_shape("box", size=(1, 2, 3), name="crate"),
    ],
)
def test_analytic_shapes_have_folders_too(tmp_path: Path, shape: Shape) -> None:
    back = load_shape(shape.save(tmp_path / shape.name))
    assert type(back.sdf) is type(shape.sdf)
    points = np.random.default_rng(0).normal(size=(30, 3))
    np.testing.assert_array_equal(back.sdf(points)[0], shape.sdf(points)[0])
    np.testing.assert_array_equal(back.nodes, shape.nodes)
    np.testing.assert_array_equal(back.sdf.bounds, shape.sdf.bounds)


def test_a_failed_write_leaves_no_complete_looking_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted().save(tmp_path)

    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shape_module, "write_bytes", full)
    with pytest.raises(SdfsimError, match="No space left"):
        fitted().save(tmp_path)
    with pytest.raises(SdfsimError, match=r"shape\.json is missing"):
        load_shape(tmp_path)


def test_analytic_mass_properties_and_nodes() -> None:
    ball = analytic_shape("sphere", radius=0.4)
    assert ball.volume == pytest.approx(4 / 3 * np.pi * 0.064)
    np.testing.assert_allclose(ball.inertia, 0.4 * ball.volume * 0.16 * np.eye(3))
    assert ball.nodes.shape == (128, 3)
    np.testing.assert_allclose(np.linalg.norm(ball.nodes, axis=1), 0.4)
    np.testing.assert_allclose(ball.nodes.mean(0), 0, atol=2e-3)
    crate = analytic_shape("box", size=(0.2, 0.4, 1.0))
    assert crate.volume == pytest.approx(0.08)
    np.testing.assert_allclose(crate.inertia, 0.08 / 12 * np.diag([1.16, 1.04, 0.2]))
    assert len(crate.nodes) == 98
    assert isinstance(crate.sdf, BoxSdf)
    np.testing.assert_allclose(crate.sdf(crate.nodes)[0], 0, atol=1e-15)
    np.testing.assert_allclose(np.abs(crate.nodes[:8]), np.tile([0.1, 0.2, 0.5], (8, 1)))
    floor = analytic_shape("plane", name="floor")
    assert isinstance(floor.sdf, PlaneSdf)
    assert floor.nodes.shape == (0, 3)
    assert floor.name == "floor"


def test_scaling_scales_everything() -> None:
    small, large = analytic_shape("sphere", radius=0.1), scaled(analytic_shape("sphere", radius=0.1), 3.0)
    assert isinstance(large.sdf, SphereSdf)
    expected = analytic_shape("sphere", radius=0.3)
    assert large.volume == pytest.approx(expected.volume)
    np.testing.assert_allclose(large.inertia, expected.inertia)
    np.testing.assert_allclose(large.nodes, expected.nodes)
    assert scaled(small, 1.0) is small
    shape = fitted()
    twice = scaled(shape, 2.0)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.1 + [1, 2, 3]
    np.testing.assert_allclose(twice.sdf(2 * points)[0], 2 * shape.sdf(points)[0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(twice.sdf.bounds, 2 * shape.sdf.bounds)
    np.testing.assert_array_equal(twice.pieces[2], 2 * shape.pieces[2])
    with pytest.raises(SdfsimError, match="> 0"):
        scaled(shape, 0.0)


@pytest.mark.parametrize("layers", [0, -1, 1, 2, 4, 10**30, "3.5", None, [3], True])
def test_layers_that_are_not_there_are_reported(tmp_path: Path, layers) -> None:
    folder = fitted().save(tmp_path / "shape")
    record = json.loads((folder / "shape.json").read_text())
    record["sdf"]["layers"] = layers
    (folder / "shape.json").write_text(json.dumps(record))
    with pytest.raises(SdfsimError, match="shape: not a valid shape folder"):
        load_shape(folder)


@pytest.mark.parametrize("key", ["name", "sdf", "volume", "com", "inertia", "certificate", "source", "pieces"])
@pytest.mark.parametrize("value", [None, [], {}, 0, -1, "x", [[]], {"kind": []}, True])
def test_whatever_a_record_holds_is_read_or_reported(tmp_path: Path, key: str, value) -> None:
    folder = fitted().save(tmp_path / "shape")
    record = json.loads((folder / "shape.json").read_text()) | {key: value}
    (folder / "shape.json").write_text(json.dumps(record))
    try:
        load_shape(folder)
    except SdfsimError as error:
        assert "not a valid shape folder" in error.message


def test_threads_that_write_one_file_leave_it_whole(tmp_path: Path) -> None:
    """Each writes another content again and again; whoever reads finds one of them, and nothing else is left."""
    file = tmp_path / "file"

    def write(letter: str) -> None:
        for _ in range(50):
            with replacing(file) as partial:
                with partial.open("w") as handle:
                    for _ in range(20):
                        handle.write(letter * 50)
                        handle.flush()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, "abcdefgh"))
    content = file.read_text()
    assert len(content) == 1000 and len(set(content)) == 1 and list(tmp_path.iterdir()) == [file]
