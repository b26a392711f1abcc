"""Recordings of jointed bodies: what is seen is made such that the joints hold, and nothing else is changed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from sdfsim.apps.identify.parameters import Problem
from sdfsim.apps.identify.residuals import Windows
from sdfsim.apps.observed import cleaned, flying_trees, held_together, with_velocities
from sdfsim.scene.builder import SceneBuilder

ORIGIN, AXIS = np.array([0.05, 0.02, 0.0]), np.array([0.0, 0.6, 0.8])


def scene(kind: str):
    made = SceneBuilder().add("floor", plane={})
    made.add("child", box={"size": [0.1, 0.05, 0.05]}, position=(0.1, 0, 0), mass=1)
    made.add("base", box={"size": [0.1, 0.05, 0.05]}, mass=1)
    axis = {} if kind in ("ball", "fixed") else {"axis": AXIS}
    return made.join("joint", kind, "child", "base", anchor=ORIGIN, **axis).load()


def motion(kind: str, time: np.ndarray):
    """Positions, rotations, velocities and angular velocities of the child and of the base: in closed form, but for
    derivatives by differences."""

    def at(t: float):
        base = Rotation.from_rotvec([0.3 * t, -0.8 * t, 0.5 * t + 0.2])
        place = np.array([0.4 * t, 0.1 - t, 0.3 * t * t])
        own = {
            "hinge": Rotation.from_rotvec(AXIS * np.sin(2 * t)),
            "ball": Rotation.from_rotvec([0.5 * t, np.sin(t), 0.3]),
        }.get(kind, Rotation.identity())
        slide = AXIS * 0.05 * np.sin(3 * t) if kind == "slider" else np.zeros(3)
        child = base * own
        return place + base.apply(ORIGIN + slide) + child.apply(np.array([0.1, 0, 0]) - ORIGIN), child, place, base

    poses = [at(t) for t in time]
    step = 1e-6
    ahead, behind = [at(t + step) for t in time], [at(t - step) for t in time]
    places = np.array([[p[0], p[2]] for p in poses])
    turns = np.array([[p[1].as_quat(), p[3].as_quat()] for p in poses])
    speeds = np.array([[(a[k] - b[k]) / (2 * step) for k in (0, 2)] for a, b in zip(ahead, behind, strict=True)])
    spins = np.array(
        [[(a[k] * b[k].inv()).as_rotvec() / (2 * step) for k in (1, 3)] for a, b in zip(ahead, behind, strict=True)]
    )
    return places, turns, speeds, spins


@pytest.mark.parametrize("kind", ["hinge", "slider", "ball", "fixed"])
def test_what_joints_allow_stays_as_it_was_seen(kind: str) -> None:
    known = motion(kind, np.linspace(0.0, 2.0, 9))
    for one, other in zip(held_together(known, scene(kind)), known, strict=True):
        if one.shape[-1] == 4:
            assert np.abs((one * other).sum(-1)) == pytest.approx(1.0, abs=1e-9)
        else:
            assert one == pytest.approx(other, abs=1e-8)


@pytest.mark.parametrize("kind", ["hinge", "slider", "ball", "fixed"])
def test_what_joints_do_not_allow_is_taken_away(kind: str) -> None:
    rng = np.random.default_rng(0)
    places, turns, speeds, spins = motion(kind, np.linspace(0.0, 2.0, 9))
    shaken = (
        places + rng.normal(size=places.shape) * 1e-3,
        (Rotation.from_rotvec(rng.normal(size=(18, 3)) * 1e-3) * Rotation.from_quat(turns.reshape(-1, 4)))
        .as_quat()
        .reshape(turns.shape),
        speeds + rng.normal(size=speeds.shape) * 1e-2,
        spins + rng.normal(size=spins.shape) * 1e-2,
    )
    place, turn, speed, spin = held_together(shaken, scene(kind))
    assert place == pytest.approx(places, abs=0.01) and turn[:, 1] == pytest.approx(shaken[1][:, 1])
    child, base = (Rotation.from_quat(turn[:, k]) for k in (0, 1))
    ends = [place[:, 0] + child.apply(ORIGIN - [0.1, 0, 0]), place[:, 1] + base.apply(ORIGIN)]
    fast = [speed[:, k] + np.cross(spin[:, k], ends[k] - place[:, k]) for k in (0, 1)]
    along = base.apply(AXIS)
    if kind == "slider":
        gap, rate = ends[0] - ends[1], fast[0] - (speed[:, 1] + np.cross(spin[:, 1], ends[0] - place[:, 1]))
        assert np.cross(gap, along) == pytest.approx(0.0, abs=1e-12)
        assert np.cross(rate, along) == pytest.approx(0.0, abs=1e-12)
    else:
        assert ends[0] == pytest.approx(ends[1], abs=1e-12) and fast[0] == pytest.approx(fast[1], abs=1e-12)
    if kind == "hinge":
        assert child.apply(AXIS) == pytest.approx(along, abs=1e-12)
        assert np.cross(spin[:, 0] - spin[:, 1], along) == pytest.approx(0.0, abs=1e-12)
    if kind in ("slider", "fixed"):
        assert (child.inv() * base).magnitude() == pytest.approx(0.0, abs=1e-9)


def test_friction_and_damping_of_a_pendulum_are_those_that_repeat_it_best() -> None:
    """The motion is that of the equation of a physical pendulum, solved by SciPy."""
    mass, arm, pull, friction, damping = 1.0, 0.15, 9.81, 0.04, 0.03
    size = np.array([0.3, 0.04, 0.04])
    inertia = mass * ((size[0] ** 2 + size[2] ** 2) / 12.0 + arm**2)

    def slope(_: float, state: np.ndarray) -> list[float]:
        angle, rate = state
        drag = damping * rate + friction * np.tanh(rate / 1e-3)
        return [rate, (mass * pull * arm * np.sin(angle + np.pi / 2) - drag) / inertia]  # of a beam that begins level

    dt, count = 0.01, 120
    found = solve_ivp(slope, (0.0, dt * count), [-0.2, 0.0], t_eval=dt * np.arange(count), rtol=1e-9, atol=1e-10)
    assert np.abs(found.y[1]).max() > 3.0 and np.sum(np.diff(np.sign(found.y[1])) != 0) >= 1
    beam = Rotation.from_rotvec(found.y[0][:, None] * [0.0, 1.0, 0.0])
    rng = np.random.default_rng(0)  # a tracker's noise
    seen = Rotation.from_rotvec(1e-3 * rng.normal(size=(count, 3))) * beam
    place = beam.apply([arm, 0.0, 0.0]) + np.array([0, 0, 2.0]) + 1e-4 * rng.normal(size=(count, 3))
    poses = np.concatenate([place, seen.as_quat()], 1)[:, None]
    made = SceneBuilder(gravity=[0, 0, -pull], model="solver", effects={"sleep": "off"})
    made.add("beam", box={"size": size}, position=(arm, 0, 2), mass=mass)
    made.join("pin", "hinge", "beam", anchor=(0, 0, 2), axis=(0, 1, 0))
    scene = made.load()
    recordings = with_velocities([cleaned("swing", dt, poses, scene)], scene)
    assert recordings[0].known.mean() > 0.5 and not recordings[0].flying.any()
    problem = Problem(recordings, scene)
    begin = [(0, int(t)) for t in np.flatnonzero(recordings[0].known[:60])[::20]]
    windows = Windows(problem, 0.6, begin)
    for kind in ("joint_friction", "joint_damping"):
        problem._add(kind, "pin", [], 0.0, 0.0, axis=0)
    hefts = np.array([problem.heft(problem.joints[0], kind) for kind in ("joint_friction", "joint_damping")])

    def off(friction: float, damping: float) -> float:
        return float(np.sqrt(np.mean(windows.errors(np.array([friction, damping]) / hefts) ** 2)))

    best = off(friction, damping)
    for other in ((0.0, damping), (2.0 * friction, damping), (friction, 0.0), (friction, 2.0 * damping)):
        assert off(*other) > 1.5 * best, (other, off(*other), best)


def thrown(dt: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses [T, 2, 7] and velocities [T, 2, 6] (along, turning) of the child and the base of `scene("hinge")` that
    MuJoCo throws."""
    import mujoco

    spec, fine = mujoco.MjSpec(), 20
    spec.option.timestep, spec.option.integrator = dt / fine, mujoco.mjtIntegrator.mjINT_RK4
    size = [0.05, 0.025, 0.025]
    base = spec.worldbody.add_body(name="base", pos=[0, 0, 1])
    base.add_freejoint()
    base.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, mass=1, contype=0, conaffinity=0)
    child = base.add_body(name="child", pos=[0.1, 0, 0])
    child.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, mass=1, contype=0, conaffinity=0)
    child.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, pos=ORIGIN - [0.1, 0, 0], axis=AXIS)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[:] = [0.3, -0.2, 1.0, 3.0, -5.0, 2.0, 8.0]
    poses, speeds = np.empty((count, 2, 7)), np.empty((count, 2, 6))
    for t in range(count):
        mujoco.mj_forward(model, data)
        for d, name in enumerate(("child", "base")):
            body = data.body(name)
            poses[t, d] = [*body.xpos, *np.roll(body.xquat, -1)]
            speed = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body(name).id, speed, 0)
            speeds[t, d] = [*speed[3:], *speed[:3]]
        mujoco.mj_step(model, data, fine)
    return poses, speeds


