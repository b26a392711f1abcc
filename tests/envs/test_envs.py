"""The Gymnasium environments keep its contract, and repeat bit for bit."""

import subprocess
import sys

import numpy as np
import pytest

import sdfsim
from sdfsim.base.errors import SdfsimError

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

import sdfsim.envs  # noqa: E402

TASKS = ("Push", "Grasp", "Drop")


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_finds_nothing_wrong(task):
    check_env(gymnasium.make(f"sdfsim/{task}-v0").unwrapped, skip_render_check=True)


def test_images_have_the_keys_that_lerobot_reads():
    env = gymnasium.make(
        "sdfsim/Push-v0", obs_type="pixels_agent_pos", render_mode="rgb_array", width=64, height=48
    )  # fmt: skip
    check_env(env.unwrapped)
    seen, _ = env.reset(seed=0)
    assert {*seen} == {"pixels", "agent_pos"} and seen["pixels"].shape == (48, 64, 3)
    later, *_, infos = env.step(np.array([1.0, 0.0], np.float32))
    assert (later["pixels"] != seen["pixels"]).any() and later["agent_pos"][0] > seen["agent_pos"][0] + 0.01
    np.testing.assert_array_equal(env.render(), later["pixels"])
    assert infos["is_success"] in (False, True) and env.unwrapped.task_description


@pytest.mark.parametrize("task", TASKS)
def test_seeds_repeat_bit_for_bit(task):
    found = []
    for threads in (1, 2):
        env = gymnasium.make_vec(
            f"sdfsim/{task}-v0", num_envs=6, vectorization_mode="vector_entry_point", threads=threads
        )
        env.reset(seed=5)
        rng = np.random.default_rng(0)
        steps = [env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)) for _ in range(45)]
        found.append([np.concatenate([part.ravel() for part in step[:4]]) for step in steps])
        assert any("final_obs" in step[4] for step in steps)  # the next episodes have begun
    np.testing.assert_array_equal(*found)


def test_one_world_is_the_first_of_many():
    one, many = gymnasium.make("sdfsim/Push-v0"), sdfsim.envs.Push(3)
    seen, _ = one.reset(seed=9)
    np.testing.assert_array_equal(many.reset(seed=9)[0][0], seen)
    for _ in range(5):
        step = one.step(np.array([0.5, 0.2], np.float32))
        np.testing.assert_array_equal(many.step(np.full((3, 2), (0.5, 0.2), np.float32))[0][0], step[0])


def pushed(env: sdfsim.envs.Push) -> np.ndarray:
    """Success of a policy by hand: around the body until the tool is behind it, then towards the goal."""
    seen, _ = env.reset(seed=0)
    reach = 10.0 * (env.half + env.radius)
    for _ in range(env.limit - 1):
        far, back = seen[:, :1], seen[:, 2:4]  # tenths of a metre, along the way to the goal and to its left
        away = np.linalg.norm(back, axis=1, keepdims=True)
        out = back / away
        side = out[:, ::-1] * (-1.0, 1.0) * np.where(out[:, 1:] >= 0.0, 1.0, -1.0)
        around = side + out * (1.4 * reach - away)
        aim = np.where(out[:, :1] < -0.95, np.minimum(1.0, far) * (1.0, 0.0) - (0.0, 1.0) * back, around)
        seen, *_, infos = env.step(np.where(far < 0.3, 0.0, aim).astype(np.float32))
    return infos["is_success"]


def test_a_policy_by_hand_pushes_the_mug_to_the_goal():
    assert pushed(sdfsim.envs.Push(16)).mean() >= 0.75


def test_any_scene_becomes_an_environment(tmp_path):
    """The tool is as large as the body is, and stands beside it."""
    scene = sdfsim.Scene(model="solver")
    scene.add("floor", plane={})
    scene.add("desk", box={"size": [1.2, 0.8, 0.7]}, position=(2, 1, 0.35), motion="static")
    scene.add("box", box={"size": [0.1, 0.12, 0.2]}, position=(2, 1, 0.8), mass=0.5)
    scene.save(tmp_path / "scene.yaml")
    env = sdfsim.envs.Push(16, scene=str(tmp_path / "scene.yaml"), body="box")
    env.reset(seed=0)
    assert np.abs(env.seen["position tool"] - (2 - 0.06 - 0.05 - 0.12, 1.0, 0.76)).max() < 0.01
    assert pushed(env).mean() >= 0.6


def beside(turn: float) -> sdfsim.envs.Push:
    """A heavy drum with a post on one side, a can on the other, and a lamp high above."""
    scene = sdfsim.Scene(model="solver")
    scene.add("table", box={"size": [1.2, 1.2, 0.04]}, position=(0, 0, -0.02), motion="static")
    places = {"drum": (0, 0), "post": (0.25, 0.02), "can": (-0.01, -0.2), "lamp": (0.01, 0.0)}
    for name, (x, y) in places.items():
        radius, height = (0.12, 0.2) if name == "drum" else (0.05, 0.1)
        place = (x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), height / 2)
        up = 0.5 * (name == "lamp")
        scene.add(name, cylinder={"radius": radius, "height": height}, position=np.add(place, (0, 0, up)), mass=1.7)
    return sdfsim.envs.Push(16, scene=scene, body="drum")


@pytest.mark.parametrize("quarter", range(4))
def test_goals_and_starts_are_where_nothing_else_stands(quarter):
    env = beside(quarter * np.pi / 2)
    free = np.array([[-0.15, 0.07], [-0.02, 0.15]])  # of x and y, a centimetre from both
    turned = [free, np.stack([-free[1, ::-1], free[0]]), -free[:, ::-1], np.stack([free[1], -free[0, ::-1]])][quarter]
    np.testing.assert_allclose(np.transpose(env.goal), turned, atol=1e-9)
    env.reset(seed=0)
    starts = env.seen["position drum"][:, :2]
    assert (starts >= np.maximum(turned[:, 0], -0.1) - 1e-9).all() and (starts <= np.minimum(turned[:, 1], 0.1)).all()


def test_a_heavy_body_is_pushed_too():
    assert pushed(beside(0.0)).mean() >= 0.75


@pytest.mark.parametrize(
    ("act", "told"),
    [
        (lambda: sdfsim.envs.Push(1, obs_type="rgb"), "obs_type: must be one of state, pixels"),
        (lambda: sdfsim.envs.Push(1, body="cup"), "body: 'cup' is none that moves"),
        (lambda: sdfsim.envs.Push(2).step(np.zeros(2)), r"actions: must be \[2, 2\] \(got \[2\]\)"),
    ],
)
def test_wrong_input_is_one_clear_line(act, told):
    with pytest.raises(SdfsimError, match=told):
        act()


def test_sdfsim_itself_does_not_load_gymnasium():
    code = "import sys, sdfsim; sdfsim.Batch; assert 'gymnasium' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
