"""How far engines are from real tosses of an elbow, two links on a hinge, each with its own best parameters.

    python benchmarks/elbow.py TOSSES -o DIR [--rounds N]

TOSSES holds `elbow.npz`: tosses of two printed links onto a table, tracked at 148 Hz (dair_pll). Ours are the numbers
that `sdfsim identify` finds on 60 tosses; other engines' are found on the same ones by a search over as many, as
`benchmarks/reality.py` does for the cube. All are judged on 100 others, over the first 75 frames, from the same starts.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import differential_evolution
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.reality import CLEAR, FAR, FIT, FLIGHT, FRAMES, IMPRATIO, INNER, SEED, SOFT, SOLID, TEST
from benchmarks.results import progress
from sdfsim.apps.identify import identify, repeated, write_scene
from sdfsim.apps.observed import Recording, cleaned, with_velocities
from sdfsim.base.errors import SdfsimError, run_main
from sdfsim.base.files import read_arrays, write_json, write_text
from sdfsim.data.public_tosses import ARM, ELBOW, LINK, PIVOT, Links, links_of, lowest, upright
from sdfsim.data.pybullet_sim import import_pybullet
from sdfsim.evaluation.engines import engine_module
from sdfsim.evaluation.harness import markdown, one_thread
from sdfsim.evaluation.metrics import interval
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene

MASS = 0.37  # kg of a link
EVEN = MASS / 12.0 * np.array([LINK[b] ** 2 + LINK[c] ** 2 for b, c in ((1, 2), (2, 0), (0, 1))])  # kg m^2, solid
LONGEST, HELD = 10, 0.002  # frames and m: flights that tell gravity are longer, and nearer to a parabola
ROUNDS, CROWD = 15, 25


class Motion(NamedTuple):
    """Poses of the two links of B tosses in T frames."""

    position: np.ndarray  # [B, T, 2, 3] m
    quat_xyzw: np.ndarray  # [B, T, 2, 4]


@dataclass(frozen=True)
class Start:
    """Poses and velocities of both links at a first frame."""

    position: np.ndarray  # [2, 3] m
    quat_xyzw: np.ndarray  # [2, 4]
    velocity: np.ndarray  # [2, 3] m/s
    angular_velocity: np.ndarray  # [2, 3] rad/s, world


def load_tosses(folder: Path) -> tuple[float, list[Links]]:
    """Frame spacing s, and both links' poses in every toss, in axes that stand on the table."""
    found = read_arrays(folder / "elbow.npz", "recorded tosses", "give the folder that holds elbow.npz")
    tosses = []
    for number, a, b in zip(found["number"], found["start"][:-1], found["start"][1:], strict=True):
        place, turn, angle = (found[name][a:b].astype(np.float64) for name in ("position", "quat_xyzw", "hinge"))
        tosses.append(upright(links_of(place, Rotation.from_quat(turn), angle), int(number)))
    return float(found["dt"]), tosses


def flight(toss: Links) -> int:
    """How many frames pass before the lowest corner is as near to the table as `CLEAR`."""
    near = np.any(lowest(toss) < CLEAR, axis=1)
    return int(np.argmax(near)) if near.any() else len(toss.position)


def gravity_of(tosses: Sequence[Links], dt: float) -> np.ndarray:
    """[3] m/s^2, with which recorded elbows fall: the median over tosses of the acceleration of the mass centre of both
    links until the first impact, where a parabola fits it. Some begin in the hand."""
    found = []
    for toss in tosses:
        count = flight(toss)
        if count < LONGEST:
            continue
        time = dt * np.arange(count)
        powers = np.stack([np.ones_like(time), time, 0.5 * time**2], 1)
        middle = toss.position[:count].mean(1)
        fit = np.linalg.lstsq(powers, middle, rcond=None)[0]
        if np.linalg.norm(middle - powers @ fit, axis=1).max() < HELD:
            found.append(fit[2])
    return np.median(found, axis=0)


