"""The live page in a real browser: a body is dragged off a table, a ball is thrown, and reset restores the start."""

import time

import numpy as np
import pytest

from sdfsim import Simulator, export, load_scene
from sdfsim.apps.play import play
from tests.helpers.browser import Browser

pytestmark = pytest.mark.gate
VASE = (735, 270)  # px, where the first view of the sample shows it


def test_a_vase_is_dragged_off_and_falls_a_ball_is_thrown_and_reset_restores_bits(tmp_path):
    with play("knocked_vase", paused=True) as playing, Browser(tmp_path / "profile") as browser:
        session, vase = playing.session, playing.simulator["vase"]
        start = session.call(lambda: session.simulator.state).arrays()
        browser.open(playing.address)
        browser.wait("document.querySelector('canvas') != null")
        time.sleep(8.0)  # until it is drawn
        session.call(session.delete, "ball")
        session.call(lambda: session.pause(paused=False))
        browser.move(*VASE)
        browser.press(*VASE)
        for k in range(40):
            browser.move(VASE[0] - 8 * k, VASE[1] + 3 * k, down=True)
            time.sleep(0.05)
        assert "vase" in session.hands and playing.page.picked == "vase"
        browser.press(VASE[0] - 312, VASE[1] + 117, down=False)
        end = time.monotonic() + 60
        while vase.centre[2] > 0.4 or session.hands:
            assert time.monotonic() < end, f"the vase is still at {vase.centre}"
            time.sleep(0.2)
        browser.click(600, 390, held=8)
        while not any(body.name == "thrown ball" for body in session.simulator.scene.bodies):
            assert time.monotonic() < end + 30, "no ball"
            time.sleep(0.2)
        session.call(lambda: session.pause(paused=True))
        session.call(session.reset)
        arrays = session.call(lambda: session.simulator.state).arrays()
        assert all(np.array_equal(arrays[name], start[name]) for name in start)
        assert session.broken == [] and browser.errors == []


# Puts the viewer of the page in reach: the first value of a React context that has poses.
FIND = """(() => {
  const root = document.getElementById("root");
  const all = [root[Object.keys(root).find((key) => key.startsWith("__reactContainer"))].stateNode.current];
  while (all.length) {
    const fiber = all.pop(), value = fiber?.memoizedProps?.value;
    if (value?.mutable?.current?.nodePoseData) return (window.viewer = value.mutable.current), true;
    if (fiber) all.push(fiber.sibling, fiber.child);
  }
})()"""
SEEK = """(() => {{
  const field = document.querySelector("input");
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, "{time:.6f}");
  field.dispatchEvent(new Event("input", {{ bubbles: true }}));
}})()"""


def test_a_run_in_one_file_plays_from_disk_without_a_network(tmp_path):
    scene = load_scene("knocked_vase")
    rollout = Simulator(scene).run(seconds=1.0)
    rollout.save(tmp_path / "rollout.npz")
    page = tmp_path / "run.html"
    export(tmp_path / "rollout.npz", page, scene_file="knocked_vase")
    assert page.stat().st_size < 5e6
    with Browser(tmp_path / "profile", size=(320, 240)) as browser:
        browser.offline()
        browser.open(page.as_uri())
        browser.wait("document.querySelector('input') != null")
        browser.wait(FIND)
        browser.value("document.querySelector('[aria-label=\"Show scene tree\"]').click()")
        browser.wait("document.body.innerText.includes('vase')")
        for k in np.linspace(len(rollout) - 2, 1, 10).astype(int):
            browser.value(SEEK.format(time=rollout.time[k] + 1e-5))
            place = rollout.position[k, [body.name for body in scene.bodies].index("vase")]
            seen = "window.viewer.nodePoseData['/vase'].position"
            browser.wait(f"Math.hypot(...{seen}.map((x, i) => x - {place.tolist()}[i])) < 1e-5")
            for row, body in enumerate(scene.bodies[1:], 1):
                found = browser.value(f"window.viewer.nodePoseData['/{body.name}']")
                np.testing.assert_allclose(found["position"], rollout.position[k, row], atol=1e-5)
                np.testing.assert_allclose(np.roll(found["wxyz"], -1), rollout.orientation[k, row], atol=1e-5)
        assert browser.errors == []
