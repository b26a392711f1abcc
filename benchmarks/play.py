"""The page of `sdfsim play`, driven by the messages that a browser sends: how fast it is.

    python -m benchmarks play [--large FILE]

A drag's time is from the message's leaving to the pose that it led to being sent. `--large` is the scene.yaml of
`samples/large.py heaps`; without it this row is left out.
"""

import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.records import write_record
from sdfsim import Scene, play
from sdfsim.apps.play import Playing

PAUSE = 0.03  # s between two messages of a drag


class Client:
    """A browser's end of the connection, without drawing."""

    def __init__(self, address: str) -> None:
        import viser
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        version = [Subprotocol(f"viser-v{viser.__version__}")]
        self._socket = connect(address.replace("http", "ws"), subprotocols=version, max_size=None)
        self._thread = threading.Thread(target=deque, args=(self._socket, 0), daemon=True)  # nothing is kept
        self._thread.start()
        self.send("ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), position=(1.0, 0.0, 0.0), fov=0.8, near=0.01,
                  far=100.0, image_height=800, image_width=1280, look_at=(0.0, 0.0, 0.0),
                  up_direction=(0.0, 0.0, 1.0))  # fmt: skip

    def send(self, kind: str, **fields: Any) -> None:
        from msgspec import msgpack

        self._socket.send(msgpack.encode({"type": kind, **fields}))

    def close(self) -> None:
        self._socket.close()
        self._thread.join()

    def drag(self, playing: Playing, name: str, way: np.ndarray) -> None:
        """Drag a body by its centre along the points [K, 3] m."""
        batch = next(one for one in playing.page.batches.values() if name in one.names)
        phases = ["start", *["update"] * (len(way) - 2), "end"]
        alone = len(batch.names) == 1
        for phase, place in zip(phases, way.tolist(), strict=True):
            self.send("SceneNodeDragMessage", phase=phase, name=batch.handle.name,
                      instance_index=0 if alone else batch.names.index(name), start_position=way[0].tolist(),
                      start_screen_pos=(0.5, 0.5), end_position=place, end_screen_pos=(0.5, 0.5), button="left",
                      modifier=None, owner="")  # fmt: skip
            time.sleep(PAUSE)


# --- speed ---


def speed(scene: Any, seconds: float) -> tuple[float, float, float, float]:
    """Median and 95th percentile, ms, from a drag's message to the pose that it led to; frames a second; simulated
    seconds a second. One body is dragged above all others."""
    with play(scene) as playing:
        session, client = playing.session, Client(playing.address)
        sent: list[float] = []
        latencies: list[float] = []
        asked: list[tuple[float, float]] = []  # when a drag left, and when it acted
        drag, followed = session.drag, playing.page.followed

        def dragged(name: str, target: Any) -> None:
            drag(name, target)
            if left:
                asked.append((left.pop(), time.perf_counter()))

        def shown(frame: Any) -> None:
            followed(frame)
            sent.append(time.perf_counter())
            while asked and frame.wall > asked[0][1]:
                latencies.append(sent[-1] - asked.pop(0)[0])

        left: list[float] = []
        session.drag, playing.page.followed = dragged, shown  # type: ignore[method-assign]
        send = client.send

        def timed(kind: str, **fields: Any) -> None:
            if fields.get("phase") == "update" and not left and not asked:
                left.append(time.perf_counter())
            send(kind, **fields)

        client.send = timed  # type: ignore[method-assign]
        time.sleep(2.0)
        body = max((b for b in session.frame.scene.bodies if b.motion == "dynamic"), key=lambda b: b.position[2]).name
        count = int(seconds / PAUSE)
        turn = np.linspace(0.0, 4.0 * np.pi, count)
        size, start = session.size(body), np.array(playing.simulator[body].centre)
        way = start + size * np.column_stack([np.sin(turn), np.cos(turn) - 1.0, 2.0 + 0.0 * turn])
        began, simulated = time.perf_counter(), session.frame.time
        client.drag(playing, body, way)
        took = time.perf_counter() - began
        ratio = (session.frame.time - simulated) / took
        client.close()
    found = 1e3 * np.array(latencies)
    return float(np.median(found)), float(np.quantile(found, 0.95)), (np.array(sent) > began).sum() / took, ratio


def main(*, large: Path | None = None) -> None:
    cubes = Scene(model="solver").add("floor", plane={})
    cubes.add("box", box={"size": (0.1, 0.1, 0.1)}, count=50, arrange={"grid": [5, 5, 2], "spacing": 0.13})
    cubes.bodies[-1]["position"] = [0, 0, 0.1]
    rows = [("50 boxes", *speed(cubes, 10.0))]
    if large is not None:
        rows.append(("heap of 380 bodies", *speed(large, 20.0)))
    columns = ("scene", "ms from drag to pose", "95 % within, ms", "poses a second", "simulated s a second")
    data = "A body is dragged on a page, with a client that draws nothing."
    write_record("play", "python -m benchmarks play", data, columns, rows)
