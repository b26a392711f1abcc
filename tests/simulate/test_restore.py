"""A state that is kept holds all that was changed before: from it a run goes on as it went on there."""

import numpy as np
import pytest

from sdfsim import Scene, SdfsimError, Simulator, State

STEPS = 25


def resting() -> Simulator:
    """A door, a drawer and a box on a floor, all asleep; nothing but the box touches anything."""
    scene = Scene(model="solver")
    scene.add("floor", plane={}, friction=0.8)
    scene.add("box", box={"size": (0.2, 0.2, 0.2)}, position=(3, 0, 0.1), mass=2.0, restitution=0.0)
    scene.add("leaf", box={"size": (0.8, 0.04, 1.0)}, position=(0.4, 0, 1.0), mass=5.0)
    scene.add("drawer", box={"size": (0.3, 0.3, 0.1)}, position=(0, 2, 1.0), mass=3.0)
    motor = {"position_deg": 0.0, "max_force": 60.0}
    scene.join("door", "hinge", "leaf", anchor=(0, 0, 1), axis=(0, 0, 1), limits_deg=(-10, 110), motor=motor)
    scene.join("rail", "slider", "drawer", axis=(1, 0, 0), motor={"position": 0.0, "max_force": 80.0})
    made = Simulator(scene)
    made.step(made.steps_in(2.0))
    assert all(made[name].asleep for name in ("box", "leaf", "drawer"))
    return made


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return resting()


def same(one: State, other: State) -> bool:
    return same_arrays(one.arrays(), other.arrays())


def same_arrays(mine: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> bool:
    for arrays in (mine, theirs):  # behind the points of a pair there is room for more, with anything in it
        counted = np.arange(arrays["touch.point"].shape[1]) < arrays["touch.count"][:, None]
        arrays["touch.point"] = np.where(counted[:, :, None], arrays["touch.point"], 0.0)
    return mine.keys() == theirs.keys() and all(np.array_equal(mine[name], theirs[name]) for name in mine)


ACTS = {
    "target": lambda sim: setattr(sim.joint("door"), "target", 1.2),
    "target of a slider": lambda sim: setattr(sim.joint("rail"), "target", 0.3),
    "effort": lambda sim: setattr(sim.joint("door"), "effort", 3.0),
    "most and target": lambda sim: (
        setattr(sim.joint("door"), "max_force", 90.0), setattr(sim.joint("door"), "target", 0.7)
    ),
    "push": lambda sim: sim["box"].push((4.0, 0, 0)),
    "push of what is held": lambda sim: sim["leaf"].push((0, 2.0, 0)),
    "pull": lambda sim: sim["box"].pull((40.0, 0, 0)),
    "torque": lambda sim: sim["leaf"].pull(torque=(0, 0, 90.0)),
    "velocity": lambda sim: setattr(sim["drawer"], "velocity", (0.5, 0, 0)),
    "position": lambda sim: setattr(sim["box"], "position", (3, 0, 0.4)),
}  # fmt: skip


@pytest.mark.parametrize("act", ACTS)
@pytest.mark.parametrize("awake", [False, True])
def test_act_save_step_restore_step_gives_the_same_bits(simulator, act, awake, tmp_path):
    simulator.reset()
    simulator.step(7 if awake else simulator.steps_in(2.0))
    assert simulator["leaf"].asleep is not awake
    before = simulator.state
    ACTS[act](simulator)
    kept = simulator.state
    simulator.step(STEPS)
    first = simulator.state
    assert any(not np.array_equal(getattr(first, name), getattr(before, name)) for name in ("position", "orientation"))
    simulator.restore(kept)
    simulator.step(STEPS)
    assert same(simulator.state, first)

    other = Simulator(simulator.scene)
    other.restore(State.read(kept.save(tmp_path / "kept.npz")))
    other.step(STEPS)
    assert same(other.state, first)


@pytest.mark.parametrize("what", ["load", "target"])
def test_a_state_that_pulls_or_drives_otherwise_wakes_what_it_moves(simulator, what):
    simulator.reset()
    simulator.step(simulator.steps_in(2.0))
    from dataclasses import replace

    asleep, other = simulator.state, Simulator(simulator.scene)
    other.restore(asleep)
    ACTS["pull" if what == "load" else "target"](other)
    told = other.state
    new = {"load": told.load} if what == "load" else {"joints": told.joints}
    simulator.state = replace(asleep, **new)
    simulator.step(STEPS)
    name = "box" if what == "load" else "leaf"
    assert np.linalg.norm(simulator[name].centre - other[name].centre) > 0.01


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda sim: sim.step(), "state: must be a State.*got a Moment"),
        (lambda sim: sim.run(steps=1), "state: must be a State.*got a Rollout"),
        (lambda sim: None, "got a NoneType"),
        (lambda sim: Simulator(Scene().add("ball", sphere={"radius": 0.1})).state, "of another scene"),
    ],
)  # fmt: skip
def test_what_is_no_state_of_the_scene_is_refused(simulator, given, message):
    wrong = given(simulator)
    with pytest.raises(SdfsimError, match=message):
        simulator.restore(wrong)
    with pytest.raises(SdfsimError, match=message):
        simulator.state = wrong


def test_a_file_that_holds_no_state_is_refused(tmp_path):
    file = tmp_path / "other.npz"
    np.savez(file, a=np.zeros(3))
    with pytest.raises(SdfsimError, match=r"other\.npz: not a state of this version"):
        State.read(file)
    with pytest.raises(SdfsimError, match=r"none\.npz: no such file"):
        State.read(tmp_path / "none.npz")