def begun(tosses: Sequence[Links], dt: float, scene: Scene) -> list[tuple[Links, Recording]]:
    """Tosses, and what `sdfsim identify` makes of them, from the first frame of the flight that ends in the first
    impact: those that have such a flight, and last long enough."""
    poses = [np.concatenate(toss, -1) for toss in tosses]
    found = []
    for toss, r in zip(
        tosses, with_velocities([cleaned(str(k), dt, p, scene) for k, p in enumerate(poses)], scene), strict=True
    ):
        rows = np.flatnonzero(r.flying[: flight(toss)].all(1))
        if not len(rows) or flight(toss) - rows[-1] > FLIGHT:
            continue
        held = np.flatnonzero(~r.flying[: rows[-1]].all(1))
        first = int(held[-1]) + 1 if len(held) else 0
        if rows[-1] + 1 - first >= FLIGHT and len(toss.position) - first > FRAMES:
            found.append((Links(*(part[first:] for part in toss)), _from(r, first)))
    return found


def _from(r: Recording, first: int) -> Recording:
    names = ("position", "orientation", "velocity", "angular_velocity", "known", "flying", "seen")
    return replace(r, goal=(r.goal[0][first:], r.goal[1][first:]), **{n: getattr(r, n)[first:] for n in names})


def split(tosses: Sequence[tuple[Links, Recording]]) -> tuple[list, list]:
    """Tosses to find parameters on, and others to judge by."""
    if len(tosses) < FIT + TEST:
        raise SdfsimError(f"{len(tosses)} tosses are long enough (at least {FIT + TEST})")
    order = np.random.default_rng(SEED).permutation(len(tosses))
    return [tosses[k] for k in order[:FIT]], [tosses[k] for k in order[FIT : FIT + TEST]]


def start_of(r: Recording) -> Start:
    return Start(r.position[0], r.orientation[0], r.velocity[0], r.angular_velocity[0])


def recorded(tosses: Sequence[Links]) -> Motion:
    return Motion(*(np.stack([getattr(t, n)[1 : FRAMES + 1] for t in tosses]) for n in Motion._fields))


def errors(found: Motion, truth: Motion) -> np.ndarray:
    """[3, B] of each toss: root mean square distance of the links in % of a link's length, mean turn of the links in
    degrees, and mean error of the hinge's angle in degrees."""
    way = np.square(found.position - truth.position).sum(-1).mean((1, 2))
    one, other = (Rotation.from_quat(m.quat_xyzw.reshape(-1, 4)) for m in (found, truth))
    angle = (one * other.inv()).magnitude().reshape(found.position.shape[:3])
    bent = [
        Rotation.from_quat(m.quat_xyzw[:, :, 0].reshape(-1, 4)).inv()
        * Rotation.from_quat(m.quat_xyzw[:, :, 1].reshape(-1, 4))
        for m in (found, truth)
    ]
    hinge = (bent[0] * bent[1].inv()).magnitude().reshape(angle.shape[:2])
    return np.stack([100.0 / LINK[0] * np.sqrt(way), np.degrees(angle.mean((1, 2))), np.degrees(hinge.mean(1))])


def cost(found: Motion, truth: Motion) -> float:
    return float(np.minimum(errors(found, truth)[:2], FAR).mean(1).sum())


# --- what recordings say without any engine ---

CORNERS = 0.5 * LINK * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
ALONE, AWAY = 0.008, 0.003  # m: how much lower an impact's corner is than the next; how high all are after it
BEFORE, AFTER = 9, 6  # frames that tell the velocities before and after an impact


class Moving(NamedTuple):
    """Both links at one time: turns, and places [2, 3] and velocities [2, 3] about their mass centre, which moves with
    `speed` [3]."""

    turns: tuple[Rotation, Rotation]
    place: np.ndarray  # m
    velocity: np.ndarray  # m/s
    spin: np.ndarray  # rad/s
    speed: np.ndarray  # m/s

    def corner(self, link: int, corner: int) -> np.ndarray:
        """[3] m, about the mass centre."""
        return self.place[link] + self.turns[link].apply(CORNERS[corner])

    def velocity_of(self, link: int, point: np.ndarray) -> np.ndarray:
        return self.speed + self.velocity[link] + np.cross(self.spin[link], point - self.place[link])

    def turning(self) -> np.ndarray:
        """[3] N m s, the angular momentum of solid links about the mass centre."""
        inertia = (turn.as_matrix() @ np.diag(EVEN) @ turn.as_matrix().T for turn in self.turns)
        own = sum(i @ w for i, w in zip(inertia, self.spin, strict=True))
        return own + MASS * np.cross(self.place, self.velocity).sum(0)


