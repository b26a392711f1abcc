"""Other engines run everyday scenes as ours does: they move as closed forms say, and what they cannot express or
finish is told, not failed."""

from collections.abc import Iterator
from dataclasses import replace
from math import radians, sin

import numpy as np
import pytest

pytest.importorskip("pybullet")
pytest.importorskip("mujoco")

from benchmarks import everyday as bench
from benchmarks.engines import bullet, drake, mujoco, newton, rapier
from benchmarks.everyday import (
    ENGINES,
    GROUPS,
    OURS,
    NotRun,
    counted,
    is_installed,
    judged,
    runner,
    table,
    unknown_to,
)
from sdfsim.base.errors import SdfsimError
from sdfsim.evaluation import engines
from sdfsim.evaluation.engines import by_model, start_of_scene, still
from sdfsim.evaluation.laws import hard_cases
from sdfsim.evaluation.laws.scenes import UNIT, Check, G, Law, Put, Setting, about, fixed, floor, most, near, run, solid
from sdfsim.evaluation.laws.table import ROWS
from sdfsim.learned.model import load_model
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Joint, Scene
from sdfsim.simulate.steppers import stepper_of
from tests.helpers.scene_files import SCENE

FAST = ["PyBullet", "MuJoCo"]
INSTALLED = [name for name in ENGINES if name != OURS and is_installed(name)]
CUBE, BALL = solid("analytic", "box", 1, 1, 1), solid("analytic", "ball", 0.5)


def scene_of(*bodies: Put) -> Scene:
    """What `run` makes of bodies."""
    seen = []

    def kept(scene: Scene, seconds: float):
        seen.append(scene)
        return still(scene, seconds)

    run(Setting(by=kept), "", bodies, 0.1)
    return seen[0]


@pytest.mark.parametrize("name", INSTALLED)
@pytest.mark.parametrize(("size", "yaw"), [(0.1, 0.0), (0.02, 37.0), (1.0, 121.0)])
def test_a_thrown_body_flies_and_turns(tmp_path, name, size, yaw):
    put = Put("it", CUBE, [1, 2, 50], v=[1, 0, 2], w=[0, 0, 3])
    ran = run(Setting(size, yaw, by=runner(name, tmp_path)), "it", [put, floor()], 0.4)
    t = ran.seconds[-1]
    assert t == pytest.approx(0.4, abs=0.02)
    # An inner step of 1.3 ms at 10 cm puts the fall off by at most g t / 2 of it.
    wanted = np.array([1, 2, 50]) + np.array([t, 0, 2 * t - G * t * t / 2]) / UNIT
    np.testing.assert_allclose(ran.place("it")[-1], wanted, atol=0.5 * G * t * 0.0015 / UNIT)
    np.testing.assert_allclose(ran.turned("it")[-1], [0, 0, 3 * t], atol=0.01)
    np.testing.assert_allclose(ran.w("it")[-1], [0, 0, 3], atol=0.01)
    np.testing.assert_allclose(ran.v("it")[-1], [1, 0, 2 - G * t], atol=0.04)
    assert np.array_equal(ran.place("floor"), np.zeros((len(ran.time), 3)))
    assert not ran.verdict.broken


@pytest.mark.parametrize("name", INSTALLED)
@pytest.mark.parametrize("ground", [floor(), fixed("box", solid("analytic", "box", 40, 20, 1), [0, 0, -0.5])])
@pytest.mark.parametrize("mu", [0.3, 0.5])
def test_friction_is_the_product_on_floors_and_on_static_bodies(tmp_path, name, ground, mu):
    slab = Put("it", solid("analytic", "box", 2, 2, 0.3), [0, 0, 0.15], v=[1.5, 0, 0], mu=mu)
    ran = run(Setting(by=runner(name, tmp_path)), "it", [slab, ground], 1.0)
    assert ran.place("it")[-1, 0] == pytest.approx(1.5**2 / (2 * mu * G) / UNIT, rel=0.03)


@pytest.mark.parametrize("name", FAST)
@pytest.mark.parametrize("e", [0.3, 0.6, 0.9])
def test_restitution_is_the_product_on_floors_and_on_static_bodies(tmp_path, name, e):
    """MuJoCo's springs take some steps, in which gravity acts."""
    ball, box = Put("it", BALL, [0, 0, 1.5], e=e), fixed("box", solid("analytic", "box", 10, 10, 1), [0, 0, -0.5])

    def rebound(ground: Put) -> float:
        return float(run(Setting(by=runner(name, tmp_path)), "it", [ball, ground], 0.3).v("it")[:, 2].max())

    assert rebound(box) == pytest.approx(rebound(floor()), rel=0.02)
    assert rebound(box) == pytest.approx(e * (2 * G * 1.0 * UNIT) ** 0.5, rel=0.2)


