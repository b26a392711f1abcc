"""Free flight against closed forms and conservation laws."""

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.learned import inference
from sdfsim.physics.free_flight import torque_free
from sdfsim.scene.scene import Scene
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import angle_between, random_model

TOP = np.diag([1.0, 2.0, 3.0])[None]


def spin_state(angular: list[float]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([[0.0, 0.0, 0.0, 1.0]]), np.array([angular])


def test_symmetric_top_precesses_as_in_closed_form():
    """Of an axisymmetric body the symmetry axis turns about the angular momentum at |L| / I1."""
    inertia = np.diag([1.0, 1.0, 2.0])[None]
    q, w = spin_state([0.6, 0.0, 1.5])
    momentum = np.array([0.6, 0.0, 3.0])
    for _ in range(100):
        q, w = torque_free(q, w, inertia, 0.02)
    turn = Rotation.from_rotvec(momentum * 2.0)  # of |L| / I1, for 2 s
    axis = Rotation.from_quat(q).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(axis[0], turn.apply([0.0, 0.0, 1.0]), rtol=0, atol=1e-7)


def test_a_rotation_in_single_precision_is_one_in_double_after_a_step():
    """A quaternion that is long by rounding would stay so: products of quaternions keep the product of lengths."""
    q, w = spin_state([0.3, -1.2, 0.4])
    long = q * (1.0 + 1e-7)
    after, _ = torque_free(long, w, TOP, 0.02)
    assert abs(np.linalg.norm(after) - 1.0) < 1e-15
    assert angle_between(after, torque_free(q, w, TOP, 0.02)[0]).max() < 1e-7


def test_a_scene_without_contacts_never_calls_the_network(dropped, monkeypatch):
    model = random_model("impulse")
    monkeypatch.setattr(inference, "stepped", lambda *a, **k: (_ for _ in ()).throw(AssertionError("network called")))
    high = Scene(dropped.shapes, (dropped.bodies[0], dropped.bodies[3]), dropped.gravity, 1.0)
    rollout = Simulator(high, model).run(seconds=1.0)
    assert (rollout.contact_count == 0).all()
