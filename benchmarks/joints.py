"""How long a joint takes, beside MuJoCo: a chain of a hundred links, and the ragdoll on its stairs.

    python benchmarks/joints.py

Rows are what joints hold: three for a ball, five for a hinge. MuJoCo works in the coordinates that joints leave, at the
inner step of ours, with its implicit integrator and its Newton solver.
"""

import math
import time
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim import Scene, Simulator, load_scene
from sdfsim.scene.scene import Body
from sdfsim.scene.scene import Scene as Loaded

ROWS = {"hinge": 5, "slider": 5, "ball": 3, "fixed": 6, "distance": 1}
SECONDS = 2.0


def chain(count: int = 100) -> Loaded:
    """Links that are let go from a level line, held at one end."""
    built = Scene(model="solver", effects={"sleep": "off", "contact": "off"})
    for k in range(count):
        form = {"shape": "link0"} if k else {"box": {"size": (0.05, 0.01, 0.01)}}
        built.add(f"link{k}", **form, position=(0.05 * k + 0.025, 0, 0), mass=0.02)
        built.join(f"joint{k}", "ball", f"link{k}", f"link{k - 1}" if k else "world", anchor=(0.05 * k, 0, 0))
    return built.load()


def mjcf(scene: Loaded, step: float) -> str:
    """A tree of joints and boxes as MuJoCo reads it."""
    root = Element("mujoco")
    gravity = " ".join(map(str, scene.gravity))
    SubElement(root, "option", timestep=str(step), gravity=gravity, integrator="implicitfast", cone="elliptic")
    SubElement(root, "compiler", angle="radian")
    world = SubElement(root, "worldbody")
    held = {joint.bodies[0]: joint for joint in scene.joints}
    made: dict[int, Element] = {}

    def numbers(values) -> str:
        return " ".join(f"{v:.9g}" for v in values)

    def solid(element: Element, body: Body) -> None:
        form: Any = scene.shapes[body.shape].sdf
        size = [0, 0, 1] if form.KIND == "plane" else 0.5 * np.ptp(form.bounds, axis=0)
        contact: Any = {} if scene.effects.contact != "off" else {"contype": "0", "conaffinity": "0"}
        friction = f"{body.friction**2:g} 0.001 0.0001"
        mass: Any = {"mass": f"{body.mass:.9g}"} if body.mass else {}
        SubElement(element, "geom", type=form.KIND, size=numbers(size), friction=friction, **mass, **contact)

    def place(k: int) -> Element:
        if k in made:
            return made[k]
        body, joint = scene.bodies[k], held.get(k)
        above = joint.bodies[1] if joint is not None and joint.bodies[1] >= 0 else -1
        parent = world if above < 0 else place(above)
        base, turn = np.zeros(3), Rotation.identity()
        if above >= 0:
            base, turn = scene.bodies[above].position, Rotation.from_quat(scene.bodies[above].quat_xyzw)
        own = turn.inv() * Rotation.from_quat(body.quat_xyzw)
        at: Any = {"pos": numbers(turn.inv().apply(body.position - base)), "quat": numbers(np.roll(own.as_quat(), 1))}
        made[k] = element = SubElement(parent, "body", name=body.name, **at)
        if joint is not None:
            axis = Rotation.from_quat(joint.quat_xyzw[0]).apply([1.0, 0.0, 0.0])
            given: Any = {"type": joint.kind, "pos": numbers(joint.anchor[0]), "damping": str(joint.damping)}
            given |= {"frictionloss": str(joint.friction)}
            if joint.kind == "hinge":
                given["axis"] = numbers(axis)
            if joint.limits is not None:
                given |= {"limited": "true", "range": numbers(joint.limits)}
            SubElement(element, "joint", **given)
        elif body.motion == "dynamic":
            SubElement(element, "freejoint")
        solid(element, body)
        return element

    for k in range(len(scene.bodies)):
        place(k)
    return tostring(root, encoding="unicode")


def timed(scene: Loaded) -> tuple[float, float, float]:
    """Milliseconds a simulated second of ours and of MuJoCo's, and the inner step in ms."""
    import mujoco  # part of the extra `bench`

    simulator = Simulator(scene)
    simulator.step(2)
    simulator.reset()
    steps = simulator.steps_in(SECONDS)
    started = time.perf_counter()
    simulator.step(steps)
    ours = time.perf_counter() - started
    inner = simulator.dt / simulator.options.substeps
    engine: Any = mujoco
    model = engine.MjModel.from_xml_string(mjcf(scene, inner))
    data = engine.MjData(model)
    for body in scene.bodies:
        row = model.body(body.name).id
        if body.motion == "dynamic" and model.body_jntnum[row] and model.jnt_type[model.body_jntadr[row]] == 0:
            first = model.jnt_dofadr[model.body_jntadr[row]]
            data.qvel[first : first + 3] = body.velocity
    started = time.perf_counter()
    for _ in range(math.ceil(SECONDS / inner)):
        engine.mj_step(model, data)
    theirs = time.perf_counter() - started
    return 1e3 * ours / SECONDS, 1e3 * theirs / SECONDS, 1e3 * inner


def main() -> None:
    samples = Path(__file__).parents[1] / "samples"
    scenes = {"chain of 100": chain(), "ragdoll": load_scene(samples / "ragdoll.yaml")}
    print("| scene | joints | rows | inner step | ms a second | MuJoCo's | us a row | MuJoCo's |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, scene in scenes.items():
        rows = sum(ROWS[joint.kind] for joint in scene.joints)
        ours, theirs, inner = timed(scene)
        each = [1e3 * took / (rows * 1e3 / inner) for took in (ours, theirs)]
        told = f"| {name} | {len(scene.joints)} | {rows} | {inner:.2f} ms | {ours:.0f} | {theirs:.0f} |"
        print(f"{told} {each[0]:.2f} | {each[1]:.2f} |")


if __name__ == "__main__":
    main()
