"""What bodies do that turn or move far in an inner step, by closed forms: a disc that rolls in a circle, a box on a
turntable, and balls that hit each other or the ground fast."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim import Scene, Simulator

GRAVITY = 9.81


def leaning(lean: float = np.radians(20), radius: float = 0.05, thick: float = 0.002, away: float = 0.3) -> Scene:
    """A disc that rolls in a circle, its centre `away` from the middle, at the rate at which it does not fall over
    (the steady motion of a thick disc on its lower rim)."""
    c, s, half = np.cos(lean), np.sin(lean), thick / 2
    about, across = 0.5 * radius**2, 0.25 * radius**2 + thick**2 / 12
    pull = radius * GRAVITY * s - half * GRAVITY * c
    inner = away - half * c
    rate = np.sqrt(
        pull / (c * about * inner / radius + across * c * s + radius * away * c + half * away * s)
    )  # fmt: skip
    axle, up = np.array([c, 0, s]), np.array([-s, 0, c])
    spin = -rate * inner / radius * axle + rate * c * up
    turned = Rotation.from_euler("y", np.pi / 2 - lean).as_quat()
    scene = Scene().add("floor", plane={}, friction=1.0, restitution=0.0)
    return scene.add(
        "disc", cylinder={"radius": radius, "height": thick}, position=(away, 0, radius * c + half * s),
        quat_xyzw=turned, velocity=(0, rate * away, 0), angular_velocity=spin, friction=1.0, restitution=0.0, mass=1.0,
    )  # fmt: skip


@pytest.mark.parametrize("dt", [None, 0.001])
def test_a_disc_that_leans_rolls_in_its_circle(dt):
    """And touches at its rim alone, not also at the origin of the plane."""
    simulator = Simulator(leaning(), dt=dt)
    for _ in range(40):
        simulator.run(0.025)
        centre = simulator["disc"].centre
        for point in simulator.contact_points():
            assert np.linalg.norm(np.subtract(point.point, centre)) < 0.051
    assert np.hypot(*simulator["disc"].centre[:2]) == pytest.approx(0.3, rel=0.004)
    axle = Rotation.from_quat(simulator["disc"].quat_xyzw).apply([0, 0, 1.0])
    assert np.degrees(np.arcsin(abs(axle[2]))) == pytest.approx(20.0, abs=0.2)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_box_stays_where_it_is_on_a_turntable(share):
    """Within the radius at which it would slip; once along the path of a kinematic body."""
    rate, friction, seconds = 3.0, 0.4, 5.0
    away = share * friction * GRAVITY / rate**2
    times = np.arange(0, seconds + 1, np.pi / 2 / rate)
    path = [{"time": t, "position": [0, 0, -0.05], "euler_xyz_deg": [0, 0, np.degrees(rate * t)]} for t in times]
    scene = Scene().add("table", cylinder={"radius": 1.0, "height": 0.1}, motion="kinematic", path=path, friction=1.0)
    scene.add("box", box={"size": (0.04, 0.04, 0.02)}, position=(away, 0, 0.01), velocity=(0, rate * away, 0),
              angular_velocity=(0, 0, rate), friction=friction, restitution=0.0)  # fmt: skip
    rollout = Simulator(scene).run(seconds)
    assert np.hypot(*rollout.position[-1, 1, :2]) == pytest.approx(away, rel=1e-3)


@pytest.mark.parametrize("aside", [0.5, 0.9])
@pytest.mark.parametrize("begin", np.linspace(0.2, 0.233, 5))
def test_a_ball_that_is_hit_leaves_along_the_line_of_centres(aside, begin):
    radius, speed = 0.0286, 8.0
    scene = Scene(gravity=[0, 0, 0])
    for name, place, fast in (("one", (-begin, 2 * radius * aside, 0), speed), ("other", (0, 0, 0), 0.0)):
        scene.add(name, sphere={"radius": radius}, position=place, velocity=(fast, 0, 0), friction=0.0, restitution=1.0)
    velocity = Simulator(scene).run(0.05).velocity[-1, 1]
    line = np.array([np.sqrt(1 - aside**2), -aside, 0.0])
    np.testing.assert_allclose(velocity, speed * line[0] * line, atol=0.01 * speed)


@pytest.mark.parametrize("speed", [1.0, 10.0, 30.0])
def test_a_fast_ball_with_backspin_leaves_the_ground_as_a_slow_one(speed):
    """Friction ends the slip: the closed form of a ball that rebounds with the ratio e."""
    radius, bounce = 0.02, 0.8
    scene = Scene(gravity=[0, 0, 0]).add("floor", plane={}, friction=1.0, restitution=1.0)
    spin = -0.5 * speed / radius
    scene.add("ball", sphere={"radius": radius}, position=(0, 0, 0.12), velocity=(0.7 * speed, 0, -speed),
              angular_velocity=(0, spin, 0), friction=0.9, restitution=bounce)  # fmt: skip
    rollout = Simulator(scene).run(0.2 / speed)
    slip = 0.7 * speed - radius * spin
    ahead = 0.7 * speed - 2 / 7 * slip
    assert rollout.velocity[-1, 1] == pytest.approx([ahead, 0, bounce * speed], rel=0.01, abs=1e-9)
    assert rollout.angular_velocity[-1, 1, 1] == pytest.approx(ahead / radius, rel=0.01)


@pytest.mark.parametrize("load", [0.6, 0.85, 0.93, 1.05])
def test_a_grip_holds_as_long_as_its_friction_does(load):
    """A cube between a wall and a light pusher on a slider: no corner bears all of the push."""
    force = GRAVITY / load / 0.8
    scene = Scene().add("wall", plane={"normal": [-1, 0, 0], "offset": 0}, friction=1.0, restitution=0.0)
    cube = {"size": (0.05, 0.05, 0.05)}
    scene.add("cube", box=cube, position=(-0.025, 0, 0), mass=1.0, friction=0.8, restitution=0.0)
    pusher = {"size": (0.02, 0.04, 0.04)}
    scene.add("pusher", box=pusher, position=(-0.06, 0, 0), mass=0.1, friction=1.0, restitution=0.0)
    scene.join("slider", "slider", "pusher", "world", axis=(1, 0, 0))
    simulator = Simulator(scene)
    simulator["pusher"].pull((force / 2, 0, 0))
    fallen = simulator.run(1.0).position[-1, 1, 2]
    assert (fallen > -1e-5) if load < 1.0 else (fallen < -1e-2)


INTERRUPTED = """
import os, signal, threading, time
import numpy as np
import sdfsim

stepping, many = False, 0

def stop(*_):
    if stepping:
        raise KeyboardInterrupt

def press():
    while many < 300:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.002)

simulator = sdfsim.Simulator("pile")
simulator.step()
signal.signal(signal.SIGINT, stop)
threading.Thread(target=press).start()
while many < 300:
    try:
        stepping = True
        simulator.step()
        stepping = False
    except KeyboardInterrupt:
        stepping, many = False, many + 1
assert np.isfinite(simulator.step(3).position).all()
print("went on")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
def test_interrupts_in_steps_end_no_process():
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "went on\n"), done.stderr
