"""The instruments tell each fault of hand-made motions, and nothing of motions that keep the laws: no solver makes
what is judged here, so that they are tested whatever it does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.evaluation.instruments import judged, telling_frames
from sdfsim.evaluation.true_surfaces import Gaps, Placed, gaps, true_surface
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Body, Scene, Waypoints
from sdfsim.sdf.closed_forms import ConeSdf
from sdfsim.shape.make import analytic_shape, mesh_shape
from sdfsim.shape.shape import Shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import make_body

G = np.array([0.0, 0.0, -9.81])
DT = 0.01
BALL, CUBE = analytic_shape("sphere", radius=0.25), analytic_shape("box", size=(0.1, 0.1, 0.1))
STICK = analytic_shape("box", size=(1.0, 0.05, 0.05))
CAN = analytic_shape("cylinder", radius=0.05, height=0.1)
PLANE = analytic_shape("plane")


def mesh(made: Mesh) -> Shape:
    return mesh_shape(made, name="mesh", kind="mesh")


def about(axis: str, degrees: float) -> Rotation:
    return Rotation.from_euler(axis, degrees, degrees=True)


def motion(scene: Scene, place: np.ndarray, velocity: np.ndarray | None = None, **more: np.ndarray) -> Rollout:
    """A record of positions [T+1, N, 3] and, unless told, the velocities of their differences, at rest at the start;
    bodies keep the orientations of the scene, or turn as they are told to."""
    frames, count = place.shape[:2]
    turn = np.broadcast_to(np.stack([b.quat_xyzw for b in scene.bodies]), (frames, count, 4))
    if velocity is None:
        velocity = np.gradient(place, DT, axis=0) if frames > 1 else np.zeros_like(place)
    return Rollout(
        time=DT * np.arange(frames),
        position=place,
        orientation=more.get("orientation", turn),
        velocity=velocity,
        angular_velocity=more.get("spin", np.zeros_like(place)),
        contact_count=np.zeros(frames, np.int64),
        contact_point=np.zeros((0, 3)),
        contact_body=np.zeros((0, 2), np.int64),
        counters={name: np.zeros(frames) for name in COUNTED},
        names=tuple(b.name for b in scene.bodies),
        meta={"model": "by hand", "dt": DT, "outside_training": []},
    )


COUNTED = (
    *("pairs", "contacts", "nodes", "edges", "free", "active", "asleep", "flight_ms", "contact_ms", "network_ms"),
    *("step_ms", "worst_penetration", "kinetic_energy", "potential_energy"),
)


def still(scene: Scene, frames: int = 5) -> Rollout:
    """A record in which nothing moves; centres of mass are the origins of these shapes."""
    place = np.broadcast_to(np.stack([b.position for b in scene.bodies]), (frames, len(scene.bodies), 3)).copy()
    return motion(scene, place, np.zeros_like(place))


def static(name: str, shape: int, place, **more) -> Body:
    return make_body(name, shape, place, motion="static", mass=0.0, **more)


def between(
    a: Shape, b: Shape, place, turn: Rotation, *, other: Rotation | None = None, scale: tuple[float, float] = (1, 1)
) -> Gaps:
    """The gap between one shape, turned, at the origin and another."""
    poses = [
        Placed(np.array([k]), np.array([s], float), np.array([p], float), r.as_matrix()[None])
        for k, s, p, r in ((0, scale[0], np.zeros(3), other or Rotation.identity()), (1, scale[1], place, turn))
    ]
    return gaps([true_surface(a), true_surface(b)], *poses, np.array([np.inf]))


# --- gaps and depths against closed forms ---


@pytest.mark.parametrize("yaw", [30.0, 77.0, 90.0])
@pytest.mark.parametrize("apart", [0.004, 0.0005, -0.0005, -0.004, -0.012])
def test_sticks_that_cross_are_measured_though_neither_has_a_corner_in_the_other(yaw, apart):
    for one, other in ((STICK, STICK), (mesh(primitives.box((1.0, 0.05, 0.05))), STICK)):
        found = between(one, other, [0.1, -0.03, 0.05 + apart], about("z", yaw))
        assert found.apart[0] == pytest.approx(apart, abs=2e-5)


@pytest.mark.parametrize("aspect", [5, 50])
def test_cylinders_that_cross_are_measured_on_their_true_lines(aspect):
    radius = 0.5 / aspect
    rod = analytic_shape("cylinder", radius=radius, height=1.0)
    for yaw, apart in ((90.0, 0.01), (40.0, -0.02), (65.0, -0.2)):
        turned = about("z", yaw) * about("y", 90)
        found = between(rod, rod, [0.02, 0.03, radius * (2 + apart)], turned, other=about("y", 90))
        assert found.apart[0] == pytest.approx(radius * apart, abs=1e-3 * radius)


def test_capsules_are_as_far_apart_as_their_segments():
    rng = np.random.default_rng(0)
    sizes = ((0.05, 0.5), (0.02, 1.0))
    rods = [analytic_shape("capsule", radius=r, height=h) for r, h in sizes]
    for _ in range(40):
        turns, place = Rotation.random(2, rng=rng), rng.uniform(-0.6, 0.6, 3)
        ends = [turn.apply([0, 0, h / 2 - r]) for turn, (r, h) in zip(turns, sizes, strict=True)]
        # The squared distance of two segments is convex: a fine lattice of one against the other's nearest points.
        t = np.linspace(-1, 1, 4001)[:, None] * ends[0]
        along = ((t - place) @ ends[1] / (ends[1] @ ends[1])).clip(-1, 1)[:, None] * ends[1] + place
        wanted = np.linalg.norm(t - along, axis=1).min() - 0.07
        found = between(*rods, place, turns[1], other=turns[0])
        if wanted > -0.02:  # beyond, the deepest point of a surface is no longer on the line between the segments
            assert found.apart[0] == pytest.approx(wanted, abs=2e-5)


def test_meshes_are_measured_as_the_closed_forms_that_they_are():
    """Boxes, whose meshes are exact, in each other, apart and beside each other's edges."""
    rng = np.random.default_rng(2)
    sizes = (1.0, 0.05, 0.05), (0.3, 0.2, 0.1)
    exact, meshes = [analytic_shape("box", size=size) for size in sizes], [mesh(primitives.box(size)) for size in sizes]
    signs = set()
    for k in range(30):
        turns = Rotation.random(2, rng=rng) if k % 2 else [about("z", 90), Rotation.identity()]
        place = rng.uniform([-0.4, -0.15, -0.15], [0.4, 0.15, 0.15]) if k % 2 else rng.uniform(-0.3, 0.3, 3)
        wanted = between(*exact, place, turns[0], other=turns[1]).apart[0]
        for pair in (meshes, (exact[0], meshes[1]), (meshes[0], exact[1])):
            assert between(*pair, place, turns[0], other=turns[1]).apart[0] == pytest.approx(wanted, abs=3e-5)
        signs.add(bool(wanted > 0))
    assert signs == {True, False}