@pytest.mark.parametrize("name", FAST)
def test_cylinders_and_capsules_are_round(tmp_path, name):
    """On two degrees a prism of 32 sides stays where it is; a round body rolls with g sin a / (1 + k^2)."""
    radius, slope = 0.5, 2.0
    for form, k2 in (("cylinder", 0.5), ("capsule", None)):
        shape = solid("analytic", form, radius, 2.0)
        if k2 is None:
            k2 = shape.inertia[2, 2] / shape.volume / radius**2
        put = Put("it", shape, [0, 0, radius], about("x", 90), mu=1.0)
        ran = run(Setting(by=runner(name, tmp_path)), "it", [put, floor()], 1.0, tilt=slope)
        wanted = 0.5 * G * sin(radians(slope)) / (1 + k2) * ran.seconds[-1] ** 2 / UNIT
        assert ran.place("it")[-1, 0] == pytest.approx(wanted, rel=0.03)
        assert ran.place("it")[:, 2] == pytest.approx(radius, abs=0.005)


@pytest.mark.parametrize("name", FAST)
@pytest.mark.parametrize("form", ["cylinder", "capsule"])
def test_cylinders_and_capsules_are_as_long_as_they_are(tmp_path, name, form):
    """One between two walls that leave a fiftieth of its length free flies on to one of them, and no farther."""
    shape, wall = solid("analytic", form, 0.5, 2.0), solid("analytic", "box", 4, 4, 1)
    walls = [fixed(f"wall {side}", wall, [0, 0, side * 1.52]) for side in (-1, 1)]
    put = Put("it", shape, [0, 0, 0], v=[0, 0, 0.1], mu=0.0)
    ran = run(Setting(by=runner(name, tmp_path)), "it", [put, *walls], 0.1, gravity=0.0)
    assert ran.place("it")[:, 2].max() == pytest.approx(0.02, abs=0.003)


def test_a_motion_that_mujoco_gives_up_is_reported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = scene_of(Put("it", CUBE, [0, 0, 2]), floor())
    start = engines.start_of_scene(scene, tmp_path / "files")
    fast = replace(scene.bodies[0], velocity=np.array([0.0, 0.0, 1e12]))  # m/s
    with pytest.raises(SdfsimError, match="unstable"):
        mujoco(replace(start, scene=replace(scene, bodies=(fast, scene.bodies[1]))), 5)
    assert [path.name for path in tmp_path.iterdir()] == ["files"]


# --- what is not run ---


@pytest.mark.parametrize("name", FAST)
def test_bodies_on_a_path_and_tilted_planes_are_not_run_with_their_reason(tmp_path, name):
    scene = scene_of(Put("it", CUBE, [0, 0, 2]), fixed("led", CUBE, [3, 0, 0]), floor())
    led = replace(scene.bodies[1], motion="kinematic")
    tilted = replace(scene.bodies[2], quat_xyzw=about("x", 10).as_quat())
    for bodies in ((scene.bodies[0], led), (scene.bodies[0], tilted)):
        with pytest.raises(NotRun, match="level plane"):
            runner(name, tmp_path)(replace(scene, bodies=bodies), 0.1)


def row_of_three(at: Setting) -> Iterator[Check]:
    """A cube that falls for 0.2 s: as it does, twice as fast, and with an absurd one between."""
    for e, times in ((0.0, 1.0), (0.5, 1.0), (0.0, 2.0)):
        ran = run(at, "it", [Put("it", CUBE, [0, 0, 50], e=e), floor()], 0.2)
        wanted = 50 - times * 0.5 * G * ran.seconds[-1] ** 2 / UNIT
        yield near(f"e = {e:g}, {times:g} times", ran.place("it")[-1, 2], wanted, 0.0, "sizes", 0.05)
        yield most(f"e = {e:g}, {times:g} times: spin", np.abs(ran.w("it")).max(), 1e-9)


@pytest.fixture
def three(monkeypatch):
    monkeypatch.setitem(ROWS, "row", Law("row", "everyday", "", row_of_three))


def test_checks_are_those_that_hold_that_do_not_and_that_are_not_run(tmp_path, three):
    found = counted("row", Setting(), "PyBullet", tmp_path)
    assert [len(found[key]) for key in ("held", "missed")] == [5, 1] and found["not_run"] == {}
    assert found["missed"] == [f"row: e = 0, 2 times [{Setting()}]"]


def test_checks_of_a_scene_that_is_not_run_do_not_count_and_others_do(three):
    def bounceless(scene: Scene, seconds: float):
        if scene.bodies[0].restitution:
            raise NotRun("restitution")
        return by_model(scene, seconds)

    why = [(why, check.holds) for _, check, why, _ in judged("row", Setting(), bounceless)]
    assert [one for one, _ in why] == ["", "", "restitution", "restitution", "", ""]
    assert [holds for one, holds in why if not one] == [True, True, False, True]


