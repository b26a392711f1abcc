"""`Batch`: every world moves bit by bit as a simulator of its own."""

import gc
import json
from pathlib import Path

import numpy as np
import pytest

import sdfsim
from sdfsim.base.errors import SdfsimError
from sdfsim.simulate.simulator import varied

ROOT = Path(__file__).resolve().parents[2]
WORLDS, ROUNDS, AT_ONCE = 5, 12, 7


def table() -> sdfsim.Scene:
    """A box and a cylinder beside a tool that two sliders hold."""
    scene = sdfsim.Scene()
    scene.add("table", box={"size": [1.0, 0.8, 0.04]}, position=(0, 0, -0.02), motion="static", friction=0.6)
    scene.add("box", box={"size": [0.1, 0.08, 0.06]}, position=(0.15, 0, 0.03), mass=0.3)
    scene.add("can", cylinder={"radius": 0.04, "height": 0.1}, position=(-0.2, 0.1, 0.05), mass=0.4)
    scene.add("carriage", box={"size": [0.05, 0.05, 0.05]}, position=(0, 0, 0.3), mass=0.5, collides_with=[])
    scene.add("tool", capsule={"radius": 0.02, "height": 0.1}, position=(0, 0, 0.08), mass=0.5)
    scene.join("x", "slider", "carriage", axis=(1, 0, 0), motor={"max_force": 20, "position": 0.0})
    scene.join("y", "slider", "tool", "carriage", axis=(0, 1, 0), motor={"max_force": 20, "speed": 0.0})
    scene.frame("tip", "tool", position=(0, 0, -0.07))
    return scene


def arm() -> sdfsim.Scene:
    """Motors and an effort, which lift a ball that lies in the way."""
    scene = sdfsim.Scene()
    scene.add("floor", plane={})
    scene.add("upper", capsule={"radius": 0.03, "height": 0.4}, position=(0, 0, 0.9), mass=1.0)
    scene.add("lower", capsule={"radius": 0.03, "height": 0.4}, position=(0, 0, 0.5), mass=1.0)
    scene.add("ball", sphere={"radius": 0.06}, position=(0.2, 0, 0.06), mass=0.2)
    scene.join("shoulder", "hinge", "upper", anchor=(0, 0, 1.1), axis=(0, 1, 0), motor={"max_force": 60})
    scene.join("elbow", "hinge", "lower", "upper", anchor=(0, 0, 0.7), axis=(0, 1, 0))
    return scene


def paddle() -> sdfsim.Scene:
    """A ball on a tray that follows a path."""
    scene = sdfsim.Scene()
    path = [{"time": 0.2 * k, "position": place} for k, place in enumerate(([0, 0, 0], [0.1, 0, 0.05], [0, 0, 0]))]
    scene.add("tray", box={"size": [0.5, 0.5, 0.02]}, motion="kinematic", path=path)
    scene.add("ball", sphere={"radius": 0.04}, position=(0, 0, 0.06), mass=0.2, restitution=0.5)
    return scene


def pulled(simulator: sdfsim.Simulator, kind: str, name: str, values: np.ndarray) -> None:
    """Act on a single simulator as a column of a batch does."""
    if kind in ("target", "effort"):
        setattr(simulator.joint(name), kind, float(values[0]))
    else:
        simulator[name].pull(**{kind: values})


def seen(simulator: sdfsim.Simulator) -> np.ndarray:
    """What a batch observes unless it is told otherwise."""
    moving = [simulator[b.name] for b in simulator.scene.bodies if b.motion == "dynamic"]
    found = [part for b in moving for part in (b.position, b.quat_xyzw, b.velocity, b.angular_velocity)]
    held = [simulator.joint(j.name) for j in simulator.scene.joints if j.kind in ("hinge", "slider")]
    return np.concatenate([*found, *([j.position, j.speed] for j in held)])


