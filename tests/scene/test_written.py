"""Scenes written in Python: the same scene as from a file, and the same messages."""

from pathlib import Path

import numpy as np
import pytest

import sdfsim
from sdfsim import SceneError
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh_io import wavefront
from sdfsim.scene.builder import BodyKeys, JointKeys
from sdfsim.scene.load import load_scene
from sdfsim.scene.schema import BodyTable, JointTable, ShapeTable

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


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: sdfsim.Scene().add("a", sphre={"radius": 1}),
         r"body 'a': unknown key 'sphre' \(did you mean 'sphere'\?\)"),
        (lambda: sdfsim.Scene(gravitiy=(0, 0, 0)), r"a scene: unknown key 'gravitiy' \(did you mean 'gravity'\?\)"),
        (lambda: sdfsim.Scene().add("a", sphere={"radius": 1}).add("a", sphere={"radius": 2}),
         "body 'a': two bodies have this name"),
        (lambda: sdfsim.Scene(duration=-1), r"a scene: duration: must be > 0 \(got -1 s\)"),
    ],
)  # fmt: skip
def test_unknown_keys_wrong_settings_and_two_bodies_of_one_name_are_refused_at_once(make, told):
    with pytest.raises(SceneError, match=told):
        make()


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"sphere": {"radius": "x"}, "mass": float("nan")}, [
            "body 'a': sphere.radius: must be a number in m (got 'x')", "body 'a': mass: must be a number in kg"]),
        ({"sphere": {"radius": 0.1}, "mass": -1}, ["body 'a': mass: must be > 0 (got -1 kg)"]),
        ({"box": {"sise": (1, 2, 3)}}, ["box.sise: unknown key (did you mean 'size'?)", "box.size: is required"]),
        ({"box": {"size": (1, 2)}}, ["body 'a': box.size: must be 3 numbers (got 2)"]),
        ({"box": {"size": (1, 2, 3, 4)}}, ["body 'a': box.size: must be 3 numbers (got 4)"]),
        ({"shape": "b", "quat_wxyz": (1, 0, 0)}, ["body 'a': quat_wxyz: must be 4 numbers (got 3)"]),
        ({"shape": "b", "arrange": {"grid": [1, 2], "spacing": 1}}, ["arrange.grid: must be 3 numbers (got 2)"]),
        ({"shape": "b", "rotation": (0, 0, 90)}, ["'rotation' (give quat_xyzw, quat_wxyz or euler_xyz_deg)"]),
        ({"shape": "b", "motion": "moving"}, ["motion: must be one of static, dynamic, kinematic (got 'moving')"]),
        ({}, ["body 'a': one of shape, plane is required"]),
        ({"parts": [{"box": {"size": (1, 1, 1)}, "scale": 2}]}, ["parts[0].scale: is for a mesh only"]),
        ({"parts": [{"box": {"size": (1, 1, 1)}, "use": "shown"}]}, ["parts: one part must not be use: shown"]),
        ({"parts": [{"position": (0, 0, 1)}]}, ["parts[0]: one of mesh, sphere, capsule, cylinder, box is required"]),
        ({"parts": [{"capsule": {"radius": 1, "height": 1}}]}, [
            "parts[0].capsule.height: must be above twice the radius"]),
        ({"parts": [{"mesh": "none.obj"}]}, ["parts[0].mesh: no such file"]),
    ],
)  # fmt: skip
def test_a_wrong_body_is_refused_where_it_is_added(keys, told):
    with pytest.raises(SceneError) as caught:
        sdfsim.Scene().add("a", **keys)
    assert all(any(part in problem for problem in caught.value.problems) for part in told)
    assert all(problem.startswith("body 'a': ") for problem in caught.value.problems)


