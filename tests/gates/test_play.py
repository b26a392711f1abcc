"""The page of `play` in a real browser: what a person does there; and a run in one file."""

import time
from collections.abc import Callable

import numpy as np
import pytest

from sdfsim import Scene, Simulator, export, load_scene
from sdfsim.apps.play import play
from tests.helpers.browser import Browser

pytestmark = pytest.mark.gate
SIZE = (800, 600)  # px
OBJ = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
# Types a number into the field with a label.
TYPE = """(() => {{
  const label = [...document.querySelectorAll("label")].find((one) => one.innerText === "{label}");
  const field = document.getElementById(label.htmlFor);
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, "{value}");
  field.dispatchEvent(new Event("input", {{ bubbles: true }}));
}})()"""

# The middle of the tab on which one uploads.
TAB = """(() => {
  const tab = [...document.querySelectorAll("[role=tab]")].find((one) => one.innerText === "Scene");
  const at = tab.getBoundingClientRect();
  return [at.x + at.width / 2, at.y + at.height / 2];
})()"""


def tabletop() -> Scene:
    """A table that leans by four degrees, on which friction holds three things."""
    scene = Scene(model="solver").add("floor", plane={}, friction=0.8)
    lean = {"euler_xyz_deg": (0, 4, 0), "friction": 0.8}
    scene.add("table", box={"size": (0.8, 0.8, 0.04)}, motion="static", position=(0, 0, 0.5), **lean)
    for name, asset, scale, x, y, z in (
        ("vase", "vase", 1.0, 0.1, 0.2, 0.525),
        ("plant", "can", 1.0, -0.2, 0.2, 0.6),
        ("bowl", "bowl", 0.4, 0.0, -0.2, 0.645),
    ):
        place = (x, y, z - 0.07 * x)
        scene.add(name, asset=f"samples/shapes/{asset}", scale=scale, position=place, mass=0.5, restitution=0.1, **lean)
    return scene


def soon(what: Callable[[], bool], told: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, told()
        time.sleep(0.1)


def test_one_drags_throws_sets_resets_and_uploads(tmp_path):
    with play(tabletop(), paused=True) as playing, Browser(tmp_path / "profile", SIZE) as browser:
        session, simulator = playing.session, playing.simulator
        vase, plant, bowl = (simulator[name] for name in ("vase", "plant", "bowl"))
        camera = playing.page.server.initial_camera
        eye, at, up = map(np.array, (camera.position, camera.look_at, camera.up))
        ahead = (at - eye) / np.linalg.norm(at - eye)
        right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))

        def pixel(point: np.ndarray) -> tuple[float, float]:
            way = np.array(point) - eye
            much = 0.5 * SIZE[1] / np.tan(0.5 * camera.fov) / (way @ ahead)
            return 0.5 * SIZE[0] + much * (way @ right), 0.5 * SIZE[1] - much * (way @ np.cross(right, ahead))

        start = session.call(lambda: simulator.state).arrays()
        browser.open(playing.address)
        browser.wait("[...document.querySelectorAll('canvas')].some((one) => one.style.opacity == 1)")

        browser.click(*pixel(bowl.centre - [0, 0, 0.02]))
        soon(lambda: playing.page.picked == "bowl", lambda: playing.page.picked)
        session.call(lambda: session.pause(paused=False))
        soon(lambda: session.now > 2.0, lambda: session.now)
        assert bowl.centre[2] > 0.5  # friction holds it
        browser.wait("document.body.innerText.includes('friction')")
        browser.value(TYPE.format(label="friction", value=0))
        soon(lambda: bowl.centre[2] < 0.4, lambda: f"the bowl is still at {bowl.centre}")

        x, y = pixel(vase.centre)
        browser.move(x, y)
        browser.press(x, y)
        for k in range(30):
            browser.move(x - 10 * k, y, down=True)
        soon(lambda: "vase" in session.hands and vase.centre[2] > 0.55, lambda: f"the vase is at {vase.centre}")
        soon(lambda: bool(np.linalg.norm(vase.centre[:2]) > 0.6), lambda: f"the vase is still at {vase.centre}")
        browser.press(x - 290, y, down=False)
        soon(lambda: vase.centre[2] < 0.4 and not session.hands, lambda: f"the vase is still at {vase.centre}")

        hit = []
        session.call(lambda: setattr(session, "_on_step", lambda now: hit.extend(
            one for one in now.contact_points() if {one.first, one.second} == {"thrown ball", "plant"})))  # fmt: skip
        browser.click(*pixel(plant.centre), held=8)
        soon(lambda: bool(hit), lambda: [body.name for body in session.frame.scene.bodies])

        browser.key("0", "Digit0")
        soon(lambda: session.now < 1.0, lambda: session.now)
        session.call(session.pause)
        session.call(session.reset)
        arrays = session.call(lambda: simulator.state).arrays()
        assert all(np.array_equal(arrays[name], start[name]) for name in start)

        (tmp_path / "wedge.obj").write_text(OBJ)
        browser.click(*browser.value(TAB))
        browser.wait("document.querySelector('input[type=file]') != null")
        browser.choose("input[type=file]", tmp_path / "wedge.obj")
        soon(lambda: any(body.name == "wedge" for body in session.frame.scene.bodies), lambda: "no wedge", 180)
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