@pytest.mark.parametrize(("radius", "height"), [(0.5, 0.1), (0.1, 0.5), (0.5, 0.5)])
def test_a_convex_mesh_with_sharp_edges_is_not_entered_from_beyond_them(radius: float, height: float):
    """Below the rim of a cone its side looks away; the cone itself is known in closed form."""
    around = np.random.default_rng(0).uniform(-0.8, 0.8, (4000, 3))
    found = true_surface(mesh(primitives.cone(radius, height, 256))).distance(around)[0]
    truth = ConeSdf(radius, height / 2)(around)[0]
    np.testing.assert_allclose(found, truth, atol=2e-4)


def test_a_torus_and_a_ball_are_measured_in_the_hole_too():
    torus, small = mesh(primitives.torus(0.35, 0.15, 192, 96)), analytic_shape("sphere", radius=0.05)
    rng = np.random.default_rng(1)
    for _ in range(12):
        place = rng.uniform([-0.6, -0.6, -0.3], [0.6, 0.6, 0.3])
        wanted = np.hypot(np.hypot(*place[:2]) - 0.35, place[2]) - 0.15 - 0.05
        found = between(torus, small, place, Rotation.identity())
        if wanted > -0.09:  # the ball's surface is not yet beyond the middle of the tube
            assert found.apart[0] == pytest.approx(wanted, abs=2e-4)  # the mesh's facets
            assert found.surely[0] <= found.apart[0]