def test_bodies_on_a_hinge_that_were_thrown_have_the_velocities_of_their_flight() -> None:
    dt, count = 1.0 / 148.0, 24
    poses, speeds = thrown(dt, count)
    rng = np.random.default_rng(0)  # a tracker's noise
    poses[..., :3] += 1e-4 * rng.normal(size=(count, 2, 3))
    shaken = Rotation.from_rotvec(2e-3 * rng.normal(size=(2 * count, 3)))
    poses[..., 3:] = (shaken * Rotation.from_quat(poses[..., 3:].reshape(-1, 4))).as_quat().reshape(count, 2, 4)
    made = scene("hinge")
    assert flying_trees(made) == [[0, 1]]
    (found,) = with_velocities([cleaned("throw", dt, poses, made)], made)
    assert found.flying.all() and found.known.all()
    assert found.velocity == pytest.approx(speeds[..., :3], abs=0.006)
    assert found.angular_velocity == pytest.approx(speeds[..., 3:], abs=0.08)


def test_bodies_that_something_turns_in_a_flight_keep_what_is_seen_nearby() -> None:
    dt, count = 1.0 / 148.0, 40
    poses, _ = thrown(dt, count)
    place, turn = poses[..., :3], Rotation.from_quat(poses[..., 3:].reshape(-1, 4))
    middle = place.mean(1, keepdims=True)
    twist = Rotation.from_rotvec(np.repeat(2.0 * np.sin(25.0 * dt * np.arange(count)), 2)[:, None] * [0.0, 0.0, 1.0])
    place = middle + twist.apply((place - middle).reshape(-1, 3)).reshape(place.shape)
    poses = np.concatenate([place, (twist * turn).as_quat().reshape(count, 2, 4)], -1)
    (found,) = with_velocities([cleaned("twist", dt, poses, scene("hinge"))], scene("hinge"))
    assert not found.flying.any()
