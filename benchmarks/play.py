"""The page of `sdfsim play`, driven by the messages that a browser sends: how fast it is, and ten minutes of chance.

    python -m benchmarks play [--minutes 10] [--seed 0] [--large FOLDER]

A drag's time is from the message's leaving to the pose that it led to being sent. In the random part, clicks, drags,
throws, keys and the whole panel are used in two samples by turns: the record counts errors that were printed, MiB of
the process, and broken laws that were on the page and that were not. `--large` is the scene.yaml of `samples/large.py
heaps`; without it this row is left out.
"""

from __future__ import annotations

import contextlib
import gc
import io
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.records import ROOT, write_record
from sdfsim import Scene, play
from sdfsim.apps.play import Playing
from sdfsim.base.errors import SdfsimError

SAMPLES = ("knocked_vase", "ragdoll")
PAUSE = 0.03  # s between two messages of a drag
MANY = 24  # bodies, above which chance adds no more
OBJ = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


class Client:
    """A browser's end of the connection, without drawing. `panel` holds the elements of the panel by their id, and
    `keys` the ids of the commands."""

    def __init__(self, address: str) -> None:
        import viser
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        version = [Subprotocol(f"viser-v{viser.__version__}")]
        self._socket = connect(address.replace("http", "ws"), subprotocols=version, max_size=None)
        self.panel: dict[str, dict] = {}
        self.keys: list[str] = []
        self._thread = threading.Thread(target=self._listen, daemon=True)
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

    def _listen(self) -> None:
        import zstandard
        from msgspec import msgpack

        for data in self._socket:
            assert isinstance(data, bytes)
            end = 16 + int.from_bytes(data[8:16], "little")
            inner = zstandard.ZstdDecompressor().decompress(data[16:end], int.from_bytes(data[:8], "little"))
            for message in msgpack.decode(inner)["messages"]:
                if message["type"] == "GuiRemoveMessage":
                    self.panel.pop(message["uuid"], None)
                elif message["type"] == "RegisterCommandMessage":
                    self.keys.append(message["uuid"])
                elif "container_uuid" in message:
                    self.panel[message["uuid"]] = message

    # --- what a person does ---

    def drag(self, playing: Playing, name: str, way: np.ndarray) -> None:
        """Drag a body by its centre along the points [K, 3] m."""
        batch = next((one for one in playing.page.batches.values() if name in one.names), None)
        if batch is None:  # it was deleted a moment ago
            return
        phases = ["start", *["update"] * (len(way) - 2), "end"]
        alone = len(batch.names) == 1
        for phase, place in zip(phases, way.tolist(), strict=True):
            self.send("SceneNodeDragMessage", phase=phase, name=batch.handle.name,
                      instance_index=0 if alone else batch.names.index(name), start_position=way[0].tolist(),
                      start_screen_pos=(0.5, 0.5), end_position=place, end_screen_pos=(0.5, 0.5), button="left",
                      modifier=None, owner="")  # fmt: skip
            time.sleep(PAUSE)

    def click(self, origin: np.ndarray, along: np.ndarray, modifier: str | None) -> None:
        self.send("ScenePointerMessage", event_type="click", ray_origin=origin.tolist(),
                  ray_direction=(along / np.linalg.norm(along)).tolist(), screen_pos=((0.5, 0.5),),
                  modifier=modifier)  # fmt: skip

    def set(self, uuid: str, value: Any) -> None:
        self.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})

    def upload(self, name: str, content: bytes) -> None:
        """Give a file to the panel."""
        field = next(uuid for uuid, one in self.panel.items() if one["type"] == "GuiUploadButtonMessage")
        self.send("FileTransferStartUpload", source_component_uuid=field, transfer_uuid=name, filename=name,
                  mime_type="", part_count=1, size_bytes=len(content))  # fmt: skip
        self.send("FileTransferPart", source_component_uuid=field, transfer_uuid=name, part_index=0, content=content)


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


# --- chance ---