@pytest.mark.parametrize("first", [[0, 1, 2], [0, 2, 1]])
@pytest.mark.parametrize("below", [False, True])
def test_what_is_beside_a_seam_folded_flat_is_not_in_the_body(first, below):
    """A cube with a hem of no thickness around its foot, as reconstructed bodies have: of its two layers, equally near,
    one faces the other way."""
    cube = primitives.box((0.2, 0.2, 0.2))
    hem = np.array([[-0.5, -0.4, -0.1], [0.5, -0.4, -0.1], [0.0, 0.6, -0.1]])
    layers = np.array([first, first[::-1]]) + len(cube.vertices)
    hemmed = replace(mesh(cube), mesh=Mesh(np.concatenate([cube.vertices, hem]), np.concatenate([cube.faces, layers])))
    ball = analytic_shape("sphere", radius=0.02)
    side = -1 if below else 1
    found = between(hemmed, ball, [0.0, 0.3, -0.1 + 0.023 * side], Rotation.identity())
    assert found.apart[0] == pytest.approx(0.003, abs=1e-5)
    inside = between(hemmed, ball, [0.0, 0.0, 0.115], Rotation.identity())
    assert inside.apart[0] == pytest.approx(-0.005, abs=1e-4)


@pytest.mark.parametrize(
    ("first", "height", "turn", "scale", "apart", "within"),
    [
        # The cube's point that is nearest to the centre of the ball of 1 m lies at z = 0.05.
        (BALL, 0.1, Rotation.identity(), 4.0, -0.95, 1e-3),
        (CUBE, 0.2, about("z", 30), 2.0, 0.05, 1e-5),
    ],
    ids=["swallowed", "above"],
)
def test_scales_count_and_a_body_swallowed_by_another_is_deep_in_it(first, height, turn, scale, apart, within):
    found = between(first, CUBE, [0.0, 0.0, height], turn, scale=(scale, 1.0))
    assert found.apart[0] == pytest.approx(apart, abs=within)


# --- overlap ---


def crossing(apart: float) -> Scene:
    upper = make_body("upper", 0, [0.1, -0.03, 0.35 + apart], quat_xyzw=about("z", 90).as_quat())
    return Scene((STICK,), (static("lower", 0, [0, 0, 0.3]), upper), np.zeros(3), 1.0)


def test_sticks_in_each_other_are_told_with_their_depth():
    for depth in (0.001, 0.01, 0.02):
        verdict = judged(crossing(-depth), still(crossing(-depth)))
        assert verdict.overlap.metres == pytest.approx(depth, rel=0.02)
        assert verdict.overlap.part == pytest.approx(depth / 0.05, rel=0.02)
        assert {verdict.overlap.first, verdict.overlap.second} == {"lower", "upper"}
        assert verdict.broken[0].startswith("overlap: ")
    for scene in (crossing(0.0), crossing(-0.0004), crossing(0.001)):
        assert judged(scene, still(scene)).broken == ()


def test_a_stick_that_passes_through_another_is_told_with_few_frames_measured():
    scene = crossing(0.0)
    place = np.broadcast_to(np.stack([b.position for b in scene.bodies]), (41, 2, 3)).copy()
    place[:, 1, 2] -= np.linspace(0, 0.12, 41)
    shares: list[float] = []
    told = judged(
        scene, motion(scene, place, np.zeros_like(place)), every=6, on_progress=lambda share, line: shares.append(share)
    )
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert told.frames < 10 and told.overlap is not None and told.overlap.part > 0.1


def test_bodies_that_may_not_touch_may_be_in_each_other():
    scene = crossing(-0.02)
    apart = replace(scene, bodies=(scene.bodies[0], replace(scene.bodies[1], collides_with=())))
    assert judged(apart, still(apart)).overlap is None


