"""Cones and rings in closed form, against what mechanics says."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.evaluation.true_surfaces import Placed, gaps, of_mesh
from sdfsim.geometry import primitives
from sdfsim.scene.builder import SceneBuilder
from sdfsim.simulate.simulator import Simulator

G, MU = 9.81, 0.25
DEAD = {"restitution": 0.0, "friction": 0.5}


def on_floor() -> SceneBuilder:
    return SceneBuilder().add("floor", plane={}, **DEAD)


def test_they_slide_as_far_as_friction_lets_them() -> None:
    made = on_floor()
    made.add("ring", torus={"radius": 0.1, "tube": 0.03}, position=(0, 0, 0.03), velocity=(1, 0, 0), **DEAD)
    made.add("cone", cone={"radius": 0.1, "height": 0.06}, position=(0, 1, 0.03), velocity=(1, 0, 0), **DEAD)
    simulator = Simulator(made)
    simulator.run(1.0)
    for name, up in (("ring", 0.03), ("cone", 0.03)):
        body = simulator[name]
        assert body.position[0] == pytest.approx(1.0 / (2 * MU * G), rel=2e-3)
        assert body.position[2] == pytest.approx(up, abs=1e-4)
        assert np.linalg.norm(body.velocity) < 1e-6


@pytest.mark.parametrize("speed", [0.1, 0.4, 1.2])
def test_a_ring_rolls_on(speed: float) -> None:
    made = on_floor()
    spin = {"velocity": (speed, 0, 0), "angular_velocity": (0, speed / 0.13, 0)}
    made.add(
        "ring", torus={"radius": 0.1, "tube": 0.03}, position=(0, 0, 0.13), euler_xyz_deg=(90, 0, 0), **spin, **DEAD
    )
    simulator = Simulator(made)
    simulator.run(3.0)
    assert simulator["ring"].velocity[0] == pytest.approx(speed, rel=2e-3)
    assert simulator["ring"].position[:2] == pytest.approx((3 * speed, 0.0), abs=0.005 * speed)


def test_a_cone_rolls_around_its_tip() -> None:
    """On its side without slipping: about the line on which it lies, so that its tip rests and its axis goes around."""
    radius, height, spin = 0.05, 0.2, 4.0
    slope = np.arctan2(radius, height)
    turn = Rotation.from_euler("y", 90 + np.rad2deg(slope), degrees=True)  # its tip at the origin, away along -x
    tip = np.array([0, 0, 0.5 * height])
    place = -turn.apply(tip)
    com = place + turn.apply([0, 0, -0.25 * height])
    line = np.array([-1.0, 0, 0])
    made = on_floor()
    made.add(
        "cone", cone={"radius": radius, "height": height}, position=place, quat_xyzw=turn.as_quat(),
        angular_velocity=spin * line, velocity=np.cross(spin * line, com), **DEAD,
    )  # fmt: skip
    simulator = Simulator(made)
    cone = simulator["cone"]
    start = Rotation.from_quat(cone.quat_xyzw).apply([0, 0, 1])
    angle = 0.0
    for _ in range(20):
        simulator.run(0.1)
        axis = Rotation.from_quat(cone.quat_xyzw).apply([0, 0, 1])
        angle += np.arctan2(start[0] * axis[1] - start[1] * axis[0], start[:2] @ axis[:2])
        start = axis
        at = cone.position + 0.5 * height * axis
        assert np.linalg.norm(at) < 0.01 * height
        assert axis[2] == pytest.approx(-np.sin(slope), abs=0.01)
    assert abs(angle) == pytest.approx(2.0 * spin * np.tan(slope), rel=0.01)
    assert np.linalg.norm(cone.angular_velocity) == pytest.approx(spin, rel=0.01)


def test_a_chain_of_rings_hangs_as_deep_as_its_links_are_long() -> None:
    made, link = SceneBuilder(), {"torus": {"radius": 0.1, "tube": 0.02}}
    for k in range(5):
        still = {"motion": "static"} if k == 0 else {}
        euler = (90, 0, 0) if k % 2 else (90, 0, 90)
        made.add(f"link{k}", **link, position=(0, 0, 2 - 0.155 * k), euler_xyz_deg=euler, **still, **DEAD)
    simulator = Simulator(made)
    simulator.run(4.0)
    for k in range(1, 5):
        assert simulator[f"link{k}"].position == pytest.approx((0, 0, 2 - 0.16 * k), abs=1e-3 * k)


PARTNERS = {
    "ball": ({"sphere": {"radius": 0.12}}, primitives.sphere(0.12, 5)),
    "small ball": ({"sphere": {"radius": 0.05}}, primitives.sphere(0.05, 4)),
    "box": ({"box": {"size": (0.1, 0.2, 0.15)}}, primitives.box((0.1, 0.2, 0.15))),
    "can": ({"cylinder": {"radius": 0.06, "height": 0.2}}, primitives.cylinder(0.06, 0.2, 256)),
    "cone": ({"cone": {"radius": 0.1, "height": 0.15}}, primitives.cone(0.1, 0.15, 256)),
    "ring": ({"torus": {"radius": 0.12, "tube": 0.03}}, primitives.torus(0.12, 0.03, 192, 96)),
}


@pytest.mark.parametrize(
    "other", [pytest.param(name, marks=[] if name in ("box", "can") else [pytest.mark.slow]) for name in PARTNERS]
)
def test_a_ring_meets_others_on_its_true_surface(other: str) -> None:
    """Dropped on others that are fixed, without friction and at random, it never gets deeper than its size allows by
    the distance of fine triangles, and never rests in the air."""
    ring, (keys, mesh) = primitives.torus(0.12, 0.03, 192, 96), PARTNERS[other]
    solids = [of_mesh(ring), of_mesh(mesh)]
    draw = np.random.default_rng(7)
    deepest, touched = 0.0, 0
    made = SceneBuilder()
    for k in range(6):
        at, turns = np.array([2.0 * k, 0, 0]), Rotation.random(2, random_state=k).as_quat()
        made.add(f"other{k}", **keys, position=at, quat_xyzw=turns[0], motion="static", friction=0.0)
        above = at + np.append(0.03 * draw.normal(size=2), 0.35)
        made.add(f"ring{k}", torus={"radius": 0.12, "tube": 0.03}, position=above, quat_xyzw=turns[1], friction=0.0)
    simulator = Simulator(made)
    for _ in range(40):
        simulator.run(0.0125)
        bodies = [[simulator[f"{name}{k}"] for k in range(6)] for name in ("ring", "other")]
        first, second = (
            Placed(
                np.full(6, which), np.ones(6), np.array([b.position for b in some]),
                Rotation.from_quat([b.quat_xyzw for b in some]).as_matrix(),
            )
            for which, some in enumerate(bodies)
        )  # fmt: skip
        found = gaps(solids, first, second, np.full(6, 0.5)).apart
        deepest, touched = min(deepest, found.min()), touched + int((np.abs(found) < 2e-3).sum())
    assert deepest > -2e-3
    assert touched > 2
