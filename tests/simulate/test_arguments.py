"""Arguments of another kind than is wanted end in one line that says so; paths are taken where that is natural."""

import pytest

import sdfsim
from sdfsim import Scene, SdfsimError, Simulator


def box() -> Scene:
    scene = Scene(model="solver").add("floor", plane={}, restitution=0.0)
    return scene.add("box", box={"size": (0.2, 0.2, 0.2)}, position=(0, 0, 0.1), mass=3.0, restitution=0.0)


def test_a_simulator_takes_a_path_and_a_sample(tmp_path):
    file = box().save(tmp_path / "scene.yaml")
    assert Simulator(file).scene.bodies[1].name == Simulator(str(file)).scene.bodies[1].name == "box"
    assert any(joint.name == "door" for joint in Simulator("door").scene.joints)
    with pytest.raises(SdfsimError, match=r"truth\.yaml: no such file"):
        Simulator("truth.yaml")


@pytest.mark.parametrize("wrong", [3, None, {"bodies": []}])
def test_what_is_no_scene_is_refused(wrong, tmp_path):
    with pytest.raises(SdfsimError, match=rf"scene: must be a Scene, the path .*got a {type(wrong).__name__}"):
        Simulator(wrong)
    with pytest.raises(SdfsimError, match="source: must be a path"):
        sdfsim.export(wrong, tmp_path / "out.glb")


@pytest.mark.parametrize("count", [0.5, -1, "3", None, True])
def test_steps_are_whole_numbers(count):
    sim = Simulator(box())
    with pytest.raises(SdfsimError, match="steps: must be a whole number"):
        sim.step(count)
    with pytest.raises(SdfsimError, match="steps: must be a whole number"):
        next(sim.steps(count))


def test_render_and_export_say_what_they_want(tmp_path):
    with pytest.raises(SdfsimError, match="rollout: must be a Rollout or the path"):
        sdfsim.render(box(), 3, tmp_path / "out.png")  # type: ignore[arg-type]
    with pytest.raises(SdfsimError, match=r"source: must be a path \(got a SceneBuilder\)\nhint: .*scene\.save"):
        sdfsim.export(box(), tmp_path / "out.glb")  # type: ignore[arg-type]