def test_what_an_impact_sinks_in_within_a_step_is_no_overlap():
    """A ball at 3 m/s may be 3 cm into the floor when a step of 10 ms ends: it is stopped in the next."""
    scene = Scene((BALL, PLANE), (make_body("ball", 0, [0, 0, 0.25]), static("floor", 1, [0, 0, 0])), G, 1.0)
    rollout = still(scene)
    rollout.position[2, 0, 2] -= 0.02
    rollout.velocity[2, 0, 2] = -3.0
    assert judged(scene, rollout).overlap is None
    rollout.velocity[2, 0, 2] = 0.0
    told = judged(scene, rollout).overlap
    assert told is not None and told.metres == pytest.approx(0.02, rel=1e-3)


# --- floating ---


def above(shape: Shape, gap: float, gravity: np.ndarray = G) -> Scene:
    ball = make_body("ball", 1, [0.3, 0.2, 0.1 + 0.25 + gap])
    return Scene((shape, BALL), (static("slab", 0, [0, 0, 0]), ball), gravity, 1.0)


SLAB = mesh(primitives.box((4.0, 4.0, 0.2)))


@pytest.mark.parametrize("gap", [0.003, 0.014, 0.03])
def test_a_ball_that_rests_on_air_is_told_with_its_gap(gap):
    verdict = judged(above(SLAB, gap), still(above(SLAB, gap)))
    assert verdict.floating.metres == pytest.approx(gap, rel=0.05)
    assert (verdict.floating.first, verdict.floating.second) == ("ball", "slab")
    assert verdict.broken[0].startswith("floating: 'ball'")


@pytest.mark.parametrize("gap", [0.0, 0.0002, -0.0005])
def test_a_ball_that_rests_on_the_slab_is_not(gap):
    assert judged(above(SLAB, gap), still(above(SLAB, gap))).floating is None


def test_a_body_held_with_nothing_near_is_told():
    verdict = judged(above(SLAB, 2.0), still(above(SLAB, 2.0)))
    assert verdict.floating is not None and verdict.floating.second == ""
    assert "nothing is near" in verdict.broken[0]


@pytest.mark.parametrize(("hits", "told"), [(True, False), (False, True)])
def test_gravity_may_act_for_longer_only_after_a_touch(hits, told):
    """The velocity of a body that has just been touched may be half an inner step old."""
    scene, longer = above(SLAB, 0.0), 9.81 * DT * np.array([0.0, 1.4, 1.0, 1.0])
    speed = (0.8 if hits else 0.0) - np.cumsum(longer)
    speeds = np.concatenate([[-1.0], speed]) if hits else np.concatenate([[0.0], speed])
    heights = 0.35 + (np.array([0.001, 0.006, 0.01, 0.014, 0.017]) if hits else np.full(5, 1.0))
    place, velocity = np.zeros((5, 2, 3)), np.zeros((5, 2, 3))
    place[:, 1], velocity[:, 1, 2] = [0.3, 0.2, 0.0], speeds
    place[:, 1, 2] = heights
    assert (judged(scene, motion(scene, place, velocity)).floating is not None) == told


def test_a_ball_that_turns_back_before_it_touches_is_told():
    small = mesh(primitives.sphere(0.1, 4))
    big = analytic_shape("sphere", radius=0.21)
    scene = Scene((small, big), (static("small", 0, [0, 0, 0]), make_body("big", 1, [-0.36, 0, 0])), np.zeros(3), 1.0)
    x = np.concatenate([np.linspace(-0.36, -0.33, 16), np.linspace(-0.33, -0.36, 16)[1:]])  # they touch at -0.31
    place = np.zeros((len(x), 2, 3))
    place[:, 1, 0] = x
    velocity = np.zeros_like(place)
    velocity[:, 1, 0] = np.where(np.arange(len(x)) <= 15, 0.2, -0.2)
    verdict = judged(scene, motion(scene, place, velocity))
    assert verdict.floating.metres == pytest.approx(0.02, abs=2e-3)


