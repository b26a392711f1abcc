"""Scenes written in Python: the same scene as from a file, and the same messages."""

from pathlib import Path

import numpy as np
import pytest

import sdfsim
from sdfsim import SceneError
from sdfsim.scene.load import load_scene

ROOT = Path(__file__).parents[2]


def written() -> sdfsim.Scene:
    scene = sdfsim.Scene(duration=0.2, gravity=np.array([0.0, 0.0, -9.81]), effects={"sleep": False})
    scene.add("floor", plane={"normal": (0, 0, 1)})
    scene.add("ball", sphere={"radius": np.float64(0.05)}, position=(0, 0, 0.3), mass=1e-5)
    scene.add("balls", shape="ball", count=2, arrange={"grid": [2, 1, 1], "spacing": 0.2}, position=(0, 0.3, 0.3))
    return scene.add("ring", asset=ROOT / "samples" / "shapes" / "ring", position=[0, -0.4, 0.2], nodes=None)


def test_a_scene_written_in_python_is_that_of_its_file(tmp_path):
    scene = written()
    file = scene.save(tmp_path / "scene.yaml")
    direct, read = scene.load(), load_scene(file, allow_outside=True)
    assert direct.path is None and read.path == file
    assert [b.name for b in direct.bodies] == ["floor", "ball", "balls[0]", "balls[1]", "ring"]
    assert direct.effects == read.effects and direct.effects.sleep == "off"
    for one, other in zip(direct.bodies, read.bodies, strict=True):
        for field in ("shape", "motion", "mass", "friction"):
            assert getattr(one, field) == getattr(other, field)
        np.testing.assert_array_equal(one.position, other.position)
    assert direct.bodies[1].mass == 1e-5 and direct.shapes[1].sdf.radius == 0.05  # type: ignore[attr-defined]
    assert "../" in file.read_text()  # the path of the ring starts at the folder of the file


def test_a_simulator_takes_it():
    rollout = sdfsim.Simulator(written()).run()
    fall = 0.3 - 0.5 * 9.81 * rollout.time[-1] ** 2
    assert rollout.position[-1, 1, 2] == pytest.approx(fall, abs=1e-9)


def test_unknown_keys_are_reported_at_once():
    with pytest.raises(SceneError, match=r"body 'a': unknown key 'sphre' \(did you mean 'sphere'\?\)"):
        sdfsim.Scene().add("a", sphre={"radius": 1})
    with pytest.raises(SceneError, match=r"a scene: unknown key 'gravitiy' \(did you mean 'gravity'\?\)"):
        sdfsim.Scene(gravitiy=(0, 0, 0))


def test_wrong_values_are_reported_together_with_the_lines_that_print_shows():
    scene = sdfsim.Scene(duration=-1).add("a", sphere={"radius": "x"}, mass=float("nan")).add("b", shape="c")
    with pytest.raises(SceneError) as caught:
        scene.load()
    lines = str(scene).splitlines()
    told = caught.value.problems
    assert len(told) == 4
    for problem, key in zip(told, ("duration", "radius", "nan", "shape: c"), strict=True):
        assert problem.startswith("<scene>:") and key in lines[int(problem.split(":")[1]) - 1]
