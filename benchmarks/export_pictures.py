"""The pictures of docs/export.md: what other programs make of an exported run.

    MUJOCO_GL=egl python benchmarks/export_pictures.py RUN -o docs/images

RUN is a run folder of samples/pile.yaml. trimesh and OpenUSD show the end of the run. MuJoCo and PyBullet start where
the run starts, and show where their own motion ends.
"""

from __future__ import annotations

import argparse
import csv
import json
import struct
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from sdfsim.export import export

WIDTH, HEIGHT, VIEW = 560, 420, 40.0  # px, px, degrees from top to bottom
EYE, TARGET, SUN = np.array([0.75, -0.95, 0.62]), np.array([0.0, 0.0, 0.06]), np.array([0.34, -0.25, 0.91])
END = 4.0  # s


def by_trimesh(file: Path) -> np.ndarray:
    import trimesh

    content, scene = file.read_bytes(), trimesh.load_scene(file)
    (length,) = struct.unpack("<I", content[12:16])
    tree, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    for channel in tree["animations"][0]["channels"]:  # trimesh reads the start alone
        accessor = tree["accessors"][tree["animations"][0]["samplers"][channel["sampler"]]["output"]]
        width = int(accessor["type"][-1])
        begin = tree["bufferViews"][accessor["bufferView"]]["byteOffset"] + 4 * width * (accessor["count"] - 1)
        last, node = np.frombuffer(binary, "<f4", width, begin), tree["nodes"][channel["target"]["node"]]["name"]
        matrix = np.array(scene.graph.get(node, "root")[0])
        if width == 3:
            matrix[:3, 3] = last
        else:
            matrix[:3, :3] = trimesh.transformations.quaternion_matrix(np.roll(last, 1))[:3, :3]
        scene.graph.update(frame_from="root", frame_to=node, matrix=matrix)
    parts = []
    for node in scene.graph.nodes_geometry:
        mesh: Any = scene.geometry[scene.graph[node][1]]
        color = np.array(mesh.visual.material.baseColorFactor[:3]) / 255.0
        parts.append((mesh.copy().apply_transform(scene.graph.get(node, "root")[0]), color))
    return drawn(parts)


def by_openusd(file: Path) -> np.ndarray:
    from pxr import Usd, UsdGeom
    from trimesh import Trimesh, creation

    forms: dict[str, Any] = {
        "Mesh": lambda read: Trimesh(np.array(read("points")), np.reshape(read("faceVertexIndices"), (-1, 3))),
        "Cube": lambda read: creation.box([read("size")] * 3),
        "Sphere": lambda read: creation.icosphere(4, read("radius")),
        "Plane": lambda read: creation.box([read("width"), read("length"), 1e-6]),
    }
    stage, parts = Usd.Stage.Open(str(file)), []
    places = UsdGeom.XformCache(stage.GetEndTimeCode())
    for prim in stage.Traverse():
        if prim.GetTypeName() in forms and UsdGeom.Imageable(prim).ComputePurpose() != "guide":
            mesh = forms[prim.GetTypeName()](lambda name, prim=prim: prim.GetAttribute(name).Get())
            color = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor").Get()[0]
            parts.append((mesh.apply_transform(np.array(places.GetLocalToWorldTransform(prim)).T), np.array(color)))
    return drawn(parts)


def drawn(parts: list[tuple[Any, np.ndarray]]) -> np.ndarray:
    """What a camera sees of meshes and their colours (as light, 0 to 1): matt surfaces, a sun and its shadows."""
    import open3d

    scene: Any = open3d.t.geometry.RaycastingScene()
    for mesh, _ in parts:
        scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    ahead = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, HEIGHT / 2 - np.arange(HEIGHT) - 0.5)
    deep = HEIGHT / 2 / np.tan(np.deg2rad(VIEW) / 2)
    ways = x[..., None] * right + y[..., None] * np.cross(right, ahead) + deep * ahead
    seen = scene.cast_rays(np.concatenate([np.broadcast_to(EYE, ways.shape), ways], -1).astype(np.float32))
    hit, far, normal = (seen[key].numpy() for key in ("geometry_ids", "t_hit", "primitive_normals"))
    there = (hit != scene.INVALID_ID)[..., None]
    normal = -normal * np.sign((normal * ways).sum(-1, keepdims=True))
    point = EYE + np.where(there, far[..., None], 0.0) * ways + 1e-4 * normal
    dark = scene.test_occlusions(np.concatenate([point, np.broadcast_to(SUN, point.shape)], -1).astype(np.float32))
    light = (0.35 + 0.65 * np.clip(normal @ SUN, 0, None) * ~dark.numpy())[..., None]
    image = np.where(there, np.array([color for _, color in parts])[np.where(there[..., 0], hit, 0)] * light, 0.75)
    return np.round(255 * np.clip(image, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def by_mujoco(file: Path) -> np.ndarray:
    import mujoco as engine

    mujoco: Any = engine
    model = mujoco.MjModel.from_xml_path(str(file))
    model.vis.global_.fovy = VIEW
    data, camera, away = mujoco.MjData(model), mujoco.MjvCamera(), TARGET - EYE
    mujoco.mj_resetDataKeyframe(model, data, 0)
    while data.time < END:
        mujoco.mj_step(model, data)
    camera.lookat, camera.distance = TARGET, np.linalg.norm(away)
    camera.azimuth, camera.elevation = np.rad2deg([np.arctan2(away[1], away[0]), np.arcsin(away[2] / camera.distance)])
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render()


def by_pybullet(file: Path) -> np.ndarray:
    import pybullet as engine

    engine.connect(engine.DIRECT)
    engine.setGravity(0, 0, -9.81)
    for row in csv.DictReader(file.with_suffix(".csv").open()):
        place, turn = [float(row[c]) for c in "xyz"], [float(row[f"q{c}"]) for c in "xyzw"]
        urdf, flags = str(file.with_suffix(f".{row['body']}.urdf")), engine.URDF_USE_INERTIA_FROM_FILE
        engine.loadURDF(urdf, place, turn, flags=flags)
    for _ in range(round(240 * END)):
        engine.stepSimulation()
    view = engine.computeViewMatrix(EYE.tolist(), TARGET.tolist(), [0, 0, 1])
    lens = engine.computeProjectionMatrixFOV(VIEW, WIDTH / HEIGHT, 0.05, 20.0)
    tiny = {"renderer": engine.ER_TINY_RENDERER, "lightDirection": (10 * SUN).tolist(), "shadow": 1}
    image = engine.getCameraImage(WIDTH, HEIGHT, view, lens, **tiny)[2]
    engine.disconnect()
    return np.reshape(image, (HEIGHT, WIDTH, 4))[..., :3].astype(np.uint8)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    for name, draw in {"glb": by_trimesh, "usd": by_openusd, "xml": by_mujoco, "urdf": by_pybullet}.items():
        with TemporaryDirectory() as folder:
            export(given.run, Path(folder) / f"pile.{name}", allow_outside=True)
            Image.fromarray(draw(Path(folder) / f"pile.{name}")).save(given.out / f"export-{name}.jpg", quality=88)
