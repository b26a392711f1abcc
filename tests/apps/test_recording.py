"""Recordings hold what the rollout holds, whether logged at once or step by step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from sdfsim import load_scene
from sdfsim.apps.recording import (
    COLORS,
    MANY,
    PLOTS,
    Playback,
    PosedPhoto,
    save_reconstruction,
    save_rollout,
)
from sdfsim.geometry.primitives import box
from sdfsim.physics.rollout import Rollout
from sdfsim.simulate.camera import Camera
from sdfsim.simulate.looks import FARTHEST, framed
from tests.helpers.runs import read

STEPS = 6


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "scene.yaml").write_text(
        "version: 1\nshapes:\n  ball: {sphere: {radius: 0.5}}\n  brick: {box: {size: [1, 2, 3]}}\nbodies:\n"
        "  - {name: floor, plane: {}}\n  - {name: shelf, shape: brick, motion: static, position: [5, 0, 0]}\n"
        "  - {name: 'a ball/1', shape: ball, scale: 2}\n  - {name: brick, shape: brick, position: [0, 3, 0]}\n"
    )
    return load_scene(tmp_path / "scene.yaml")


def motion(scene, count: np.ndarray) -> Rollout:
    """Anything at all, with `count` [T] contact points in each frame."""
    rng = np.random.default_rng(0)
    shape = (len(count), len(scene.bodies))
    return Rollout(
        time=np.arange(len(count)) * 0.25,
        position=rng.normal(size=(*shape, 3)),
        orientation=Rotation.random(shape[0] * shape[1], random_state=1).as_quat().reshape(*shape, 4),
        velocity=np.zeros((*shape, 3)),
        angular_velocity=np.zeros((*shape, 3)),
        contact_count=count,
        contact_point=rng.normal(size=(count.sum(), 3)),
        contact_body=np.zeros((count.sum(), 2), dtype=np.int64),
        counters={key: rng.random(len(count)) for key in PLOTS},
        names=tuple(b.name for b in scene.bodies),
    )


@pytest.fixture
def rollout(scene) -> Rollout:
    return motion(scene, np.array([0, 2, 0, 1, 3, 0, 1]))


def test_the_first_view_shows_all_of_the_motion(scene, rollout):
    rollout.position[:, 2, 2] = np.linspace(
        0.0, -8.0, STEPS + 1
    )  # the ball falls, and does not stop at its start's view
    centre, radius = framed(scene, rollout)
    for k in (2, 3):
        away = np.linalg.norm(rollout.position[:, k] - centre, axis=1)
        assert (away + np.sqrt(3) * 0.5 < radius).all()
    assert radius > framed(scene)[1]
    # What leaves for good does not make the rest a dot.
    rollout.position[:, 2, 0] = np.linspace(0.0, 1e6, STEPS + 1)
    assert framed(scene, rollout)[1] < (FARTHEST + 1) * 2 * framed(scene)[1] * np.sqrt(3)


def test_the_first_view_is_of_what_is_in_a_room_and_not_of_the_room():
    def view(size: float) -> float:
        walls = {"name": "walls", "shape": "walls", "motion": "static"}
        ball = {"name": "ball", "shape": "ball", "position": [0.2, 0, 0]}
        shapes = {"walls": {"box": {"size": [size] * 3}}, "ball": {"sphere": {"radius": 0.5}}}
        text = yaml.safe_dump({"version": 1, "shapes": shapes, "bodies": [ball, walls]})
        return framed(load_scene("scene.yaml", text=text))[1]

    assert view(10.0) == pytest.approx(np.sqrt(3) / 2) and view(2.0) == pytest.approx(np.sqrt(3))


def test_a_file_holds_the_rollout(scene, rollout, tmp_path):
    path = tmp_path / "rollout.rrd"
    save_rollout(scene, rollout, path)
    found = read(path)
    assert [p.name for p in tmp_path.glob("rollout*")] == ["rollout.rrd"]
    ball = found[r"/world/a\ ball\/1"]
    np.testing.assert_allclose([r[0] for r in ball["Transform3D:translation"]], rollout.position[:, 2], rtol=1e-6)
    np.testing.assert_allclose([r[0] for r in ball["Transform3D:quaternion"]], rollout.orientation[:, 2], rtol=1e-6)
    assert [t.total_seconds() for t in ball["time"]] == pytest.approx(rollout.time)
    assert ball["step"] == list(range(STEPS + 1))
    points = found["/world/contacts"]["Points3D:positions"]
    assert [len(p) for p in points] == rollout.contact_count.tolist()
    np.testing.assert_allclose(np.concatenate([p for p in points if p]), rollout.contact_point, rtol=1e-6)
    for key in PLOTS:
        np.testing.assert_allclose([r[0] for r in found[f"/plots/{key}"]["Scalars:scalars"]], rollout.counters[key])


def test_what_does_not_move_is_logged_once(scene, rollout, tmp_path):
    save_rollout(scene, rollout, tmp_path / "rollout.rrd")
    found = read(tmp_path / "rollout.rrd")
    assert "/world/shelf" not in found and "/world/floor" not in found
    np.testing.assert_allclose(found["/world/shelf!"]["Transform3D:translation"][0][0], [5, 0, 0])
    vertices = np.array(found[r"/world/a\ ball\/1/mesh!"]["Mesh3D:vertex_positions"][0])
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, atol=1e-3)  # radius 0.5 at scale 2
    assert len(found["/world/brick/nodes!"]["Points3D:positions"][0]) == len(scene.shapes[1].nodes)
    assert not any("floor/nodes" in entity for entity in found)


def test_steps_one_by_one_make_the_same_recording(scene, rollout, tmp_path):
    save_rollout(scene, rollout, tmp_path / "whole.rrd")
    live = Playback(scene)
    encoded = live.stream.binary_stream()
    live.log_static()
    for i in range(STEPS + 1):
        live.log_steps(rollout.frames(i, i + 1))
    (tmp_path / "live.rrd").write_bytes(encoded.read())
    whole, parts = read(tmp_path / "whole.rrd"), read(tmp_path / "live.rrd")
    assert whole.keys() == parts.keys()
    for entity in (r"/world/a\ ball\/1", "/world/brick", "/world/contacts", "/plots/contacts"):
        for column in whole[entity]:
            if "RowId" not in column:
                assert whole[entity][column] == parts[entity][column], (entity, column)


def blueprint(path) -> str:
    """What rerun's own program prints of a recording."""
    import subprocess

    from sdfsim.apps.viewer import viewer_program

    command = [viewer_program(), "rrd", "print", "-vvv", str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_nodes_contacts_and_forces_are_hidden_until_switched_on(scene, tmp_path, rollout):
    save_rollout(scene, rollout, tmp_path / "rollout.rrd")
    told = blueprint(tmp_path / "rollout.rrd")
    for entity in ("contacts", "forces", "still", "brick/nodes"):
        assert f"overrides/world/{entity}" in told
    assert told.count("EntityBehavior:visible") >= 5


def test_forces_are_weights_and_those_that_stand_still_are_marked(scene, tmp_path):
    """A ball (2 m across) falls, while a brick (3 m) of whatever mass stands; then the brick is hit with ten times its
    weight, and later moves evenly aside while it is held up."""
    rollout = motion(scene, np.zeros(5, dtype=np.int64))
    step, gravity = 0.25, 9.81
    for name in ("position", "orientation", "velocity"):
        getattr(rollout, name)[:] = getattr(rollout, name)[0]
    rollout.velocity[:, 2] = -gravity * step * np.arange(5)[:, None] * [0, 0, 1]
    rollout.position[:, 2, 2] = 100.0 + rollout.velocity[:, 2, 2]
    rollout.velocity[3:, 3, 0] = 10 * gravity * step
    rollout.position[4, 3, 0] += 1.0
    save_rollout(scene, rollout, tmp_path / "rollout.rrd")
    found = read(tmp_path / "rollout.rrd")
    arrows = found["/world/forces"]["Arrows3D:vectors"]
    assert [len(row) for row in arrows] == [0, 1, 1, 1, 1]  # the ball falls freely
    for k, aside, up in ((1, 0.0, 1.0), (2, 0.0, 1.0), (4, 0.0, 1.0)):
        np.testing.assert_allclose(arrows[k][0], [3.0 * aside, 0.0, 3.0 * up], atol=1e-5)
    hit = np.array([10.0, 0.0, 1.0]) / np.sqrt(101.0) * 5.0 * 3.0  # cut to five lengths of the body
    np.testing.assert_allclose(arrows[3][0], hit, rtol=1e-5)
    np.testing.assert_allclose(found["/world/forces"]["Arrows3D:origins"][4][0], rollout.position[4, 3], rtol=1e-6)
    assert [len(row) for row in found["/world/still"]["Points3D:positions"]] == [0, 1, 1, 0, 0]


def test_a_reconstruction_shows_cameras_photos_points_and_surface(tmp_path):
    from PIL import Image

    Image.fromarray(np.full((600, 800, 3), 128, np.uint8)).save(tmp_path / "one.png")
    turn = Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix()
    photos = [
        PosedPhoto(f"{i}.png", image, Camera.posed(turn, (0.0, 0.0, 2.0), (700.0, 700.0), 800, 600))
        for i, image in enumerate([tmp_path / "one.png", None, tmp_path / "missing.png"])
    ]
    save_reconstruction(tmp_path / "r.rrd", photos, np.random.default_rng(0).normal(size=(50, 3)), None, box())
    found = read(tmp_path / "r.rrd")
    camera = found["/world/cameras/0.png!"]
    np.testing.assert_allclose(camera["Transform3D:translation"][0][0], -turn.T @ [0, 0, 2], atol=1e-6)
    assert camera["Pinhole:resolution"][0][0] == [320, 240]
    assert "EncodedImage:blob" in camera and "EncodedImage:blob" not in found["/world/cameras/1.png!"]
    assert len(found["/world/points!"]["Points3D:positions"][0]) == 50
    assert "/world/surface!" in found


def test_what_is_proposed_and_how_far_to_trust_the_surface_are_things_of_their_own(tmp_path):
    photo = PosedPhoto("next1", None, Camera.posed(np.eye(3), np.zeros(3), (700.0, 700.0), 800, 600), (255, 40, 200))
    tinted = replace(box(), colors=np.full((len(box().vertices), 3), 7, np.uint8))
    save_reconstruction(tmp_path / "r.rrd", [photo], np.zeros((0, 3)), None, box(), trust={"a box": tinted})
    found = read(tmp_path / "r.rrd")
    assert found["/world/cameras/next1!"]["Pinhole:color"][0][0] == 0xFF28C8FF
    assert len(found[r"/world/trust/a\ box!"]["Mesh3D:vertex_colors"][0]) == 36
    assert "/world/surface!" in found


def crowd(tmp_path, count: int, frames: int, name: str = "ball"):
    (tmp_path / "scene.yaml").write_text(
        f"version: 1\nshapes:\n  {name}: {{sphere: {{radius: 0.5}}}}\n"
        "  brick: {box: {size: [1, 2, 3]}}\nbodies:\n"
        "  - {name: floor, plane: {}}\n  - {name: brick, shape: brick, position: [0, 3, 0]}\n"
        f"  - {{name: balls, shape: {name}, scale: 2, arrange: {{grid: [{count}, 1, 1], spacing: 3}}}}\n"
    )
    scene = load_scene(tmp_path / "scene.yaml")
    return scene, motion(scene, np.zeros(frames, dtype=np.int64))


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
