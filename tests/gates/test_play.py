"""The live page in a real browser: a body is dragged off a table, a ball is thrown, and reset restores the start."""

import time

import numpy as np
import pytest

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
