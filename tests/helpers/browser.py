"""Headless Chromium, driven over a pipe by its own protocol: a page is opened, clicked and looked at."""

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


class Browser:
    """One page of a browser of its own; a context manager. Skips the test where Chromium is not installed."""

    def __init__(self, profile: Path, size: tuple[int, int] = (1280, 800)) -> None:
        program = next((found for name in NAMES if (found := shutil.which(name))), None)
        if program is None:
            pytest.skip("Chromium is not installed (apt-get install chromium)")
        to_read, to_write = os.pipe(), os.pipe()  # what the browser reads, and writes

        def connected() -> None:
            os.dup2(to_read[0], 3)
            os.dup2(to_write[1], 4)

        options = ["--headless=new", "--no-sandbox", "--remote-debugging-pipe", f"--user-data-dir={profile}"]
        # Graphics on the processor, as there is no card.
        options += ["--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--hide-scrollbars"]
        options += [f"--window-size={size[0]},{size[1]}", "about:blank"]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(
            [program, *options], stdout=quiet, stderr=quiet, preexec_fn=connected, pass_fds=(3, 4)
        )
        os.close(to_read[0])
        os.close(to_write[1])
        self._in, self._out = os.fdopen(to_read[1], "wb"), os.fdopen(to_write[0], "rb")
        self._count, self._session, self._rest = 0, None, b""
        self.errors: list[str] = []  # what the page threw
        pages = self._call("Target.getTargets")["targetInfos"]
        target = next(page["targetId"] for page in pages if page["type"] == "page")
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime"):
            self._call(f"{domain}.enable")
        self._call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False
        )

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *error: object) -> None:
        self._process.kill()
        self._process.wait()

    def _call(self, method: str, **params: Any) -> dict:
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        self._in.write(json.dumps(message).encode() + b"\0")
        self._in.flush()
        while True:
            while b"\0" not in self._rest:
                more = os.read(self._out.fileno(), 1 << 20)
                assert more, "the browser has ended"
                self._rest += more
            line, _, self._rest = self._rest.partition(b"\0")
            answer = json.loads(line)
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(answer["params"]["exceptionDetails"])[:300])
            if answer.get("id") == self._count:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def open(self, address: str) -> None:
        self._call("Page.navigate", url=address)
        self.wait("document.readyState === 'complete'")

    def offline(self) -> None:
        """From now on, without a network."""
        self._call("Network.enable")
        off = {"latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
        self._call("Network.emulateNetworkConditions", offline=True, **off)

    def wait(self, what: str, seconds: float = 60.0) -> None:
        """Until an expression holds in the page."""
        end = time.monotonic() + seconds
        while not self.value(what):
            assert time.monotonic() < end, f"not within {seconds:g} s: {what}"
            time.sleep(0.1)

    def value(self, expression: str) -> Any:
        """What an expression is in the page."""
        made = self._call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in made, made["exceptionDetails"]
        return made["result"].get("value")

    def click(self, x: float, y: float, held: int = 0) -> None:
        """With the mouse, at a place of the window, px; `held` keys: 2 is Ctrl, 8 is Shift."""
        self.move(x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1, modifiers=held)

    def press(self, x: float, y: float, *, down: bool = True) -> None:
        """The left button of the mouse at a place of the window, px: `down`, or up."""
        kind = "mousePressed" if down else "mouseReleased"
        self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def move(self, x: float, y: float, *, down: bool = False) -> None:
        """The mouse to a place of the window, px; with the left button `down` it drags."""
        held = {"button": "left", "buttons": 1} if down else {}
        self._call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, **held)

    def key(self, text: str, code: str) -> None:
        """A key is pressed and let go, such as `n` of KeyN."""
        for kind in ("keyDown", "keyUp"):
            self._call("Input.dispatchKeyEvent", type=kind, key=text, code=code)

    def choose(self, selector: str, file: Path) -> None:
        """A file for the file field that a selector finds."""
        node = self._call("Runtime.evaluate", expression=f"document.querySelector({selector!r})")["result"]
        self._call("DOM.setFileInputFiles", files=[str(file)], objectId=node["objectId"])

    def picture(self, file: Path) -> Path:
        """A PNG of the page."""
        file.write_bytes(base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"]))
        return file