def at_random(playing: Playing, client: Client, rng: np.random.Generator) -> None:
    """Do one thing by chance."""
    session = playing.session
    frame = session.frame
    centre, radius = session.middle, session.wide
    rows = [k for k, body in enumerate(frame.scene.bodies) if body.motion == "dynamic"]
    if not rows:
        client.send("CommandTriggerMessage", uuid=client.keys[2])  # reset
        return
    row = int(rng.choice(rows))
    eye = centre + 3.0 * radius * np.array([*rng.normal(size=2), 1.0 + rng.random()])
    kind = rng.choice(["drag", "click", "key", "panel"], p=[0.4, 0.25, 0.2, 0.15])
    if kind == "drag":
        way = frame.position[row] + np.linspace(0, 1, int(rng.integers(3, 30)))[:, None] * rng.normal(size=3) * radius
        client.drag(playing, frame.scene.bodies[row].name, way)
    elif kind == "click":
        aim = frame.position[row] + 0.2 * radius * rng.normal(size=3) * (rng.random() < 0.3)
        client.click(eye, aim - eye, (None, "shift", "cmd/ctrl")[rng.integers(3)])
    elif kind == "key":
        client.send("CommandTriggerMessage", uuid=str(rng.choice(client.keys)))
    else:
        uuid, one = list(client.panel.items())[rng.integers(len(client.panel))]
        props = one["props"]
        value: Any = None
        if one["type"] == "GuiSliderMessage":
            value = float(rng.uniform(props["min"], props["max"]))
        elif one["type"] == "GuiNumberMessage":
            value = float(np.clip(one["value"] * np.exp(rng.normal()), props["min"], props["max"] or np.inf))
        elif one["type"] == "GuiCheckboxMessage":
            value = bool(rng.random() < 0.5)
        elif one["type"] in ("GuiButtonGroupMessage", "GuiDropdownMessage"):
            value = str(rng.choice(props["options"]))
        elif one["type"] == "GuiButtonMessage" and len(frame.scene.bodies) < MANY:
            value = True
        if value is not None:
            client.set(uuid, value)
    while len(session.frame.scene.bodies) >= 2 * MANY:  # copies
        session.call(session.delete, session.frame.scene.bodies[-1].name)
    time.sleep(float(rng.exponential(0.1)))


def memory() -> float:
    """MiB of this process."""
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20


def chance(source: str, seconds: float, rng: np.random.Generator) -> dict[str, Any]:
    """Play by chance. Returns how much was done, MiB at each minute, broken laws on the page and off it, and what was
    printed to the error stream."""
    counts, sizes, unsaid = 0, [], []
    errors = io.StringIO()
    home = os.getcwd()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(errors):
        os.chdir(folder)  # it saves scenes
        try:
            with play(source) as playing:
                client, session, began = Client(playing.address), playing.session, time.monotonic()
                time.sleep(1.0)
                client.upload("wedge.obj", OBJ.encode())
                looked = 0.0
                said: set[str] = set()  # without their numbers
                while (now := time.monotonic() - began) < seconds:
                    at_random(playing, client, rng)
                    counts += 1
                    said |= {line.partition(": ")[2].partition(" by ")[0] for line in session.broken}
                    if now - looked > 20.0:
                        looked = now
                        recent = session.call(session.seen_since, session.frame.time - 2.0)
                        time.sleep(4.0)  # the page looks, too
                        unsaid += session.look(*recent, seconds=5.0)
                        print(f"{source}: {now:.0f} s, {counts} acts, {memory():.0f} MiB, {session.broken[-1:]}",
                              unsaid[-1:], errors.getvalue()[-300:], file=sys.stdout, flush=True)  # fmt: skip
                        if int(now) // 60 > len(sizes):
                            sizes.append(memory())
                alive = session.call(lambda: session.simulator.si_state().time)
                client.close()
        finally:
            os.chdir(home)
    if not np.isfinite(alive):
        raise SdfsimError(f"{source}: the state is not finite")
    return {"acts": counts, "sizes": sizes, "said": said, "unsaid": unsaid, "errors": errors.getvalue()}


def main(*, minutes: float = 10.0, seed: int = 0, large: Path | None = None) -> None:
    cubes = Scene(model="solver").add("floor", plane={})
    cubes.add("box", box={"size": (0.1, 0.1, 0.1)}, count=50, arrange={"grid": [5, 5, 2], "spacing": 0.13})
    cubes.bodies[-1]["position"] = [0, 0, 0.1]
    rows = [("50 boxes", *speed(cubes, 10.0))]
    if large is not None:
        rows.append(("heap of 380 bodies", *speed(large, 20.0)))
    notes, rng = [], np.random.default_rng(seed)
    for source in SAMPLES:
        found = chance(source, 60.0 * minutes / len(SAMPLES), rng)
        grown = f"{found['sizes'][0]:.0f} to {found['sizes'][-1]:.0f}" if found["sizes"] else "-"
        printed = found["errors"].count("Traceback")
        notes += [f"{minutes / len(SAMPLES):g} minutes of chance in `{source}`: {found['acts']} acts, "
                  f"{printed} errors, {len(found['said'])} broken laws on the page, {len(found['unsaid'])} off it, "
                  f"{grown} MiB from the first minute to the last."]  # fmt: skip
        print(found["errors"], *found["unsaid"], *sorted(found["said"]), sep="\n")
    columns = ("scene", "ms from drag to pose", "95 % within, ms", "poses a second", "simulated s a second")
    data = "A body is dragged on a page, with a client that draws nothing."
    write_record("play", "python -m benchmarks play", data, columns, rows, notes)


if __name__ == "__main__":
    os.chdir(ROOT)