def moving(toss: Links, frames: np.ndarray, at: float, dt: float, gravity: np.ndarray) -> Moving:
    """By parabolas through these frames, at the time `at` in frames."""
    time = dt * (frames - at)[:, None]
    powers = time ** np.arange(3)
    one, two = (Rotation.from_quat(toss.quat_xyzw[frames, k]) for k in (0, 1))
    turn, rate = np.linalg.lstsq(powers, (one * one[0].inv()).as_rotvec(), rcond=None)[0][:2]
    first, tiny = Rotation.from_rotvec(turn) * one[0], 1e-5
    spin = (Rotation.from_rotvec(turn + tiny * rate) * Rotation.from_rotvec(turn).inv()).as_rotvec() / tiny
    bent = np.linalg.lstsq(powers, np.unwrap((one.inv() * two).as_rotvec()[:, 1]), rcond=None)[0]
    second = first * Rotation.from_rotvec([0.0, bent[0], 0.0])
    spins = np.stack([spin, spin + bent[1] * first.apply([0.0, 1.0, 0.0])])
    arms = first.apply(PIVOT), second.apply(ARM)
    apart, fast = sum(arms), sum(np.cross(w, arm) for w, arm in zip(spins, arms, strict=True))
    middle = toss.position[frames].mean(1) - 0.5 * time**2 * gravity
    speed = np.linalg.lstsq(powers[:, :2], middle, rcond=None)[0][1]
    half = 0.5 * np.array([[-1.0], [1.0]])
    return Moving((first, second), half * apart, half * fast, spins, speed)


def impacts(tosses: Sequence[Links], dt: float, gravity: np.ndarray) -> dict[str, list[float]]:
    """Of first impacts of one corner after which nothing touches for a while, each as quartiles and their number:
    restitution of that corner, impulse along the table over that across it, and how much of the change of angular
    momentum an impulse at that corner does not make."""
    found: dict[str, list[float]] = {}
    for toss in tosses:
        first = flight(toss)
        turns = Rotation.from_quat(toss.quat_xyzw.reshape(-1, 4)).as_matrix().reshape(-1, 2, 3, 3)
        height = (toss.position[:, :, None] + np.einsum("tkij,cj->tkci", turns, CORNERS))[..., 2].reshape(-1, 16)
        low = height.min(1)
        if first < BEFORE + 1 or first + 2 >= len(low):
            continue
        at = first - 1 + int(np.argmin(low[first - 1 : first + 2]))
        after = np.arange(at + 1, at + 1 + AFTER)
        if after[-1] >= len(low) or low[after[1:]].min() < AWAY or np.diff(np.sort(height[at])[:2])[0] < ALONE:
            continue
        # Between frames: a fifth of one before the lowest.
        a, b = (moving(toss, k, at - 0.2, dt, gravity) for k in (np.arange(first - BEFORE - 1, first - 1), after))
        link, corner = divmod(int(height[at].argmin()), 8)
        push, arm = 2.0 * MASS * (b.speed - a.speed), a.corner(link, corner)
        if push[2] < 0.3:  # N s; the table throws back at least so much
            continue
        turned = b.turning() - a.turning()
        came, went = (one.velocity_of(link, one.corner(link, corner))[2] for one in (a, b))
        told = -went / came, np.hypot(*push[:2]) / push[2]
        left = np.linalg.norm(turned - np.cross(arm, push)) / np.linalg.norm(turned)
        names = "restitution", "impulse along over across", "angular momentum that is left"
        for name, value in zip(names, (*told, left), strict=True):
            found.setdefault(name, []).append(float(value))
    return {name: [*np.percentile(values, [25, 50, 75]).tolist(), len(values)] for name, values in found.items()}


