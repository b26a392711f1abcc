"""A mesh is fitted once, and the cache never stands in the way."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sdfsim import load_scene
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.sdf.fit import train as fit_module
from sdfsim.shape import make
from sdfsim.shape.make import shape_from_mesh, shape_from_primitive
from sdfsim.shape.shape import load_shape


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recipe of a second, for tests of what is around the fit."""
    plan = replace(fit_module.RECIPES["default"], width=16, layers=4, steps=100, batch=256, pool=4000)
    monkeypatch.setitem(fit_module.RECIPES, "default", plan)


def test_a_mesh_is_fitted_once_whatever_it_is_called(
    tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = tmp_path / "cup.ply", tmp_path / "mug.ply"
    for path in (first, second):
        path.write_bytes(write_ply(primitives.cone(segments=12)))
    told: list[float] = []
    one = shape_from_mesh(first, tmp_path / "cache", on_progress=lambda fraction, _: told.append(fraction))
    assert told[0] == 0.0
    assert told == sorted(told)
    assert told[-1] == 1.0

    monkeypatch.setattr(make, "fit_mesh", lambda *args, **kwargs: pytest.fail("fitted again"))
    two = shape_from_mesh(second, tmp_path / "cache", units=0.01, name="Mug")
    assert (one.name, two.name) == ("cup", "Mug")
    np.testing.assert_allclose(two.nodes, 0.01 * one.nodes)
    assert one.volume == pytest.approx(two.volume * 1e6)
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_a_damaged_cache_entry_is_fitted_again(tmp_path: Path, quick: None) -> None:
    shape_from_primitive("box", 0.5, tmp_path)
    (entry,) = tmp_path.iterdir()
    (entry / "shape.safetensors").write_bytes(b"short")
    shape = shape_from_primitive("box", 0.5, tmp_path)
    assert np.ptp(shape.mesh.vertices, axis=0).max() == pytest.approx(0.5)
    assert load_shape(entry).name == "box"
    with pytest.raises(SdfsimError, match="teapot"):
        shape_from_primitive("teapot", 0.5, tmp_path)


def test_what_the_cache_knows_a_mesh_by_is_all_that_it_describes(tmp_path: Path, quick: None) -> None:
    """A glTF keeps its vertices in a file beside it: its own bytes say little."""
    import trimesh

    path = tmp_path / "cup.gltf"
    for size in (1.0, 2.0):
        mesh = primitives.box((size, 1.0, 1.0))
        scene = trimesh.Trimesh(mesh.vertices, mesh.faces).scene()
        for name, content in trimesh.exchange.gltf.export_gltf(scene).items():
            (path if name.endswith(".gltf") else tmp_path / name).write_bytes(content)
        shape = shape_from_mesh(path, tmp_path / "cache")
        assert np.ptp(shape.mesh.vertices, axis=0).max() == pytest.approx(size)
    cube = primitives.box()
    colors = np.zeros((len(cube.vertices), 3), dtype=np.uint8)
    digests = {cube.digest(), replace(cube, colors=colors).digest(), replace(cube, colors=colors + 1).digest()}
    assert len(digests) == 3


def test_a_fit_that_nobody_sees_is_reported_once(tmp_path: Path, quick: None, caplog: pytest.LogCaptureFixture) -> None:
    told = "making the shape cup, once for this mesh"
    (tmp_path / "cup.ply").write_bytes(write_ply(primitives.cone(segments=12)))
    text = "version: 1\nshapes: {cup: {mesh: cup.ply, sdf: mlp}}\nbodies: [{name: a, shape: cup, mass: 1}]\n"
    (tmp_path / "scene.yaml").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path / "one"))
        load_scene(tmp_path / "scene.yaml")
        assert [record.levelname for record in caplog.records if told in record.message] == ["WARNING"]
        load_scene(tmp_path / "scene.yaml")
        assert caplog.text.count(told) == 1
        caplog.clear()
        patch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
        load_scene(tmp_path / "scene.yaml", lambda fraction, message: None)
        assert told not in caplog.text
        shape_from_mesh(tmp_path / "cup.ply", tmp_path / "third")
        assert caplog.text.count(told) == 1