def test_what_takes_too_long_is_not_run_and_what_breaks_is_missed(tmp_path, three, monkeypatch):
    monkeypatch.setattr(engines, "LONGEST", 0.0)
    found = counted("row", Setting(), "MuJoCo", tmp_path)
    assert found["not_run"] == {"too slow": 6} and not found["held"] and not found["missed"]

    def broken(*_):
        raise SdfsimError("a position is not finite after 3 steps")

    monkeypatch.setitem(bench.ENGINES, "MuJoCo", ("mujoco", broken))
    found = counted("row", Setting(), "MuJoCo", tmp_path)
    assert len(found["missed"]) == 6 and not found["held"] and not found["not_run"]


@pytest.mark.parametrize("name", ["Newton", "Drake"])
def test_engines_without_restitution_know_one_friction_of_all_that_move(name):
    def unknown(*bodies: Put) -> str:
        return unknown_to(name, scene_of(*bodies))

    a, b = Put("a", CUBE, [0, 0, 2], mu=0.3), Put("b", CUBE, [3, 0, 2], mu=0.3)
    level = replace(floor(), mu=0.15 if name == "Newton" else 1.0)
    assert unknown(a, level) == ""
    assert unknown(replace(a, e=0.1), level) == "restitution"
    assert unknown(replace(a, e=0.1)) == ""  # nothing to meet
    assert "several materials" in unknown(a, replace(b, mu=0.4))
    other = (replace(floor(), mu=0.1),) if name == "Newton" else (b, floor())
    assert "so different" in unknown(a, *other)
    assert unknown_to("PyBullet", scene_of(a, replace(b, mu=0.4, e=0.3), floor())) == ""


def test_the_table_counts_and_names_what_is_missed_or_absent():
    def found(held: list[str], missed: list[str], **not_run: int) -> dict:
        return {"held": held, "missed": missed, "not_run": not_run, "s": 1.0}

    results = {
        ("edges", OURS): found(["a"], [f"edges: b [{Setting()}]"]),
        ("edges", "PyBullet"): found(["a", "b"], [], slow=2),
        ("slabs", OURS): {"failed": "no memory"},
        ("slabs", "PyBullet"): found(["y"], []),
    }
    (_, *rows), notes = table(results, GROUPS["everyday"])
    others = ("not installed here",) * (len(GROUPS["everyday"]) - 2)
    assert rows == [
        ("`slabs`", "no memory", "1 / 1", *others), ("`edges`", "1 / 2", "2 / 2, 2 not run", *others),
        ("all", "1 / 2", "3 / 3, 2 not run", *others),
    ]  # fmt: skip
    assert "- edges: b" in notes and "- PyBullet: slow, 2 checks" in notes


@pytest.mark.parametrize("name", FAST)
def test_engines_are_given_no_soft_materials_and_only_mujoco_joints(name):
    scene = scene_of(Put("it", CUBE, [0, 0, 2]), floor())
    soft = replace(scene, bodies=(replace(scene.bodies[0], stiffness=1e4), scene.bodies[1]))
    held = replace(scene, joints=(Joint("hinge", "hinge", (0, -1), np.zeros(3), np.array([0.0, 0.0, 1.0])),))
    assert unknown_to(name, scene) == "" and "stiffness" in unknown_to(name, soft)
    assert unknown_to(name, held) == ("" if name == "MuJoCo" else "joints")


def started(folder, text: str = SCENE):
    (folder / "scene.yaml").write_text(text)
    scene = load_scene(folder / "scene.yaml")
    units = stepper_of(load_model("gnn", weights=False)).units(scene)
    return start_of_scene(scene, folder / "engine", units), units


@pytest.mark.parametrize("substeps", [5, 2])
@pytest.mark.parametrize(
    ("run", "package"),
    [(bullet, "pybullet"), (mujoco, "mujoco"), (rapier, "rapier3d"), (drake, "pydrake"), (newton, "newton")],
)
def test_what_rests_stays_and_steps_are_timed(tmp_path, run, package, substeps):
    pytest.importorskip(package)
    start, units = started(tmp_path)
    steps = round(0.4 / units.time / 0.02)
    motion, timing = run(start, steps, substeps)
    assert np.abs(units.length * motion.position[:, 0] - [0, 0, 0.05]).max() < 0.002
    assert timing.cpu_ms > 0 and timing.first_ms > 0


def test_an_inertia_other_than_the_engine_s_is_refused_where_a_recording_has_it(tmp_path):
    start = start_of_scene(hard_cases.wall(2), tmp_path)
    bullet(replace(start, own_inertia=False), 2)
    doubled = replace(start.motion, inertia=2 * start.motion.inertia)
    bullet(replace(start, motion=doubled), 2)
    with pytest.raises(SdfsimError, match="inertia"):
        bullet(replace(start, motion=doubled, own_inertia=False), 2)