def test_a_ring_that_hangs_on_a_rod_it_does_not_touch_is_told():
    ring, rod = mesh(primitives.torus(0.5, 0.1, 96, 48)), analytic_shape("capsule", radius=0.392, height=10.0)
    hung = Scene((rod, ring), (static("rod", 0, [0, 0, 0]), make_body("ring", 1, [0, 0, 1.0])), G, 1.0)
    verdict = judged(hung, still(hung))
    # The mesh's tube has its vertices on the torus, so that its inside is up to 0.1 (1 - cos(pi / 48)) farther out.
    assert verdict.floating is not None and verdict.floating.metres == pytest.approx(0.008, rel=0.1)


# --- energy ---


def rolling(speed: np.ndarray) -> tuple[Scene, Rollout]:
    """A can that rolls along x on a plane at `speed` [T+1] m/s."""
    can = make_body("can", 0, [0, 0, 0.05], quat_xyzw=about("x", 90).as_quat())
    scene = Scene((CAN, PLANE), (can, static("floor", 1, [0, 0, 0])), G, 1.0)
    place = np.zeros((len(speed), 2, 3))
    place[:, 0, 0] = np.concatenate([[0.0], np.cumsum(0.5 * DT * (speed[1:] + speed[:-1]))])
    place[:, 0, 2] = 0.05
    velocity, spin = np.zeros_like(place), np.zeros_like(place)
    velocity[:, 0, 0], spin[:, 0, 1] = speed, speed / 0.05
    turned = Rotation.from_rotvec(np.outer(place[:, 0, 0] / 0.05, [0.0, 1.0, 0.0])) * about("x", 90)
    orientation = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(speed), 2, 4)).copy()
    orientation[:, 0] = turned.as_quat()
    return scene, motion(scene, place, velocity, spin=spin, orientation=orientation)


def test_a_can_that_rolls_itself_up_to_speed_is_told_however_slowly():
    speed = np.linspace(0.01, 0.57, 1001)
    verdict = judged(*rolling(speed), every=200)
    made = 0.75 * (speed[-1] ** 2 - speed[0] ** 2)  # 3/4 m v^2 of a cylinder of 1 kg
    assert verdict.energy.climb_J == pytest.approx(made, rel=1e-6)
    assert verdict.energy.worst < 0.01 < verdict.energy.climb  # no step alone would be told
    assert verdict.broken[-1].startswith("energy from nothing")


@pytest.mark.parametrize("last", [0.01, 0.5, 1.0])
def test_a_can_that_keeps_or_loses_its_speed_is_not(last):
    assert judged(*rolling(np.linspace(1.0, last, 501)), every=100).broken == ()


def test_a_gain_of_one_among_others_that_lose_is_told_by_name():
    """The scene as a whole loses energy all the time."""
    can, slow = rolling(np.linspace(0.05, 0.6, 401))
    falling = make_body("ball", 2, [5.0, 5.0, 2.0])
    scene = replace(can, shapes=(*can.shapes, BALL), bodies=(*can.bodies, falling))
    speed = np.linspace(3.0, 0.1, 401)

    def more(values: np.ndarray, last: np.ndarray) -> np.ndarray:
        return np.concatenate([values, last[:, None]], 1)

    place = np.column_stack([5 + np.cumsum(speed) * DT, np.full(401, 5.0), np.full(401, 0.25)])
    rollout = replace(
        slow,
        position=more(slow.position, place),
        velocity=more(slow.velocity, np.column_stack([speed, 0 * speed, 0 * speed])),
        angular_velocity=more(slow.angular_velocity, np.zeros((401, 3))),
        orientation=more(slow.orientation, np.tile([0.0, 0.0, 0.0, 1.0], (401, 1))),
        names=(*slow.names, "ball"),
    )
    verdict = judged(scene, rollout, every=100)
    assert verdict.energy.body == "can" and "'can'" in verdict.broken[-1]