def growth(found: Motion, truth: Motion, flights: Sequence[int]) -> dict[int, tuple[float, float]]:
    """By frames after the last before the first impact: medians of the distance of the links in mm and of their turn in
    degrees."""
    way = 1e3 * np.sqrt(np.square(found.position - truth.position).sum(-1).mean(-1))
    one, other = (Rotation.from_quat(m.quat_xyzw.reshape(-1, 4)) for m in (found, truth))
    angle = np.degrees((one * other.inv()).magnitude().reshape(found.position.shape[:3]).mean(-1))
    told = {}
    for frame in (0, 1, 2, 4, 8, 16, 32):
        rows = [(k, n - 2 + frame) for k, n in enumerate(flights) if 0 <= n - 2 + frame < FRAMES]  # poses from 1 on
        told[frame] = tuple(float(np.median([of[row] for row in rows])) for of in (way, angle))
    return told


# --- engines ---


def ours(starts: Sequence[Start], dt: float, scene: Scene) -> Motion:
    shape = (FRAMES + 1, 2)
    yes = np.ones(shape, bool)
    begun = []
    for start in starts:
        place, turn, speed, spin = (np.broadcast_to(v, (*shape, v.shape[-1])) for v in vars(start).values())
        begun.append(Recording("", dt, place, turn, speed, spin, yes[:, 0], ~yes, yes, (place, turn)))
    return Motion(*repeated(begun, scene, FRAMES))


def _falling(start: Start, step: float, gravity: np.ndarray) -> np.ndarray:
    """[2, 3] velocities with which engines that add gravity first fly along the exact parabola."""
    return start.velocity - 0.5 * step * gravity


def mujoco(starts: Sequence[Start], dt: float, gravity: np.ndarray, values: dict[str, float]) -> Motion:
    engine, rollout = (engine_module(name, "MuJoCo", "bench") for name in ("mujoco", "mujoco.rollout"))
    spec, step = engine.MjSpec(), dt / INNER
    spec.option.timestep, spec.option.gravity = step, gravity
    spec.option.cone, spec.option.impratio = engine.mjtCone.mjCONE_ELLIPTIC, IMPRATIO
    spec.worldbody.add_geom(type=engine.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1.0], pos=[0, 0, values["height"]])
    inertia = (values["inertia"] * EVEN).tolist()
    one = spec.worldbody.add_body(mass=MASS, inertia=inertia, explicitinertial=True)
    one.add_freejoint()
    two = one.add_body(pos=PIVOT, mass=MASS, inertia=inertia, ipos=ARM, explicitinertial=True)
    hinge = two.add_joint(type=engine.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], frictionloss=values["drag"])
    hinge.damping = np.array([values["damping_of_hinge"], 0.0, 0.0])
    for body, place in ((one, np.zeros(3)), (two, ARM)):
        geom = body.add_geom(type=engine.mjtGeom.mjGEOM_BOX, size=0.5 * values["side"] * LINK, pos=place)
        geom.priority, geom.condim, geom.friction[0] = 1, 3, values["friction"]
        geom.solref = [max(values["softness"], 2.0 * step), values["damping"]]
        geom.contype, geom.conaffinity = 2, 1
    spec.worldbody.geoms[0].contype, spec.worldbody.geoms[0].conaffinity = 1, 2
    model = spec.compile()
    state = []
    for start in starts:
        turns = Rotation.from_quat(start.quat_xyzw)
        angle = (turns[0].inv() * turns[1]).as_rotvec()[1]
        rate = (start.angular_velocity[1] - start.angular_velocity[0]) @ turns[0].apply([0.0, 1.0, 0.0])
        spin = turns[0].inv().apply(start.angular_velocity[0])
        quat = np.roll(start.quat_xyzw[0], 1)
        state.append([0.0, *start.position[0], *quat, angle, *_falling(start, step, gravity)[0], *spin, rate])
    data = engine.MjData(model)
    states = rollout.rollout(model, data, np.array(state), nstep=FRAMES * INNER)[0][:, INNER - 1 :: INNER]
    place, turn = states[..., 1:4], Rotation.from_quat(np.roll(states[..., 4:8], -1, axis=-1).reshape(-1, 4))
    return _links(place, turn, states[..., 8])