POSES = {"position": ((-0.25, -0.1, 0.05), (-0.15, 0.1, 0.06)), "yaw": (-3.0, 3.0), "velocity": ((0, 0, 0), (1, 0, 0))}
CASES = {
    "table": (table, ["target x", "target y", "torque box"], {"can": POSES, "table": {"friction": (0.2, 1.0)}}),
    "sizes": (table, ["force can"], {"can": {"scale": (0.7, 1.2), "mass": (0.1, 1.0)}, "box": {"scale": 1.1}}),
    "moved": (table, ["target x"], {"table": {"position": ((-0.1, 0, -0.05), (0.1, 0, -0.02))}}),
    "posed": (table, ["target x"], {"x": {"position": (-0.1, 0.1)}, "y": {"position": 0.05}}),
    "arm": (arm, ["target shoulder", "effort elbow"], {"ball": {"friction": (0.1, 0.9), "restitution": (0.0, 0.8)}}),
    "path": (paddle, ["force ball"], {"ball": {"mass": (0.1, 0.3)}}),
    "tower": ("tower", ["force brick"], {}),
    "hollow": ("knocked_vase", ["force ball"], {"vase": {"friction": (0.3, 0.9)}}),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_world_moves_as_a_simulator_does(case):
    """Worlds begin again at different times, with other bodies; some actions stay as they were."""
    made, act, vary = CASES[case]
    scene = made() if callable(made) else sdfsim.load_scene(made)
    act = [entry.replace("brick", scene.bodies[-1].name) if not callable(made) else entry for entry in act]
    batch = sdfsim.Batch(scene, WORLDS, act=act, vary=vary, seed=3)
    batch.reset()
    rng, single = np.random.default_rng(0), {}

    def begin(w: int) -> None:
        drawn = {k: v for k, v in batch.drawn[w].items() if k in batch.simulator._names}
        single[w] = sdfsim.Simulator(varied(batch.scene, drawn), units=batch.units)
        held = {name: fields["position"] for name, fields in batch.drawn[w].items() if name not in drawn}
        if held:  # all at once, so that they round alike
            single[w].move_joints({single[w].joint(name)._row: at for name, at in held.items()}, {})

    for w in range(WORLDS):
        begin(w)
    actions = np.zeros((WORLDS, sum(place.stop - place.start for place in batch.columns.values())))
    for k in range(ROUNDS):
        if k in (4, 9):
            batch.reset([1, 3])
            begin(1)
            begin(3)
        if k % 3 == 0:
            actions = 0.3 * rng.normal(size=actions.shape)
        found = batch.step(actions, AT_ONCE)
        for w in range(WORLDS):
            for entry, place in batch.columns.items():
                pulled(single[w], *entry.split(" "), actions[w, place])
            single[w].step(AT_ONCE)
            np.testing.assert_array_equal(found[w], seen(single[w]), f"world {w}, round {k}")
    assert not batch.failed.any()
    assert len(np.unique(found, axis=0)) == WORLDS


def test_the_order_of_resets_and_the_number_of_threads_change_nothing():
    """World 2 draws and moves the same, whenever others begin again and however many threads there are."""
    found = []
    for threads, order in ((1, ([0, 1, 2, 3], [2])), (2, ([3], [2], [0, 1], [2]))):
        batch = sdfsim.Batch(table(), 4, act=["target x"], vary={"can": POSES}, seed=7, threads=threads)
        for rows in order:
            batch.reset(rows)
        found.append(batch.step(np.full((4, 1), 0.1), 30)[2])
    np.testing.assert_array_equal(*found)
    assert (batch.reset([2], seed=7)[2] != found[0]).any()
    np.testing.assert_array_equal(batch.reset([2], seed=7), batch.reset([2], [batch.drawn[2]]))


def test_contact_forces_and_frames_are_those_of_the_simulator():
    scene = table()
    observe = ["force box", "force table", "position tip", "quat_xyzw tip", "velocity tip", "angular_velocity tip"]
    batch, single = sdfsim.Batch(scene, 2, act=["target x"], observe=observe), sdfsim.Simulator(scene)
    batch.reset()
    single.joint("x").target = 0.15
    seen = batch.step(np.full((2, 1), 0.15), 60)[1]
    single.step(60)
    total = {name: np.zeros(3) for name in ("box", "table")}
    for contact in single.contact_points():
        for name, sign in ((contact.first, 1.0), (contact.second, -1.0)):
            if name in total:
                total[name] += sign * contact.force
    np.testing.assert_allclose(seen[batch.observed["force box"]], total["box"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(seen[batch.observed["force table"]], total["table"], rtol=1e-9, atol=1e-12)
    weight = 9.81 * (0.3 + 0.4)
    assert seen[batch.observed["force table"]][2] == pytest.approx(-weight, rel=0.2)
    tip = single.frame("tip")
    np.testing.assert_array_equal(seen[6:], [*tip.position, *tip.quat_xyzw, *tip.velocity, *tip.angular_velocity])


def test_bodies_at_rest_sleep_and_an_action_wakes_them():
    batch = sdfsim.Batch(table(), 2, act=["force box"])
    batch.reset()
    rest = batch.step(np.zeros((2, 3)), 200)
    np.testing.assert_array_equal(batch.step(np.zeros((2, 3)), 50), rest)
    moved = batch.step(np.array([[3.0, 0, 0], [0, 0, 0]]), 20)
    assert (moved[0] != rest[0]).any() and (moved[1] == rest[1]).all()


def test_a_world_that_fails_stands_still_until_its_reset():
    batch = sdfsim.Batch(table(), 3, act=["force box"])
    start = batch.reset()
    for _ in range(3):
        seen = batch.step(np.array([[0, 0, 0], [0, 0, 1e12], [0, 0, 0]]), 50)
    assert batch.failed.tolist() == [False, True, False]
    np.testing.assert_array_equal(seen[1], start[1])
    assert np.isfinite(seen).all()
    batch.reset([1])
    assert not batch.failed.any()
    np.testing.assert_array_equal(batch.step(np.zeros((3, 3)), 20)[1], alone(20))


def alone(steps: int) -> np.ndarray:
    single = sdfsim.Simulator(table())
    single.step(steps)
    return seen(single)


def test_intervals_of_a_fit_become_ranges(tmp_path):
    report = {
        "friction": {"can": {"value": 0.4, "interval": [0.36, 0.44]}},
        "mass": {"can": {"value": 0.5, "interval": None}},
        "scene": {"can": {"friction": 0.8, "mass": 0.5}},
    }  # fmt: skip
    (tmp_path / "identify.json").write_text(json.dumps(report))
    batch = sdfsim.Batch(table(), 40, vary=tmp_path / "identify.json")
    batch.reset()
    drawn = [variant["can"]["friction"] for variant in batch.drawn]
    assert {*batch.drawn[0]["can"]} == {"friction"}
    assert 0.72 <= min(drawn) < 0.75 and 0.85 < max(drawn) <= 0.88


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"worlds": 0}, "worlds: must be a whole number above 0"),
        ({"act": ["targets x"]}, "no such kind .did you mean 'target'"),
        ({"act": ["target z"]}, "there is no joint 'z'"),
        ({"act": ["force table"]}, "'table' does not move"),
        ({"observe": ["position bax"]}, "there is no body 'bax' .did you mean 'box'"),
        ({"vary": {"box": {"colour": 1}}}, "colour: no such field"),
        ({"vary": {"box": {"mass": (0.2, 0.1)}}}, r"mass: must be a number, or a pair \(lowest, highest\)"),
        ({"vary": {"box": {"mass": (-1, 0.1)}}}, "mass: must be > 0"),
        ({"vary": {"box": {"position": (0.1, 0.2)}}}, "position: must be 3 numbers"),
        ({"vary": {"x": {"speed": 1}}}, "only the position of a hinge or slider"),
        ({"vary": {"bax": {"mass": 1}}}, "there is no body 'bax'"),
    ],
)
def test_wrong_input_is_one_clear_line(options, message):
    with pytest.raises(SdfsimError, match=message):
        sdfsim.Batch(table(), **{"worlds": 2, **options})


def test_wrong_actions_are_refused():
    batch = sdfsim.Batch(table(), 2, act=["target x"])
    for wrong in (np.zeros((2, 2)), np.zeros(2), np.full((2, 1), np.nan)):
        with pytest.raises(SdfsimError, match=r"actions: must be finite numbers \[2, 1\]"):
            batch.step(wrong)
    with pytest.raises(SdfsimError, match="a batch needs the contact solve"):
        sdfsim.Batch(sdfsim.Scene().add("ball", sphere={"radius": 0.1}, mass=1.0), 2)


def test_memory_stays_flat():
    """Ten thousand steps of worlds, and hundreds of resets with other masses."""
    batch = sdfsim.Batch(table(), 20, act=["target x"], vary={"box": {"mass": (0.1, 0.5)}})

    def pages() -> int:
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1])

    def run(rounds: int) -> None:
        for k in range(rounds):
            batch.reset(np.arange(20) % 2 == k % 2)
            batch.step(np.full((20, 1), 0.1 * (-1) ** k), 10)

    run(20)
    before = pages()
    run(50)
    assert pages() - before < 512  # 2 MiB
