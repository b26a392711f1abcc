"""A session: a simulator beside real time in a thread of its own, what a person does to it, and its last minute.

It knows nothing of pages. `Session.call` runs a command between two steps. Without the thread (`begin`) it runs at
once, and `advance` or `step` makes steps.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.apps.play.hand import Hand
from sdfsim.apps.play.saved import save_scene, write_run
from sdfsim.base.errors import SdfsimError
from sdfsim.base.lazy import made_once
from sdfsim.evaluation.instruments import judged
from sdfsim.geometry.bvh import Caster
from sdfsim.physics import pose
from sdfsim.physics.bodies import largest_extent
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.shape import Shape
from sdfsim.simulate.looks import framed, is_infinite
from sdfsim.simulate.record import at_frame
from sdfsim.simulate.simulator import SimulationError, Simulator, Snapshot

MINUTE = 60.0  # s that one can go back
EVERY = 0.1  # s between two snapshots
MOST = 256e6  # bytes of snapshots, and of recorded frames
TURN = 0.008  # s of computing between two looks at what a person wants
BEHIND = 0.1  # s: time that the simulation cannot make up for is given up
LOOK, SELDOM = 0.5, 3.0  # s between two looks for broken laws, and times what the last one took
WINDOW = 1.5  # s of motion in such a look; JUDGING: s that measuring surfaces may take in it
JUDGING = 0.05
KICK = 1.5  # a push changes the speed by this times that of a fall from the body's size
THROW = 2.5  # a ball is thrown with this times the speed of a fall from the scene's radius
BALL = 0.05  # radius of a thrown ball relative to the scene's, and of what is added without a size
BALLS = 30  # thrown balls: the oldest goes
SPEEDS = (0.02, 10.0)  # of simulated time, relative to real time


@dataclass(frozen=True)
class Frame:
    """What is shown: poses of the N bodies of a scene at a time."""

    number: int
    scene: Scene
    time: float  # s
    position: np.ndarray  # [N, 3] m, centres of mass
    orientation: np.ndarray  # [N, 4] xyzw
    wall: float  # s, `time.perf_counter` when it was made


class Session:
    """A simulator that a person plays with.

    Attributes:
        simulator: it stays the same object when bodies come and go.
        playing, speed: whether time passes, and how fast relative to real time.
        ratio: simulated time over real time, in the last half second.
        broken: lines about broken laws and errors, with the time, the latest last.
        middle, wide: centre [3] m and radius m of a ball around the scene at its start.
        frame: what is to be shown now. `changed` is notified with each.
    """

    def __init__(self, simulator: Simulator, on_step: Callable[[Simulator], object] | None = None) -> None:
        self.simulator, self._on_step = simulator, on_step
        self.playing, self.speed, self.ratio = False, 1.0, 0.0
        self.broken: list[str] = []
        self.hands: dict[str, Hand] = {}
        self._number = 0
        self.changed = threading.Condition()
        self._jobs: deque[Callable[[], None]] = deque()
        self._wake = threading.Event()
        self._threads: list[threading.Thread] = []
        self._closed = False
        self._owed, self._cost = 0.0, 1e-3  # s of simulated time; s of computing in a step
        self._pulled: dict[str, float] = {}  # body -> when it was pulled last, s
        self._recorder = ExitStack()
        self._start = simulator.snapshot()
        self.middle, self.wide = framed(simulator.scene)  # of the start: balls that were thrown fly far
        self._kept: deque[tuple[float, Snapshot, int]] = deque()  # time, snapshot, bytes
        self._passed: deque[tuple[float, float]] = deque()  # real and simulated time
        self._record()
        self._keep()
        self._show()

    # --- the thread ---

    def begin(self) -> None:
        """Start the thread that makes the steps, and the one that looks for broken laws."""
        for work in (self._run, self._watch):
            self._threads.append(threading.Thread(target=work, daemon=True, name=f"play {work.__name__}"))
            self._threads[-1].start()

    def close(self) -> None:
        """End both threads. The simulator stays as it is."""
        self._closed = True
        self._wake.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout=10.0)
        self._threads = []
        self._run_jobs()
        self._recorder.close()

    def call(self, command: Callable[..., Any], *given: Any) -> Any:
        """Run a command between two steps, wait for it, and return what it returns. Raises what it raises."""
        return self.post(command, *given).result()

    def post(self, command: Callable[..., Any], *given: Any) -> Future:
        """Run a command between two steps, without waiting for it."""
        future: Future = Future()

        def job() -> None:
            try:
                future.set_result(command(*given))
            except Exception as error:
                future.set_exception(error)

        self._jobs.append(job)
        if not self._threads or threading.current_thread() is self._threads[0]:
            self._run_jobs()
        else:
            self._wake.set()
        return future

    def _run_jobs(self) -> bool:
        ran = False
        while self._jobs:
            self._jobs.popleft()()
            ran = True
        return ran

    def _run(self) -> None:
        last = time.perf_counter()
        while not self._closed:
            self._wake.clear()
            ran = self._run_jobs()
            now = time.perf_counter()
            made = self.advance(now - last)
            last = now
            if ran or made:
                self._show()
            if not made:
                dt = self.simulator.dt
                due = (dt - self._owed) / self.speed if self.playing else 1.0
                self._wake.wait(min(max(due, 0.0005), 0.25))

    def advance(self, seconds: float) -> int:
        """Let `seconds` of real time pass. Returns how many steps were made: as many as are due, but not more than can
        be computed before the next look at what a person wants. Simulated time that is missing is never jumped over."""
        self._passed.append((time.perf_counter(), self.now))
        while self._passed[-1][0] - self._passed[0][0] > 0.5:
            self._passed.popleft()
        (real, simulated), (now, then) = self._passed[0], self._passed[-1]
        self.ratio = max(0.0, then - simulated) / (now - real) if self.playing and now > real else 0.0
        if not self.playing:
            self._owed = 0.0
            return 0
        dt = self.simulator.dt
        self._owed = min(self._owed + seconds * self.speed, max(BEHIND * self.speed, dt))
        due = min(int(self._owed / dt), max(1, int(TURN / self._cost)))
        if due:
            self._owed -= due * dt
            self.step(due)
        return due

    # --- time ---

    def step(self, steps: int = 1) -> None:
        """Make steps. An invalid state pauses, with a line in `broken`; the last good state stays."""
        began, done = time.perf_counter(), 0
        try:
            while done < steps:
                some = 1 if self.hands or self._on_step else steps - done
                for hand in self.hands.values():
                    hand.act(self.simulator)
                self._note_pulls()
                self.simulator.step(some)
                done += some
                if self._on_step:
                    self._on_step(self.simulator)
                self._keep()
        except SimulationError as error:
            self.playing = False
            self._tell(error.message)
        self._cost += 0.2 * ((time.perf_counter() - began) / max(steps, 1) - self._cost)

    def pause(self, *, paused: bool = True) -> None:
        self.playing = not paused

    def set_speed(self, speed: float) -> None:
        """How fast simulated time passes, relative to real time."""
        self.speed = float(np.clip(speed, *SPEEDS))

    def reset(self) -> None:
        """Back to the start, bit for bit: motion, materials, bodies."""
        self._return(self._start)
        self._kept.clear()
        self._keep()

    def back(self, seconds: float) -> float:
        """Return exactly to what was `seconds` ago, or to the nearest moment that is kept. Returns its time, s."""
        wanted = self.now - seconds
        when, snapshot, _ = min(self._kept, key=lambda kept: abs(kept[0] - wanted))
        self._return(snapshot)
        return when

    def one_step(self) -> None:
        self.pause()
        self.step()

    @property
    def now(self) -> float:
        """s of simulated time."""
        return self.simulator.si_state().time

    def _return(self, snapshot: Snapshot) -> None:
        scene = self.simulator.scene
        self.hands.clear()
        self._pulled.clear()
        self.simulator.rewind(snapshot)
        if self.simulator.scene is not scene:
            self._changed()
        self._owed = 0.0

    def _keep(self) -> None:
        now = self.now
        while len(self._kept) and self._kept[-1][0] > now:  # what was undone
            self._kept.pop()
        if self._kept and now - self._kept[-1][0] < EVERY:
            return
        snapshot = self.simulator.snapshot()
        self._kept.append((now, snapshot, sum(array.nbytes for array in snapshot.state.arrays().values())))
        while now - self._kept[0][0] > MINUTE or sum(size for *_, size in self._kept) > MOST:
            self._kept.popleft()
        self.recording.shorten(int(MOST))

    def _show(self) -> None:
        moment = self.simulator.si_state()
        self._number += 1
        with self.changed:
            self.frame = Frame(
                self._number, self.simulator.scene, moment.time, moment.position, moment.orientation,
                time.perf_counter(),
            )  # fmt: skip
            self.changed.notify_all()

    # --- laws ---

    def _tell(self, line: str) -> None:
        self.broken = [*self.broken[-9:], f"{self.now:.2f} s: {line}"]

    def _note_pulls(self) -> None:
        load = self.simulator.now.load
        if load is not None:
            now = self.now
            for row in np.flatnonzero(load.any(1)):
                self._pulled[self.simulator.scene.bodies[row].name] = now

    def _watch(self) -> None:
        looked, took = -1.0, 0.0
        while not self._closed:
            time.sleep(max(LOOK, SELDOM * took))
            now = self.now
            if now == looked or self._closed:
                continue
            looked, began = now, time.perf_counter()
            for line in self.look(*self.call(self.seen_since, now - WINDOW)):
                self.post(self._tell, line)
            took = time.perf_counter() - began

    def seen_since(self, time: float) -> tuple[Scene, Rollout, dict[str, float]]:
        """What `look` needs: the scene, its motion since a `time` s, and when bodies were pulled last."""
        return self.simulator.scene, self.recording.since(time), dict(self._pulled)

    def look(self, scene: Scene, motion: Rollout, pulled: dict[str, float], seconds: float = JUDGING) -> list[str]:
        """The laws that a motion (of `seen_since`) breaks and that are not told yet; measuring surfaces may take
        `seconds`. A hand holds bodies up where nothing is near."""
        if len(motion) < 2:
            return []
        held = [name for name, when in pulled.items() if when >= motion.time[0] - EVERY]
        said = {line.partition(": ")[2].partition(" by ")[0] for line in self.broken}
        lines = judged(scene, motion, seconds=seconds).broken
        lines = [
            li for li in lines if not (li.startswith("floating") and any(f"{name!r} is held" in li for name in held))
        ]
        return [line for line in lines if _kind(line) not in {_kind(one) for one in said}]

    # --- hands ---

    def grab(self, name: str, point: Any, target: Any = None) -> None:
        """Take a dynamic body at a point [3] m, world, and pull this point to `target`."""
        self._need_movable(name)
        body, known = self.simulator[name], self.hands.get(name)
        grip = pose.rotate(pose.conjugate(body.quat_xyzw), np.asarray(point, float) - body.centre)
        aim = np.asarray(point if target is None else target, float)
        shape, scale = self.simulator.scene.shapes[self._body(name).shape], self._body(name).scale
        grip = np.clip(grip, *(shape.sdf.bounds - shape.com) * scale)  # what is seen of a fast body is behind it
        self.hands[name] = Hand(name, grip, aim, None if known is None else known.turn, known is not None)

    def drag(self, name: str, target: Any) -> None:
        """Move the hand at a body to `target` [3] m."""
        if name in self.hands:
            self.hands[name].target = np.asarray(target, float)

    def turn(self, name: str, axis: Any, angle: float) -> None:
        """Turn a body by `angle` rad about an `axis` [3], world, and hold it so."""
        if name not in self.hands:
            self.hold(name, held=True)
        hand, length = self.hands[name], float(np.linalg.norm(axis))
        known = self.simulator[name].quat_xyzw if hand.turn is None else hand.turn
        hand.turn = pose.normalise(pose.multiply(pose.from_rotvec(np.asarray(axis, float) / length * angle), known))

    def release(self, name: str) -> None:
        """Let a body go; one that is held still stays where it is now."""
        hand = self.hands.pop(name, None)
        if hand is not None and hand.stays:
            self.hold(name, held=True)
        elif hand is not None and self.simulator.stepper.forces:
            self.simulator[name].pull()

    def hold(self, name: str, *, held: bool) -> None:
        """Hold a dynamic body still where it is, or no more."""
        self._need_movable(name)
        body = self.simulator[name]
        if held:
            self.hands[name] = Hand(name, np.zeros(3), body.centre, body.quat_xyzw, stays=True)
        elif name in self.hands:
            self.hands[name].stays = False
            self.release(name)

    def hold_or_let_go(self, name: str) -> None:
        self.hold(name, held=name not in self.hands)

    def push(self, name: str, point: Any, direction: Any) -> None:
        """Push a body at a point [3] m along a direction [3]."""
        self._need_movable(name)
        body, along = self.simulator[name], np.asarray(direction, float)
        speed = KICK * np.sqrt(self._strength * self.size(name))
        body.push(body.mass * speed * along / np.linalg.norm(along), at=point)

    def throw(self, origin: Any, direction: Any) -> str:
        """Throw a ball from `origin` [3] m so that it hits what is seen along `direction` [3]. Returns its name."""
        origin, along = np.asarray(origin, float), np.asarray(direction, float) / np.linalg.norm(direction)
        (shape, body), wide = self._ball, self.wide
        radius = 0.5 * largest_extent(shape)
        hit = self.seen(origin, along)
        aim = origin + along * (3.0 * wide if hit is None else hit[1])
        start = aim - along * max(min(float(np.linalg.norm(aim - origin)) - radius, 1.5 * wide), 2.5 * radius)
        speed = THROW * np.sqrt(self._strength * wide)
        flight = float(np.linalg.norm(aim - start)) / speed
        velocity = (aim - start) / flight - 0.5 * self.simulator.scene.gravity * flight
        thrown = [body.name for body in self.simulator.scene.bodies if body.name.startswith("thrown ball")]
        if len(thrown) >= BALLS:
            self.delete(thrown[0])
        masses = [body.mass for body in self.simulator.scene.bodies if body.motion == "dynamic"]
        mass = min(2000.0 * shape.volume, float(np.median(masses)) if masses else np.inf)
        return self._put("thrown ball", shape, body, position=start, velocity=velocity, mass=mass, restitution=0.6)

    def seen(self, origin: np.ndarray, along: np.ndarray) -> tuple[str, float] | None:
        """The body that a ray meets first, and the distance in lengths of its direction; None if it meets none."""
        moment, best = self.frame, None
        scene = moment.scene
        for k, body in enumerate(scene.bodies):
            shape, back = scene.shapes[body.shape], pose.conjugate(moment.orientation[k])
            start, way = (pose.rotate(back, v) for v in (origin - moment.position[k], along))
            if is_infinite(shape):
                away = -start[2] / way[2] if way[2] < 0.0 else np.inf
            else:
                ray = np.concatenate([start / body.scale + shape.com, way / body.scale]).astype(np.float32)
                away = float(made_once(shape.mesh, Caster).cast(ray[None])[0][0])
            if 0.0 < away < (np.inf if best is None else best[1]):
                best = body.name, away
        return best

    # --- the scene ---

    def set(self, name: str, what: str, value: float) -> None:
        """Give a body another mass, friction or restitution."""
        setattr(self.simulator[name], what, value)
        self._changed()

    def target(self, joint: str, value: float) -> None:
        """Give the motor of a joint another target."""
        self.simulator.joint(joint).target = value

    def add(self, name: str, spot: Any, wanted: float | None = None, **keys: Any) -> str:
        """Add a body with the keys of `Scene.add`, above a spot [3] m; `wanted` m is its longest side, else it has the
        size of its shape. A mesh is fitted first, which may take a while: not in the thread that makes the steps.
        Returns its name."""
        shape, body = _alone(**keys)
        if wanted is not None:
            factor = wanted / largest_extent(shape)
            body = replace(body, scale=factor, mass=body.mass * factor**3)
        return self.call(lambda: self._put(name, replace(shape, name=name), body, spot=spot))

    def copy(self, name: str) -> str:
        """Another body like this one, beside it. Returns its name."""
        scene, body = self.simulator.scene, self._body(name)
        if is_infinite(scene.shapes[body.shape]):
            raise SdfsimError(f"body {name!r}: is infinite, so there is no place beside it")
        live = self.simulator[name]
        return self._put(name.split(" copy")[0] + " copy", scene.shapes[body.shape], body, spot=live.position)

    def delete(self, name: str) -> None:
        """Remove a body, and its joints."""
        self.hands.pop(name, None)
        self.simulator.remove(name)
        self._changed()

    def save_scene(self, folder: Path | str) -> Path:
        """Write the scene as it is now to `folder`/scene.yaml. Raises SdfsimError if it cannot be written."""
        scene, last = self.call(lambda: (self.simulator.scene, self.recording.since(np.inf)))
        return save_scene(at_frame(scene, last), Path(folder))

    def save_run(self, folder: Path | str) -> Path:
        """Write the motion since the scene was changed last as a run folder. Raises SdfsimError as `save_scene`."""
        scene, rollout = self.call(lambda: (self.simulator.scene, self.recording.rollout))
        return write_run(at_frame(scene, rollout), rollout, Path(folder))

    def _put(self, name: str, shape: Shape, body: Body, spot: Any = None, **fields: Any) -> str:
        """Add a body of a shape; with a `spot` so high above it that it lies free."""
        scene = self.simulator.scene
        names = {body.name for body in scene.bodies}
        if name in names:
            name = next(one for one in (f"{name} {k}" for k in count(2)) if one not in names)
        known = next((k for k, one in enumerate(scene.shapes) if one is shape), len(scene.shapes))
        still = {key: np.zeros(3) for key in ("velocity", "angular_velocity")}
        body = replace(body, name=name, shape=known, collides_with=None, **still | fields)
        if spot is not None:
            body = replace(body, position=self._free(np.asarray(spot, float), shape, body.scale))
        shapes = scene.shapes if known < len(scene.shapes) else (*scene.shapes, shape)
        self.simulator.become(replace(scene, shapes=shapes, bodies=(*scene.bodies, body)))
        self._changed()
        return name

    def _free(self, spot: np.ndarray, shape: Shape, scale: float) -> np.ndarray:
        """A place [3] m above `spot` at which the ball around a shape meets no body."""
        scene, moment = self.simulator.scene, self.simulator.si_state()
        up = -scene.gravity / np.linalg.norm(scene.gravity) if np.any(scene.gravity) else np.array([0.0, 0.0, 1.0])
        low, high = shape.sdf.bounds * scale
        middle, reach = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
        places = spot + (1.05 + 0.5 * np.arange(100)[:, None]) * reach * up
        clear = np.ones(len(places), bool)
        for body, place, turn in zip(scene.bodies, moment.position, moment.orientation, strict=True):
            other = scene.shapes[body.shape]
            inside = pose.rotate(pose.conjugate(turn), places - place) / body.scale + other.com
            clear &= body.scale * np.asarray(other.sdf(inside)[0]) > reach
        return places[clear.argmax() if clear.any() else -1] - middle

    def _changed(self) -> None:
        """Begin a new recording, as the scene is another."""
        self._record()
        self._show()

    def _record(self) -> None:
        self._recorder.close()
        self.recording = self._recorder.enter_context(self.simulator.record())

    def _body(self, name: str) -> Body:
        _ = self.simulator[name]  # is there
        return next(body for body in self.simulator.scene.bodies if body.name == name)

    def _need_movable(self, name: str) -> None:
        if (motion := self._body(name).motion) != "dynamic":
            raise SdfsimError(f"body {name!r}: is {motion}, so it cannot be moved")

    def metres_per_newton(self, name: str) -> float | None:
        """The length of an arrow: as long as the body is its weight. None for a body that does not move."""
        body = self._body(name)
        return self.size(name) / (body.mass * self._strength) if body.motion == "dynamic" else None

    def facts(self, name: str) -> tuple[str, dict[str, float]]:
        """A line about where a body is and how it moves; and its mass, if it has one, friction and restitution, to six
        digits."""
        body, known = self.simulator[name], self._body(name)
        state = f"{float(np.linalg.norm(body.velocity)):.3g} m/s"
        state = "asleep" if body.asleep else "held" if name in self.hands else state
        spin = float(np.degrees(np.linalg.norm(body.angular_velocity)))
        line = "at ({:.3f}, {:.3f}, {:.3f}) m · ".format(*body.centre) + f"{state} · {spin:.3g} deg/s"
        which = (*(["mass"] if known.motion == "dynamic" else []), "friction", "restitution")
        return line, {what: float(f"{getattr(known, what):.6g}") for what in which}

    def size(self, name: str) -> float:
        """m, the longest side of a body."""
        body = self._body(name)
        return body.scale * largest_extent(self.simulator.scene.shapes[body.shape])

    @property
    def _strength(self) -> float:
        return float(np.linalg.norm(self.simulator.scene.gravity)) or 9.81

    @cached_property
    def _ball(self) -> tuple[Shape, Body]:
        """A ball to throw: not smaller than the smallest body, so that it does not change the step."""
        scene = self.simulator.scene
        sizes = [self.size(body.name) for body in scene.bodies if body.motion == "dynamic"]
        return _alone(sphere={"radius": max(BALL * self.wide, 0.5 * min(sizes, default=0.0))})


def _alone(**keys: Any) -> tuple[Shape, Body]:
    """The shape and the body that the keys of `Scene.add` make."""
    made = SceneBuilder().add("new", **keys).load()
    return made.shapes[0], made.bodies[0]


def _kind(line: str) -> str:
    """A line about a broken law without its numbers: what it is about."""
    return " ".join(word for word in line.split() if not any(c.isdigit() for c in word))