def _links(place: np.ndarray, one: Rotation, angle: np.ndarray) -> Motion:
    """Both links, by the pose of the first [B, T] and the angle of the hinge."""
    two = one * Rotation.from_rotvec(angle.reshape(-1, 1) * [0.0, 1.0, 0.0])
    other = place + (one.apply(PIVOT) + two.apply(ARM)).reshape(place.shape)
    turns = [turn.as_quat().reshape(*place.shape[:2], 4) for turn in (one, two)]
    return Motion(np.stack([place, other], 2), np.stack(turns, 2))


def bullet(starts: Sequence[Start], dt: float, gravity: np.ndarray, values: dict[str, float]) -> Motion:
    engine = import_pybullet()
    client, step = engine.connect(engine.DIRECT), dt / INNER
    here: dict[str, Any] = {"physicsClientId": client}
    try:
        engine.setGravity(*gravity, **here)
        engine.setTimeStep(step, **here)
        plane = engine.createCollisionShape(engine.GEOM_PLANE, **here)
        table = engine.createMultiBody(0.0, plane, basePosition=[0.0, 0.0, values["height"]], **here)
        engine.changeDynamics(table, -1, lateralFriction=1.0, restitution=1.0, **here)
        engine.setCollisionFilterGroupMask(table, -1, 1, 2, **here)
        half = (0.5 * values["side"] * LINK).tolist()
        box = engine.createCollisionShape(engine.GEOM_BOX, halfExtents=half, **here)
        other = engine.createCollisionShape(
            engine.GEOM_BOX, halfExtents=half, collisionFramePosition=ARM.tolist(), **here
        )
        elbows = []
        for start in starts:
            turns = Rotation.from_quat(start.quat_xyzw)
            elbow = engine.createMultiBody(
                MASS, box, -1, start.position[0], start.quat_xyzw[0], linkMasses=[MASS],
                linkCollisionShapeIndices=[other], linkVisualShapeIndices=[-1], linkPositions=[PIVOT.tolist()],
                linkOrientations=[[0, 0, 0, 1]], linkInertialFramePositions=[ARM.tolist()],
                linkInertialFrameOrientations=[[0, 0, 0, 1]], linkParentIndices=[0],
                linkJointTypes=[engine.JOINT_REVOLUTE], linkJointAxis=[[0, 1, 0]], **here,
            )  # fmt: skip
            for link in (-1, 0):
                engine.changeDynamics(
                    elbow, link, localInertiaDiagonal=(values["inertia"] * EVEN).tolist(),
                    lateralFriction=values["friction"], restitution=values["restitution"], linearDamping=0.0,
                    angularDamping=0.0, jointDamping=values["damping_of_hinge"], **here,
                )  # fmt: skip
                engine.setCollisionFilterGroupMask(elbow, link, 2, 1, **here)
            angle = (turns[0].inv() * turns[1]).as_rotvec()[1]
            rate = (start.angular_velocity[1] - start.angular_velocity[0]) @ turns[0].apply([0.0, 1.0, 0.0])
            engine.resetJointState(elbow, 0, angle, rate, **here)
            engine.setJointMotorControl2(
                elbow, 0, engine.VELOCITY_CONTROL, targetVelocity=0.0, force=values["drag"], **here
            )
            engine.resetBaseVelocity(elbow, _falling(start, step, gravity)[0], start.angular_velocity[0], **here)
            elbows.append(elbow)
        frames = []
        for _ in range(FRAMES):
            for _ in range(INNER):
                engine.stepSimulation(**here)
            frames.append(
                [
                    (*engine.getBasePositionAndOrientation(e, **here), engine.getJointState(e, 0, **here)[0])
                    for e in elbows
                ]
            )
    finally:
        engine.disconnect(client)
    place, turn, angle = (np.swapaxes(np.array([[o[k] for o in f] for f in frames]), 0, 1) for k in range(3))
    return _links(place, Rotation.from_quat(turn.reshape(-1, 4)), angle)