def test_exchange_between_two_bodies_is_no_gain_of_one():
    scene = Scene((BALL,), (make_body("a", 0, [-0.5, 0, 0]), make_body("b", 0, [0.25, 0, 0])), np.zeros(3), 1.0)
    place, velocity = np.zeros((51, 2, 3)), np.zeros((51, 2, 3))
    t = DT * np.arange(51)
    velocity[:26, 0, 0], velocity[26:, 1, 0] = 1.0, 1.0  # the first gives all it has to the second at 0.25 s
    place[:, 0, 0], place[:, 1, 0] = -0.5 + np.minimum(t, 0.25), 0.25 + np.maximum(t - 0.25, 0.0)
    assert judged(scene, motion(scene, place, velocity)).broken == ()


def test_a_lift_may_lift():
    path = Waypoints(np.array([0.0, 1.0]), np.array([[0, 0, 0], [0, 0, 1.0]]), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    floor = analytic_shape("box", size=(1.0, 1.0, 0.1))
    stage = make_body("stage", 1, [0, 0, 0], motion="kinematic", mass=0.0, path=path)
    scene = Scene((CUBE, floor), (make_body("cube", 0, [0, 0, 0.1]), stage), G, 1.0)
    place, velocity = np.zeros((101, 2, 3)), np.zeros((101, 2, 3))
    place[:, 0, 2], place[:, 1, 2] = 0.1 + np.linspace(0, 1, 101), np.linspace(0, 1, 101)
    velocity[..., 2] = 1.0
    assert judged(scene, motion(scene, place, velocity)).broken == ()


def test_pulls_and_pushes_through_the_library_are_accounted_for():
    scene = Scene((CUBE,), (make_body("cube", 0, [0, 0, 0]),), np.zeros(3), 1.0)
    simulator = Simulator(scene, "solver")
    simulator["cube"].pull((2.0, 0.0, 0.0), torque=(0.0, 0.01, 0.0))
    rollout = simulator.run(steps=20)
    given = rollout.counters["energy_given"][1:].sum()
    assert given == pytest.approx(np.diff(rollout.counters["kinetic_energy"][[0, -1]])[0], rel=1e-3)
    assert judged(scene, rollout).broken == ()
    simulator = Simulator(scene, "solver")
    frames = list(simulator.frames(3, at_once=1))
    simulator["cube"].push((1.0, 0.0, 0.0))
    frames += list(simulator.frames(3, at_once=1))
    given = [float(frame.counters["energy_given"][0]) for frame in frames]
    assert given == pytest.approx([0, 0, 0, 0.5, 0, 0], abs=1e-12)  # (1 N s)^2 / 2 kg


# --- the rest ---


def test_little_time_measures_few_frames_and_the_last():
    place = np.zeros((2000, 2, 3))
    place[:, :] = np.stack([b.position for b in crossing(0.02).bodies])
    place[-1, 1, 2] -= 0.04
    verdict = judged(crossing(0.02), motion(crossing(0.02), place, np.zeros_like(place)), seconds=0.02)
    assert 1 <= verdict.frames < 2000
    assert verdict.overlap is not None and verdict.overlap.at_s == pytest.approx(DT * 1999)


@pytest.mark.parametrize("hit", [0, 700, 1300])
def test_a_fault_at_the_start_or_after_an_impact_is_told_without_any_time(hit: int):
    """Bodies that start in each other, or that a hit drives into each other, are not left to the clock."""
    scene = crossing(0.02)
    place = np.zeros((2000, 2, 3))
    place[:] = np.stack([b.position for b in scene.bodies])
    place[hit, 1, 2] -= 0.04
    velocity = np.zeros_like(place)
    velocity[:hit, 1, 2] = -np.linspace(0.0, 1.0, hit)
    rollout = motion(scene, place, velocity)
    verdicts = [judged(scene, rollout, seconds=0.0) for _ in range(2)]
    assert verdicts[0] == verdicts[1] and verdicts[0].frames == len(telling_frames(scene, rollout))
    assert verdicts[0].overlap is not None and verdicts[0].overlap.at_s == pytest.approx(DT * hit)
