"""Many bodies of one shape are copies of one mesh in a recording, and a long one stays small."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim import load_scene
from sdfsim.dynamics.rollout import Rollout
from sdfsim.recording import COLORS, MANY, PLOTS, save_rollout
from sdfsim.shape.mesh import Mesh
from sdfsim.shape.primitives import sphere
from tests.test_recording import read


def crowd(tmp_path, count: int, frames: int, name: str = "ball"):
    (tmp_path / "scene.yaml").write_text(
        f"version: 1\nshapes:\n  {name}: {{sphere: {{radius: 0.5}}}}\n"
        "  brick: {box: {size: [1, 2, 3]}}\nbodies:\n"
        "  - {name: floor, plane: {}}\n  - {name: brick, shape: brick, position: [0, 3, 0]}\n"
        f"  - {{name: balls, shape: {name}, scale: 2, arrange: {{grid: [{count}, 1, 1], spacing: 3}}}}\n"
    )
    scene = load_scene(tmp_path / "scene.yaml")
    rng, shape = np.random.default_rng(0), (frames, len(scene.bodies))
    rollout = Rollout(
        time=np.arange(frames) * 0.25,
        position=rng.normal(size=(*shape, 3)),
        orientation=Rotation.random(shape[0] * shape[1], random_state=1).as_quat().reshape(*shape, 4),
        velocity=np.zeros((*shape, 3)),
        angular_velocity=np.zeros((*shape, 3)),
        contact_count=np.zeros(frames, dtype=np.int64),
        contact_point=np.zeros((0, 3)),
        contact_body=np.zeros((0, 2), dtype=np.int64),
        counters={key: rng.random(frames) for key in PLOTS},
        names=tuple(b.name for b in scene.bodies),
    )
    return scene, rollout


def test_every_copy_is_where_its_body_is(tmp_path):
    scene, rollout = crowd(tmp_path, MANY + 3, 4)
    save_rollout(scene, rollout, tmp_path / "rollout.rrd")
    found = read(tmp_path / "rollout.rrd")
    paths = [f"/world/crowds/2_ball/{k}" for k in range(COLORS)]
    assert not any("balls" in path for path in found) and "/world/brick" in found
    places = [np.array(found[path]["InstancePoses3D:translations"]) for path in paths]
    seen = np.concatenate(places, 1)
    order = np.concatenate([np.arange(2, MANY + 5)[k::COLORS] for k in range(COLORS)])
    np.testing.assert_allclose(seen, rollout.position[:, order], rtol=1e-6)
    turns = np.concatenate([np.array(found[path]["InstancePoses3D:quaternions"]) for path in paths], 1)
    np.testing.assert_allclose(turns, rollout.orientation[:, order], rtol=1e-5, atol=1e-6)
    for path in paths:
        scales = np.array(found[path + "!"]["InstancePoses3D:scales"][0])
        np.testing.assert_allclose(scales, 2.0)
        corners = np.array(found[path + "!"]["Mesh3D:vertex_positions"][0])
        np.testing.assert_allclose(np.linalg.norm(corners, axis=1), 0.5, atol=1e-3)


def test_the_name_of_a_shape_is_one_part_of_a_path(tmp_path):
    import rerun as rr

    scene, rollout = crowd(tmp_path, MANY, 1, name="red ball/1")
    save_rollout(scene, rollout, tmp_path / "rollout.rrd")
    found = [path for path in read(tmp_path / "rollout.rrd") if "crowds" in path and not path.endswith("!")]
    assert sorted(found) == [rr.new_entity_path(["world", "crowds", "2_red ball/1", str(k)]) for k in range(COLORS)]


def test_few_are_drawn_one_by_one(tmp_path):
    scene, rollout = crowd(tmp_path, MANY - 1, 2)
    save_rollout(scene, rollout, tmp_path / "rollout.rrd")
    assert not any("crowds" in path for path in read(tmp_path / "rollout.rrd"))


def test_four_hundred_steps_of_four_hundred_bodies_are_small(tmp_path):
    """A mesh of 40,000 vertices: as one a body it would be half a gigabyte."""
    scene, rollout = crowd(tmp_path, 400, 401)
    fine = sphere(0.5, subdivisions=6)
    shapes = tuple(replace(s, mesh=Mesh(fine.vertices, fine.faces)) if s.name == "ball" else s for s in scene.shapes)
    save_rollout(replace(scene, shapes=shapes), rollout, tmp_path / "rollout.rrd")
    assert (tmp_path / "rollout.rrd").stat().st_size < 40e6
