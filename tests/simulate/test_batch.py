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
    path = [{"time": 0.0, "position": [0, 0, 0]}, {"time": 0.2, "position": [0.1, 0, 0.05]}, {"time": 0.4, "position": [0, 0, 0]}]
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
    "sizes": (table, ["target x", "force can"], {"can": {"scale": (0.7, 1.2), "mass": (0.1, 1.0)}, "box": {"scale": 1.1}}),
    "moved": (table, ["target x"], {"table": {"position": ((-0.1, 0, -0.05), (0.1, 0, -0.02))}, "x": {"position": (-0.1, 0.1)}}),
    "arm": (arm, ["target shoulder", "effort elbow"], {"ball": {"friction": (0.1, 0.9), "restitution": (0.0, 0.8)}}),
    "path": (paddle, ["force ball"], {"ball": {"mass": (0.1, 0.3)}}),
    "tower": ("tower", ["force brick"], {}),
    "hollow": ("knocked_vase", ["force ball"], {"vase": {"friction": (0.3, 0.9)}}),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_world_moves_as_a_simulator_does(case):
    """Worlds begin again at different times, with other bodies; some actions stay as they were, so that bodies sleep."""
    made, act, vary = CASES[case]
    scene = made() if callable(made) else sdfsim.load_scene(made)
    act = [entry.replace("brick", scene.bodies[-1].name) if not callable(made) else entry for entry in act]
    batch = sdfsim.Batch(scene, WORLDS, act=act, vary=vary, seed=3)
    batch.reset()
    rng, single = np.random.default_rng(0), {}

    def begin(w: int) -> None:
        drawn = {k: v for k, v in batch.drawn[w].items() if k in batch.simulator._names}
        single[w] = sdfsim.Simulator(varied(batch.scene, drawn), units=batch.units)
        for name, fields in batch.drawn[w].items():
            if name not in drawn:
                single[w].joint(name).position = fields["position"]

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