@pytest.mark.parametrize(
    ("kind", "keys", "told"),
    [
        ("hinge", {"anchor": (0, 0, 0)}, "joint 'j': axis: is required: this is a hinge"),
        ("hinge", {"anchor": (0, 0, 0), "axis": (0, 0, 1), "limits": (0, 1)},
         "limits: is for slider only (this is a hinge; give limits_deg)"),
        ("slider", {"axis": (0, 0, 1), "start_deg": 3},
         "start_deg: is for hinge only (this is a slider; give start)"),
        ("hinge", {"anchor": (0, 0), "axis": (0, 0, 1)}, "anchor: must be 3 numbers (got 2)"),
        ("slider", {"axis": (0, 0, 1), "limits": [1.0]}, "limits: must be 2 numbers (got 1)"),
        ("slider", {"axis": (0, 0, 1), "limits": (0, 1), "motor": {"position": 1.5, "max_force": 3}},
         "motor.position: is beyond the limits, 0 to 1 m (got 1.5 m)"),
        ("hing", {}, "type: must be one of hinge, slider"),
    ],
)  # fmt: skip
def test_a_wrong_joint_is_refused_where_it_is_added(kind, keys, told):
    with pytest.raises(SceneError) as caught:
        sdfsim.Scene().join("j", kind, "a", **keys)
    assert any(told in problem for problem in caught.value.problems)


def test_missing_bodies_are_told_beside_other_faults_and_with_those_that_there_are(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text(
        "version: 1\nduration: -1\nbodies:\n  - {name: floor, plane: {}}\n"
        "  - {name: wall, plane: {}, collides_with: [x9]}\n"
        "joints:\n  - {name: j, type: ball, bodies: [leg, world], anchor: [0, 0, 0]}\n"
    )
    with pytest.raises(SceneError) as caught:
        load_scene(file)
    told = "\n".join(caught.value.problems)
    assert "duration: must be > 0" in told and len(caught.value.problems) == 3
    assert "joints[0].bodies[0]: no body is called 'leg'; bodies are floor, wall" in told
    assert "bodies[1].collides_with[0]: no body is called 'x9'; bodies are floor, wall" in told


def test_a_scene_of_a_file_can_be_gone_on_with(tmp_path):
    written().save(tmp_path / "scene.yaml")
    scene = sdfsim.Scene.read(tmp_path / "scene.yaml", allow_outside=True)
    first, again = written().load(), scene.load()
    assert [b.name for b in first.bodies] == [b.name for b in again.bodies]
    assert first.duration == again.duration and first.effects == again.effects
    for one, other in zip(first.bodies, again.bodies, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
        assert one.mass == other.mass
    scene.add("post", box={"size": (0.1, 0.1, 0.1)}, position=(2, 0, 1))
    scene.join("pin", "ball", "post", anchor=(2, 0, 1.05))
    assert [j.name for j in sdfsim.Simulator(scene).scene.joints] == ["pin"]
    with pytest.raises(SceneError, match="body 'ball': two bodies"):
        scene.add("ball", sphere={"radius": 1})
    assert sdfsim.Scene.read("door").load().joints[0].name == "door"
    with pytest.raises(SceneError, match="no such file"):
        sdfsim.Scene.read(tmp_path / "none.yaml")


def test_type_checkers_know_the_keys_of_the_file():
    of_shape = {*ShapeTable.model_fields, *BodyTable.model_fields} - {"name"}
    assert set(BodyKeys.__annotations__) == of_shape
    assert set(JointKeys.__annotations__) == set(JointTable.model_fields) - {"name", "type", "bodies"}


def test_what_does_not_fit_together_is_reported_by_the_names_of_bodies():
    scene = sdfsim.Scene().add("a", shape="c").add("b", shape="d", collides_with=["e"])
    with pytest.raises(SceneError) as caught:
        scene.load()
    told = ("body 'a': shape: no shape", "body 'b': shape: no shape", "body 'b': collides_with[0]: no body")
    assert [problem.startswith(part) for problem, part in zip(caught.value.problems, told, strict=True)] == [True] * 3


def test_bodies_that_bring_the_same_mesh_have_one_shape(tmp_path):
    """What is said of it otherwise makes another; what the bodies are stays their own."""
    file = tmp_path / "tile.obj"
    file.write_text(wavefront([primitives.box((0.1, 0.1, 0.02))]))
    scene = sdfsim.Scene()
    for k in range(5):
        scene.add(f"tile{k}", mesh=file, sdf="mesh", position=(0.2 * k, 0, 0), scale=1 + k, mass=1)
    scene.add("small", mesh=file, sdf="mesh", units="cm", mass=1)
    loaded = scene.load()
    assert [body.shape for body in loaded.bodies] == [0, 0, 0, 0, 0, 1]
    assert [np.ptp(shape.sdf.bounds, axis=0)[0] for shape in loaded.shapes] == pytest.approx([0.1, 0.001])
    assert [body.scale for body in loaded.bodies[:5]] == [1, 2, 3, 4, 5]