def table(result: dict[str, tuple[np.ndarray, np.ndarray]]) -> str:
    """Of each engine's errors [3, B] on the tosses that its parameters were found on, and on the others; best first."""
    heads = "links apart, % of a link", "turned, degrees", "hinge, degrees", "sdfsim less it", "the same on the 60"
    rows = [("", *heads)]
    for name, (fitted, judged) in sorted(result.items(), key=lambda item: item[1][1][0].mean()):
        cells = [f"{np.mean(e):.1f} +- {interval(e)[1] - np.mean(e):.1f}" for e in judged]
        less = judged if name == "sdfsim" or "sdfsim" not in result else result["sdfsim"][1] - judged
        apart = " / ".join("{:.1f} [{:.1f}, {:.1f}]".format(np.mean(e), *interval(e)) for e in less)
        known = ", ".join(f"{np.mean(e):.1f}" for e in fitted)
        rows.append((name, *cells, "" if less is judged else apart, known))
    return markdown(rows)


HINGE = {"drag": (0.0, 0.05), "damping_of_hinge": (0.0, 0.005), "inertia": (0.7, 2.0), "friction": (0.05, 0.6)}
Engine = Callable[[Sequence[Start], float, np.ndarray, dict[str, float]], Motion]
ENGINES: dict[str, tuple[Engine, dict[str, tuple[float, float]]]] = {
    "MuJoCo": (mujoco, SOFT | HINGE),
    "PyBullet": (bullet, SOLID | HINGE),
}


@one_thread()
def main(tosses: Path, out: Path, rounds: int, only: Sequence[str]) -> None:
    dt, known = load_tosses(tosses)
    out.mkdir(parents=True, exist_ok=True)
    gravity = gravity_of(known, dt)
    write_text(out / "scene.yaml", ELBOW.format(gravity=np.round(gravity, 4).tolist()))
    scene = load_scene(out / "scene.yaml")
    groups = split(begun(known, dt, scene))
    (fit, fit_truth), (test, test_truth) = (
        ([start_of(r) for _, r in group], recorded([toss for toss, _ in group])) for group in groups
    )
    flights = [flight(toss) for toss, _ in groups[1]]
    result: dict[str, Any] = {}
    for name, (low, middle, high, count) in impacts(known, dt, gravity).items():
        print(f"first impacts of one corner, {name}: {middle:.3f} ({low:.3f} to {high:.3f}), {count:.0f} of them")
    if "sdfsim" in only:
        progress(0.0, "sdfsim: identify")
        own = identify([r for _, r in groups[0]], scene, on_progress=progress)
        write_scene(own, out / "scene.yaml", out / "identified.yaml")
        found = load_scene(out / "identified.yaml")
        values = {"bodies": own.scene_values, "joints": own.joint_values}
        moved = [ours(starts, dt, found) for starts in (fit, test)]
        result["sdfsim"] = values, *(errors(m, t) for m, t in zip(moved, (fit_truth, test_truth), strict=True))
        print("sdfsim, mm and degrees by frames from the first impact:", growth(moved[1], test_truth, flights))
        write_json(out / "identified.json", own.report())
    for k, (name, (engine, bounds)) in enumerate(ENGINES.items(), 1):
        if name not in only:
            continue
        progress(k / 3, f"{name}: {rounds} rounds of a search over {len(bounds)} parameters")
        best = differential_evolution(
            lambda point, e=engine, b=bounds: cost(e(fit, dt, gravity, dict(zip(b, point, strict=True))), fit_truth),
            list(bounds.values()), maxiter=rounds - 1, popsize=CROWD // len(bounds), init="sobol", tol=0.0,
            polish=False, rng=SEED,
        )  # fmt: skip
        values = dict(zip(bounds, best.x.tolist(), strict=True))
        result[name] = (
            values,
            errors(engine(fit, dt, gravity, values), fit_truth),
            errors(engine(test, dt, gravity, values), test_truth),
        )
    kept = {n: {"values": v, "fit": f.tolist(), "test": j.tolist()} for n, (v, f, j) in result.items()}
    write_json(out / f"elbow-{'-'.join(result)}.json", kept)
    for name, (values, *_) in result.items():
        print(name, values)
    print(table({name: (fitted, judged) for name, (_, fitted, judged) in result.items()}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tosses", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--only", nargs="+", default=["sdfsim", *ENGINES])
    args = parser.parse_args()
    run_main(lambda: main(args.tosses, args.out, args.rounds, args.only))
