"""Exports, read back by the programs that they are for: trimesh, OpenUSD, MuJoCo, PyBullet, and our own `identify`; and
judged by the validators of Khronos, OpenUSD and NVIDIA."""

import csv
import json
import os
import shutil
import struct
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco  # noqa: TID253
import numpy as np
import pytest
import trimesh  # noqa: TID253
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdValidation
from scipy.spatial.transform import Rotation

import sdfsim
from sdfsim import Rollout, SdfsimError, Simulator, load_scene
from sdfsim.apps.export import convex_pieces, export
from sdfsim.apps.observed import load_recordings
from sdfsim.apps.run import simulate
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, is_closed, signed_volume
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape, mesh_shape
from sdfsim.shape.shape import load_shape
from tests.helpers.command import run
from tests.helpers.mujoco_start import at_start

SHAPES = Path(__file__).resolve().parents[2] / "samples" / "shapes"
SECONDS = 1.2
SCENE = """
version: 1
duration: 1.2
shapes:
  ring: {{asset: {shapes}/ring}}
  cone: {{asset: {shapes}/cone}}
  bowl: {{asset: {shapes}/bowl}}
  box: {{box: {{size: [0.1, 0.08, 0.06]}}}}
  ball: {{sphere: {{radius: 0.05}}}}
  pill: {{capsule: {{radius: 0.03, height: 0.1}}}}
  can: {{cylinder: {{radius: 0.03, height: 0.08}}}}
bodies:
  - {{name: floor, plane: {{}}, friction: 0.8, restitution: 0.1}}
  - {{name: the ring, shape: ring, scale: 0.4, position: [0, 0, 0.08], euler_xyz_deg: [12, 8, 30], mass: 0.1,
     friction: 0.6, restitution: 0.1}}
  - {{name: cone, shape: cone, scale: 0.5, position: [0.5, 0, 0.06], euler_xyz_deg: [4, 2, 0], restitution: 0.1}}
  - {{name: 1 box, shape: box, position: [0, 0.5, 0.09], euler_xyz_deg: [9, -7, 20], restitution: 0.1}}
  - {{name: slider, shape: box, position: [0, 1, 0.031], velocity: [1, 0.3, 0], angular_velocity: [0, 0, 3],
     friction: 0.4, restitution: 0.1}}
  - {{name: pill, shape: pill, position: [0.5, 0.5, 0.12], euler_xyz_deg: [90, 0, 0], collides_with: [floor]}}
  - {{name: can, shape: can, position: [1, 0.5, 0.06]}}
  - {{name: bowl, shape: bowl, motion: static, position: [-1, 0, 0.6], restitution: 0.1}}
  - {{name: ball, shape: ball, position: [-1, 0, 0.4], restitution: 0.1, friction: 0.9}}
  - {{name: sweep, shape: box, motion: kinematic, path: [{{time: 0, position: [0, -1, 0.2]}},
     {{time: 1, position: [1, -1, 0.2], euler_xyz_deg: [0, 0, 90]}}]}}
"""
RESTING = ("the ring", "cone", "1 box", "slider", "ball")


@dataclass(frozen=True)
class Dropped:
    """A run, its scene, and where its files are."""

    folder: Path
    file: Path
    scene: Scene
    rollout: Rollout

    def index(self, name: str) -> int:
        return self.rollout.names.index(name)

    def centre(self, name: str) -> np.ndarray:
        """[3] m, the centre of mass at the end."""
        return self.rollout.position[-1, self.index(name)]

    def pose(self, name: str) -> np.ndarray:
        """[4, 4] of the shape's own frame at the end."""
        k = self.index(name)
        body = self.scene.bodies[k]
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(self.rollout.orientation[-1, k]).as_matrix()
        matrix[:3, 3] = self.rollout.position[-1, k] - matrix[:3, :3] @ (body.scale * self.scene.shapes[body.shape].com)
        return matrix

    def inertia(self, name: str) -> np.ndarray:
        body = self.scene.bodies[self.index(name)]
        shape = self.scene.shapes[body.shape]
        return body.mass / (shape.volume * body.scale**3) * shape.inertia * body.scale**5

    def export(self, name: str, *, motion: bool = True) -> Path:
        export(self.folder if motion else self.file, self.folder / "out" / name, allow_outside=True)
        return self.folder / "out" / name


@pytest.fixture(scope="module")
def dropped(tmp_path_factory) -> Dropped:
    folder = tmp_path_factory.mktemp("run")
    file = folder / "scene.yaml"
    file.write_text(SCENE.format(shapes=SHAPES))
    scene = load_scene(file, allow_outside=True)
    rollout = Simulator(scene).run(seconds=SECONDS)
    rollout.save(folder / "rollout.npz")
    (folder / "config.yaml").write_text(f"command: simulate\nscene: {file}\n")
    return Dropped(folder, file, scene, rollout)


# --- glTF ---


def chunks(path: Path) -> tuple[dict, bytes]:
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def values(tree: dict, binary: bytes, number: int) -> np.ndarray:
    accessor = tree["accessors"][number]
    view = tree["bufferViews"][accessor["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    assert accessor["componentType"] == 5126
    found = np.frombuffer(binary, "<f4", accessor["count"] * width, view["byteOffset"])
    return found.reshape(-1, width)


def test_a_glb_of_a_run_moves_as_the_run_did(dropped):
    tree, binary = chunks(dropped.export("run.glb"))
    (animation,) = tree["animations"]
    moving = [body.name for body in dropped.scene.bodies if body.motion != "static"]
    assert len(animation["channels"]) == 2 * len(moving)
    names = {"1 box": "_1_box", "the ring": "the_ring"}
    for name in moving:
        node = next(k for k, n in enumerate(tree["nodes"]) if n["name"] == names.get(name, name))
        assert "matrix" not in tree["nodes"][node]
        track = {}
        for channel in animation["channels"]:
            if channel["target"]["node"] == node:
                sampler = animation["samplers"][channel["sampler"]]
                assert sampler["interpolation"] == "LINEAR"
                np.testing.assert_allclose(
                    values(tree, binary, sampler["input"])[:, 0], dropped.rollout.time, atol=1e-6
                )
                track[channel["target"]["path"]] = values(tree, binary, sampler["output"])
        end = dropped.pose(name)
        np.testing.assert_allclose(track["translation"][-1], end[:3, 3], atol=1e-6)
        np.testing.assert_allclose(Rotation.from_quat(track["rotation"][-1]).as_matrix(), end[:3, :3], atol=1e-6)
        assert ((track["rotation"][1:] * track["rotation"][:-1]).sum(1) > 0).all()


def test_trimesh_finds_the_bodies_of_a_glb_upright_and_in_place(dropped):
    found = trimesh.load_scene(dropped.export("scene.glb", motion=False))
    turn = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    for name, plain in (("cone", "cone"), ("1 box", "_1_box"), ("sweep", "sweep")):
        body = dropped.scene.bodies[dropped.index(name)]
        matrix, geometry = found.graph[plain]
        vertices = found.geometry[geometry].vertices @ matrix[:3, :3].T + matrix[:3, 3]
        shape = dropped.scene.shapes[body.shape]
        own = body.scale * shape.mesh.vertices @ Rotation.from_quat(body.quat_xyzw).as_matrix().T + body.position
        own = own @ turn.T
        np.testing.assert_allclose([vertices.min(0), vertices.max(0)], [own.min(0), own.max(0)], atol=1e-6)


def test_vertex_colours_are_kept_as_light(tmp_path):
    shape = load_shape(SHAPES / "ring")
    colors = np.tile(np.array([10, 128, 255], dtype=np.uint8), (len(shape.mesh.vertices), 1))
    replace(shape, mesh=replace(shape.mesh, colors=colors)).save(tmp_path / "shape")
    export(tmp_path / "shape", tmp_path / "shape.glb")
    tree, binary = chunks(tmp_path / "shape.glb")
    mesh = tree["meshes"][0]  # the others are its convex pieces
    accessor = tree["accessors"][mesh["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["normalized"]) == (5123, True)
    start = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
    np.testing.assert_allclose(np.frombuffer(binary, "<u2", 4, start) / 65535, [0.0030, 0.2159, 1, 1], atol=1e-4)


def test_a_texture_lies_where_it_lay(tmp_path):
    shape = load_shape(SHAPES / "ring")
    rng = np.random.default_rng(0)
    uv, texture = rng.random((len(shape.mesh.vertices), 2)), np.zeros((32, 64, 3), dtype=np.uint8)
    texture[:16, :32] = (200, 40, 40)
    replace(shape, skin=replace(shape.mesh, uv=uv, texture=texture)).save(tmp_path / "shape")
    export(tmp_path / "shape", tmp_path / "shape.glb")
    found = next(iter(trimesh.load_scene(tmp_path / "shape.glb").geometry.values()))  # then its convex pieces
    np.testing.assert_allclose(
        found.visual.to_color().vertex_colors[:5, :3] > 100, np.outer((uv[:5] < 0.5).all(1), (1, 0, 0))
    )
    np.testing.assert_allclose(found.visual.uv, uv * [1, -1] + [0, 1], atol=1e-6)
    tree, _ = chunks(tmp_path / "shape.glb")
    assert tree["images"][0]["mimeType"] == "image/jpeg"
    # Lamps and shadows of other programs fall on it.
    assert "KHR_materials_unlit" not in tree["extensionsUsed"] and "extensions" not in tree["materials"][0]


def test_a_glb_has_the_masses_the_colliders_and_the_surfaces(dropped):
    tree, _ = chunks(dropped.export("scene.glb", motion=False))
    physics, shapes = (tree["extensions"][f"KHR_{name}"] for name in ("physics_rigid_bodies", "implicit_shapes"))
    node_of = {node["name"]: node for node in tree["nodes"]}

    def own(node: dict) -> dict:
        return node["extensions"]["KHR_physics_rigid_bodies"]

    def colliders(name: str) -> list[tuple[dict, dict]]:
        """The nodes of a body that have a collider, with it."""
        nodes = [node_of[name], *(tree["nodes"][k] for k in node_of[name].get("children", ()))]
        return [(node, own(node)["collider"]) for node in nodes if "collider" in node.get("extensions", {}).get(
            "KHR_physics_rigid_bodies", {})]  # fmt: skip

    def form(name: str) -> dict:
        ((node, made),) = colliders(name)
        found = shapes["shapes"][made["geometry"]["shape"]]
        if found["type"] in ("plane", "capsule", "cylinder"):  # along y there, along z here
            np.testing.assert_allclose(Rotation.from_quat(node["rotation"]).apply([0, 1, 0]), [0, 0, 1], atol=1e-12)
        return found

    names = {"1 box": "_1_box", "the ring": "the_ring"}
    for name in ("the ring", "cone", "1 box", "slider"):
        body, node = dropped.scene.bodies[dropped.index(name)], node_of[names.get(name, name)]
        motion, turn = own(node)["motion"], Rotation.from_quat(node["rotation"])
        axes = Rotation.from_quat(motion["inertiaOrientation"]).as_matrix()
        inertia = axes @ np.diag(motion["inertiaDiagonal"]) @ axes.T
        np.testing.assert_allclose(inertia, dropped.inertia(name), atol=1e-9 * np.abs(inertia).max())
        assert "scale" not in node and motion["mass"] == pytest.approx(body.mass)
        assert motion["centerOfMass"] == pytest.approx(body.scale * dropped.scene.shapes[body.shape].com)
        assert turn.apply(motion["linearVelocity"]) == pytest.approx(body.velocity)
        assert turn.apply(motion["angularVelocity"]) == pytest.approx(body.angular_velocity)
        surface = physics["physicsMaterials"][colliders(names.get(name, name))[0][1]["physicsMaterial"]]
        assert (surface["dynamicFriction"], surface["restitution"]) == (body.friction, body.restitution)
        assert surface["frictionCombine"] == surface["restitutionCombine"] == "multiply"
    assert own(node_of["sweep"])["motion"] == {"isKinematic": True} and "motion" not in own(node_of["bowl"])
    assert form("floor") == {"type": "plane", "plane": {}}
    assert form("ball") == {"type": "sphere", "sphere": {"radius": 0.05}}
    assert form("_1_box")["box"]["size"] == pytest.approx([0.1, 0.08, 0.06])
    for name, height in (("pill", 0.04), ("can", 0.08)):  # of the pill without its ends
        made = form(name)
        assert made[made["type"]] == pytest.approx({"height": height, "radiusBottom": 0.03, "radiusTop": 0.03})
    pieces = [made["geometry"] for _, made in colliders("the_ring")]
    assert len(pieces) == 32 and all(piece["convexHull"] for piece in pieces)
    assert not {piece["node"] for piece in pieces} & set(tree["nodes"][-1]["children"])  # they are not drawn
    assert colliders("bowl")[0][1]["geometry"] == {"node": list(node_of).index("bowl")}
    filters = [
        physics["collisionFilters"][colliders(name)[0][1]["collisionFilter"]] for name in ("pill", "can", "floor")
    ]
    (pill, can, floor) = ((one["collisionSystems"], one.get("notCollideWithSystems", [])) for one in filters)
    assert set(pill[0]) <= set(can[1]) and set(can[0]) <= set(pill[1]) and floor[1] == []


CHECK = """
const [checked, files] = [require('gltf-validator'), require('fs')]
checked.validateBytes(new Uint8Array(files.readFileSync(process.argv[1])))
  .then(report => console.log(JSON.stringify(report.issues)))
"""


@pytest.mark.slow
def test_khronos_validator_finds_no_fault_in_a_glb(dropped, tmp_path):
    node = shutil.which("node")
    if node is None or subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode:
        pytest.skip("no gltf-validator (npm install -g gltf-validator; export NODE_PATH=$(npm root -g))")

    def faults(path: Path) -> int:
        done = subprocess.run([node, "-e", CHECK, path], check=True, capture_output=True, text=True)
        issues = json.loads(done.stdout)
        return issues["numErrors"] + issues["numWarnings"]

    for sample in ("cart", "ragdoll"):  # a texture; joints
        export(sample, tmp_path / f"{sample}.glb")
        assert faults(tmp_path / f"{sample}.glb") == 0
    moving = dropped.export("run.glb")
    assert faults(moving) == 0
    (tmp_path / "bad.glb").write_bytes(moving.read_bytes().replace(b'"LINEAR"', b'"BEZIER"'))
    assert faults(tmp_path / "bad.glb") > 0


@pytest.mark.slow
def test_blender_opens_a_run_with_the_add_on(dropped):
    if not (python := os.environ.get("BLENDER_PYTHON")):
        pytest.skip("BLENDER_PYTHON names no Python with bpy: see scripts/blender_check.py")
    script = SHAPES.parents[1] / "scripts" / "blender_check.py"
    done = subprocess.run([python, script, dropped.folder, Path(sys.executable).with_name("sdfsim")], text=True)
    assert done.returncode == 0


@pytest.mark.slow
def test_validators_of_usd_find_no_fault(dropped, tmp_path):
    every = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    for sample in ("cart", "ragdoll"):
        export(sample, tmp_path / f"{sample}.usdc")
    files = [dropped.export("run.usdc"), tmp_path / "cart.usdc", tmp_path / "ragdoll.usdc"]
    for file in files:
        stage = Usd.Stage.Open(str(file))
        assert UsdValidation.ValidationContext(every).Validate(stage) == []
    UsdPhysics.Joint(stage.GetPrimAtPath("/World/joints/neck")).GetBody0Rel().SetTargets(["/World/nobody"])
    assert UsdValidation.ValidationContext(every).Validate(stage)


@pytest.mark.slow
def test_nvidia_s_validator_finds_no_fault_in_a_usd(dropped, tmp_path):
    """With the rules of simready-validate's own validator, which are not those of SimReady's catalogue of assets."""
    checked = pytest.importorskip("usd_validation_nvidia", reason="pip install simready-validate")
    export("ragdoll", tmp_path / "ragdoll.usdc")
    for file in (dropped.export("run.usdc"), tmp_path / "ragdoll.usdc"):
        issues = checked.ValidationEngine().validate(str(file)).issues()
        assert [issue.message for issue in issues if issue.severity.name != "WARNING"] == []


def test_options_that_a_format_has_no_use_for_are_refused(dropped, tmp_path):
    for ending, options, told in (
        ("xml", {"fps": 24}, "--fps 24: no motion in it"),
        ("glb", {"fps": 0}, "--fps 0: must be above 0"),
        ("glb", {"fps": float("nan")}, "--fps nan: must be above 0"),
        ("usda", {"collide": "sdf"}, "--collide sdf: is for MuJoCo"),
    ):
        with pytest.raises(SdfsimError, match=told):
            export(dropped.folder, tmp_path / f"run.{ending}", allow_outside=True, **options)
    assert not list(tmp_path.iterdir())


# --- USD ---


@pytest.mark.parametrize("fps", [24, 29.97])
def test_a_usd_stage_plays_whole_frames_at_the_rate_that_was_asked_for(dropped, tmp_path, fps):
    """A program that plays one time code a frame shows the ball where it was at that time."""
    export(dropped.folder, tmp_path / "run.usda", fps=fps, allow_outside=True)
    stage = Usd.Stage.Open(str(tmp_path / "run.usda"))
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == fps
    place = UsdGeom.Xformable(stage.GetPrimAtPath("/World/ball")).GetOrderedXformOps()[0]
    codes = place.GetTimeSamples()
    assert codes == list(range(len(codes))) and (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, codes[-1])
    true, time = dropped.rollout.position[:, dropped.index("ball")], np.array(codes) / fps
    for axis in range(3):
        found = [place.Get(code)[axis] for code in codes]
        np.testing.assert_allclose(found, np.interp(time, dropped.rollout.time, true[:, axis]), atol=2e-4)


@pytest.mark.parametrize("ending", ["usda", "usdc"])
def test_a_usd_stage_has_the_motion_and_the_physics(dropped, ending):
    stage = Usd.Stage.Open(str(dropped.export(f"run.{ending}")))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    gravity = UsdPhysics.Scene(stage.GetPrimAtPath("/World/physics"))
    assert gravity.GetGravityMagnitudeAttr().Get() == pytest.approx(9.81)
    cache = UsdGeom.XformCache(stage.GetEndTimeCode())
    assert stage.GetEndTimeCode() / stage.GetTimeCodesPerSecond() == pytest.approx(dropped.rollout.time[-1])
    for name, plain in (("the ring", "the_ring"), ("cone", "cone"), ("sweep", "sweep"), ("bowl", "bowl")):
        body, prim = dropped.scene.bodies[dropped.index(name)], stage.GetPrimAtPath(f"/World/{plain}")
        np.testing.assert_allclose(np.array(cache.GetLocalToWorldTransform(prim)).T, dropped.pose(name), atol=1e-6)
        assert prim.HasAPI(UsdPhysics.RigidBodyAPI) == (body.motion != "static")
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
        surface = UsdPhysics.MaterialAPI(material.GetPrim())
        assert surface.GetDynamicFrictionAttr().Get() == pytest.approx(body.friction)
        assert surface.GetRestitutionAttr().Get() == pytest.approx(body.restitution)
        if body.motion == "dynamic":
            mass = UsdPhysics.MassAPI(prim)
            assert mass.GetMassAttr().Get() == pytest.approx(body.mass)
            axes = np.array(Gf.Matrix3d(Gf.Rotation(Gf.Quatd(mass.GetPrincipalAxesAttr().Get())))).T
            inertia = axes @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ axes.T
            np.testing.assert_allclose(inertia, dropped.inertia(name), atol=1e-6 * np.abs(inertia).max())
            com = body.scale * dropped.scene.shapes[body.shape].com
            np.testing.assert_allclose(mass.GetCenterOfMassAttr().Get(), com, atol=1e-8)
    assert UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath("/World/sweep")).GetKinematicEnabledAttr().Get()


def test_usd_colliders_are_exact_forms_hulls_or_triangles(dropped):
    stage = Usd.Stage.Open(str(dropped.export("scene.usda", motion=False)))

    def colliders(name: str) -> list:
        prims = Usd.PrimRange(stage.GetPrimAtPath(f"/World/{name}"))
        return [prim for prim in prims if prim.HasAPI(UsdPhysics.CollisionAPI)]

    forms = {"floor": "Plane", "_1_box": "Cube", "ball": "Sphere", "pill": "Capsule", "can": "Cylinder"}
    for name, kind in forms.items():
        assert [prim.GetTypeName() for prim in colliders(name)] == [kind]
    for name, count, approximation in (("the_ring", 32, "convexHull"), ("bowl", 1, "none")):
        told = [UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() for prim in colliders(name)]
        assert told == [approximation] * count
    box = UsdGeom.Imageable(colliders("_1_box")[0]).ComputeWorldBound(0, "default").ComputeAlignedRange().GetSize()
    half = dropped.scene.shapes[dropped.scene.bodies[3].shape].mesh.vertices
    own = half @ Rotation.from_quat(dropped.scene.bodies[3].quat_xyzw).as_matrix().T
    np.testing.assert_allclose(box, np.ptp(own, axis=0), atol=1e-6)


def test_usd_samples_distances_of_a_body_without_pieces(tmp_path):
    """As PhysX (Isaac Sim, ManiSkill) and Newton read it; the former needs a resolution above 0, the latter one that
    eight divides."""
    ring = mesh_shape(load_shape(SHAPES / "ring").mesh, name="hoop", kind="grid")
    ring.save(tmp_path / "hoop")
    export(tmp_path / "hoop", tmp_path / "hoop.usda")
    stage = Usd.Stage.Open(str(tmp_path / "hoop.usda"))
    (collider,) = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.MeshCollisionAPI)]
    assert UsdPhysics.MeshCollisionAPI(collider).GetApproximationAttr().Get() == "sdf"
    applied = collider.GetPrimTypeInfo().GetAppliedAPISchemas() + collider.GetMetadata("apiSchemas").GetAppliedItems()
    assert {"PhysxSDFMeshCollisionAPI", "NewtonSDFCollisionAPI"} <= set(applied)
    assert collider.GetAttribute("physxSDFMeshCollision:sdfResolution").Get() == 256
    cells = collider.GetAttribute("newton:sdfMaxResolution").Get()
    assert cells > 0 and cells % 8 == 0


def test_usd_groups_keep_apart_what_collides_with_does(dropped):
    stage = Usd.Stage.Open(str(dropped.export("scene.usda", motion=False)))
    table = UsdPhysics.CollisionGroup.ComputeCollisionGroupTable(stage)
    group = {}
    for made in table.GetGroups():
        collection = UsdPhysics.CollisionGroup(stage.GetPrimAtPath(made)).GetCollidersCollectionAPI()
        for path in collection.GetIncludesRel().GetTargets():
            group[path.name] = made
    assert not table.IsCollisionEnabled(group["pill"], group["can"])
    assert table.IsCollisionEnabled(group["pill"], group["floor"])
    assert table.IsCollisionEnabled(group["can"], group["ball"])


# --- engines ---


def assert_rests(there: np.ndarray, ours: np.ndarray, name: str) -> None:
    # In the bowl a ball rolls to and fro on facets: 1.5 cm aside raises it by 0.3 mm.
    aside = 0.03 if name == "ball" else 0.01
    assert np.linalg.norm(there[:2] - ours[:2]) < aside and abs(there[2] - ours[2]) < 0.005, (name, there, ours)


def test_mujoco_rests_where_we_do(dropped):
    model, data = at_start(dropped.export("scene.xml", motion=False))
    for name in ("the ring", "cone"):
        body = model.body(name.replace(" ", "_"))
        assert body.mass[0] == pytest.approx(dropped.scene.bodies[dropped.index(name)].mass)
        axes = Rotation.from_quat(np.roll(body.iquat, -1)).as_matrix()
        found = axes @ np.diag(body.inertia) @ axes.T
        np.testing.assert_allclose(found, dropped.inertia(name), atol=1e-6 * np.abs(found).max())
    # Of the ring and the floor, whose coefficients differ.
    told = {
        tuple(sorted(model.geom(g).name.partition("-")[0] for g in pair)): friction[0]
        for pair, friction in zip(
            np.stack([model.pair_geom1, model.pair_geom2], 1).tolist(), model.pair_friction, strict=True
        )
    }
    assert told["floor", "the_ring"] == pytest.approx(0.48)
    while data.time < SECONDS:
        mujoco.mj_step(model, data)
    for name in RESTING:
        there = data.body("_1_box" if name == "1 box" else name.replace(" ", "_")).xipos
        assert_rests(there, dropped.centre(name), name)


def test_mujoco_rests_where_we_do_on_distances_too(dropped, tmp_path):
    """Without convex pieces: MuJoCo samples the mesh itself, and a ball comes to rest in the hollow of the bowl."""
    export(dropped.file, tmp_path / "scene.xml", collide="sdf", allow_outside=True)
    assert len(list(tmp_path.rglob("*.obj"))) == 3  # the ring, the cone and the bowl, uncut
    model, data = at_start(tmp_path / "scene.xml")
    assert (model.geom_type == mujoco.mjtGeom.mjGEOM_SDF).sum() == 3
    while data.time < SECONDS:
        mujoco.mj_step(model, data)
    for name in ("the ring", "cone", "ball"):
        assert_rests(data.body(name.replace(" ", "_")).xipos, dropped.centre(name), name)


def test_pybullet_rests_where_we_do(dropped):
    import pybullet as engine

    out = dropped.export("scene.urdf", motion=False)
    engine.connect(engine.DIRECT)
    try:
        engine.setGravity(*dropped.scene.gravity)
        found = {}
        rows = {row["body"]: row for row in csv.DictReader(out.with_suffix(".poses.csv").open())}
        for name in [body.name for body in dropped.scene.bodies]:
            plain = "_1_box" if name == "1 box" else name.replace(" ", "_")
            row = rows.pop(plain)
            place, turn = [float(row[c]) for c in "xyz"], [float(row[f"q{c}"]) for c in "xyzw"]
            flags = engine.URDF_USE_INERTIA_FROM_FILE
            found[name] = engine.loadURDF(str(out.with_name(f"scene.{plain}.urdf")), place, turn, flags=flags)
        for name in RESTING:
            body = dropped.scene.bodies[dropped.index(name)]
            mass, friction, diagonal, _, _, restitution, *_ = engine.getDynamicsInfo(found[name], -1)
            assert (mass, friction, restitution) == pytest.approx((body.mass, body.friction, body.restitution))
            np.testing.assert_allclose(sorted(diagonal), np.linalg.eigvalsh(dropped.inertia(name)), rtol=1e-6)
            engine.resetBaseVelocity(found[name], list(body.velocity), list(body.angular_velocity))
        for _ in range(round(240 * SECONDS)):
            engine.stepSimulation()
        for name in RESTING:
            there = np.array(engine.getBasePositionAndOrientation(found[name])[0])
            assert_rests(there, dropped.centre(name), name)
        assert not rows
    finally:
        engine.disconnect()


def test_the_csv_beside_urdf_files_places_each_of_them_also_trees_that_hang_in_the_world(tmp_path):
    """Every file is loaded where its row says, and every link is then where its body starts."""
    import pybullet as engine

    file = tmp_path / "scene.yaml"
    file.write_text("""
version: 1
shapes:
  arm: {box: {size: [0.4, 0.1, 0.1]}}
  hand: {box: {size: [0.2, 0.1, 0.1]}}
  ball: {sphere: {radius: 0.1}}
bodies:
  - {name: arm, shape: arm, position: [0.7, 0, 1], euler_xyz_deg: [0, 0, 30], mass: 1}
  - {name: hand, shape: hand, position: [1.2, 0, 1], euler_xyz_deg: [0, 0, 30], mass: 1}
  - {name: "a ball[3]", shape: ball, position: [0, 2, 3], euler_xyz_deg: [0, 40, 0], mass: 1}
joints:
  - {name: shoulder, type: hinge, bodies: [arm, world], anchor: [0.5, 0, 1], axis: [0, 0, 1]}
  - {name: wrist, type: hinge, bodies: [hand, arm], anchor: [1, 0, 1], axis: [0, 0, 1]}
""")
    export(file, out := tmp_path / "new" / "scene.urdf")
    engine.connect(engine.DIRECT)
    try:
        places = {}
        for row in csv.DictReader(out.with_suffix(".poses.csv").open()):
            place, turn = [float(row[c]) for c in "xyz"], [float(row[f"q{c}"]) for c in "xyzw"]
            body = engine.loadURDF(str(out.with_name(f"scene.{row['body']}.urdf")), place, turn)
            places[row["body"]] = engine.getBasePositionAndOrientation(body)[0]
            for joint in range(engine.getNumJoints(body)):
                places[engine.getJointInfo(body, joint)[12].decode()] = engine.getLinkState(body, joint)[0]
    finally:
        engine.disconnect()
    assert len(list(out.parent.glob("scene.*.urdf"))) == 2
    for name, there in (("arm", (0.7, 0, 1)), ("hand", (1.2, 0, 1)), ("a_ball_3", (0, 2, 3))):
        np.testing.assert_allclose(places[name], there, atol=1e-6)


def test_mujoco_starts_with_the_velocity_of_the_centre_of_mass(tmp_path):
    text = """
version: 1
bodies: [{{name: a, shape: s, velocity: [1, 2, 3], angular_velocity: [0.5, -1, 2], euler_xyz_deg: [20, 30, 40]}}]
shapes: {{s: {{asset: {shapes}/cone}}}}
"""
    (tmp_path / "scene.yaml").write_text(text.format(shapes=SHAPES))
    export(tmp_path / "scene.yaml", tmp_path / "scene.mjcf", allow_outside=True)
    model = mujoco.MjModel.from_xml_string((tmp_path / "scene.mjcf").read_text(), assets(tmp_path / "scene_assets"))
    _, data = at_start(model)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, velocity, 0)
    np.testing.assert_allclose(velocity, [0.5, -1, 2, 1, 2, 3], atol=1e-7)


def assets(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_open_surface_is_cut_as_the_solid_of_its_distance(tmp_path, monkeypatch):
    """Scenery from photos is drawn as photos show it, without a back, and collides as a closed solid."""
    solid = primitives.box()
    shape = mesh_shape(solid, name="scenery", kind="grid", resolution=33)
    drawn = replace(shape, mesh=Mesh(solid.vertices, solid.faces[2:]))
    given = []

    def cut(name: str, mesh: Mesh, warn: bool) -> dict[str, Any]:
        given.append(mesh)
        return {"vertices": mesh.vertices, "count": [len(mesh.vertices)]}

    monkeypatch.setattr("sdfsim.apps.export._cut", cut)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (piece,) = convex_pieces(drawn)
    assert is_closed(given[0])
    np.testing.assert_allclose(np.ptp(piece.vertices, axis=0), np.ptp(solid.vertices, axis=0), rtol=0.03)
    assert signed_volume(piece) == pytest.approx(signed_volume(solid), rel=0.05)


def test_a_solid_without_pieces_is_cut_once_by_coacd(tmp_path, monkeypatch, caplog):
    import coacd

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    half = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]) * 0.1
    vertices = np.concatenate([np.column_stack([half, np.full(6, z)]) for z in (0.0, 0.1)])
    flat = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)])
    sides = [((k, (k + 1) % 6, k + 6), ((k + 1) % 6, (k + 1) % 6 + 6, k + 6)) for k in range(6)]
    mesh = Mesh(vertices, np.concatenate([flat[:, ::-1], flat + 6, np.reshape(sides, (-1, 3))]))
    shape = mesh_shape(mesh, name="angle", kind="mesh")
    shape.save(tmp_path / "angle")
    report = export(tmp_path / "angle", tmp_path / "angle.xml")
    assert len(report["files"]) >= 4  # the scene, the mesh and two pieces at least
    told = "cutting the shape angle into convex pieces"
    assert caplog.text.count(told) == 1  # it takes long, and nobody sees a bar
    caplog.clear()
    stages = []
    export(tmp_path / "angle", tmp_path / "angle.urdf", on_progress=lambda stage, *_: stages.append(stage))
    assert told not in caplog.text and "convex pieces" in stages
    # The same mesh under another name is not cut again; another mesh is.
    monkeypatch.setattr(coacd, "run_coacd", lambda *args, **keys: pytest.fail("cut again"))
    replace(shape, name="bracket").save(tmp_path / "bracket")
    export(tmp_path / "bracket", tmp_path / "bracket.xml")
    pieces = [assets(tmp_path / f"{name}_assets") for name in ("angle", "bracket")]
    assert list(pieces[0].values()) == list(pieces[1].values())
    larger = mesh_shape(replace(mesh, vertices=1.1 * mesh.vertices), name="larger", kind="mesh")
    larger.save(tmp_path / "larger")
    with pytest.raises(pytest.fail.Exception, match="cut again"):
        export(tmp_path / "larger", tmp_path / "larger.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "angle.xml"))
    assert model.body("angle").mass[0] == pytest.approx(1000 * 0.003)
    corners = model.mesh_vert.reshape(-1, 3)
    assert np.isfinite(corners).all() and model.ngeom == len(report["files"]) - 1


# --- poses ---


def test_identify_reads_the_poses_of_a_run(dropped):
    (found,), scene = load_recordings([dropped.export("run.csv")], dropped.file, allow_outside=True)
    rows = [dropped.index(body.name) for body in scene.bodies if body.motion == "dynamic"]
    np.testing.assert_allclose(found.goal[0], dropped.rollout.position[:, rows], atol=1e-9)
    assert np.abs((found.goal[1] * dropped.rollout.orientation[:, rows]).sum(-1)).min() > 1 - 1e-9


# --- the command, and what goes wrong ---


def test_the_command_reports_what_it_wrote_and_what_it_left_out(dropped, tmp_path):
    done = run("export", dropped.folder, "-o", tmp_path / "new" / "run.urdf", "--allow-outside", "--json")
    assert done.exit_code == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["format"] == "urdf" and report["bodies"] == 10
    assert {Path(file) for file in report["files"]} >= {
        tmp_path / "new" / "run.poses.csv",
        tmp_path / "new" / "run.ball.urdf",
    }
    assert any("the motion" in line for line in report["left_out"])
    assert not list(tmp_path.rglob("*.part"))


# --- shapes far from their origin, small ones, and names ---

FAR = np.array([512345.27, 5401234.61, 331.0])  # no sums of a few powers of two


@pytest.fixture
def survey(tmp_path: Path) -> Path:
    """A scene with an L of 8 x 8 x 3 m in the coordinates of a map, twice: one turned by 90 degrees about the vertical,
    and moved back to where it was."""
    outline = np.array([(0, 0), (8, 0), (8, 3), (3, 3), (3, 8), (0, 8)])
    vertices = np.concatenate([np.column_stack([outline, np.full(6, z)]) for z in (0.0, 3.0)]) + FAR
    flat = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)])
    sides = [((k, (k + 1) % 6, k + 6), ((k + 1) % 6, (k + 1) % 6 + 6, k + 6)) for k in range(6)]
    mesh = Mesh(vertices, np.concatenate([flat[:, ::-1], flat + 6, np.reshape(sides, (-1, 3))]))
    (tmp_path / "house.ply").write_bytes(write_ply(mesh))
    back = FAR - Rotation.from_euler("z", 90, degrees=True).apply(FAR) + [20.0, 0.0, 0.0]
    scene = SceneBuilder().add("ground", plane={"offset": 330.5})
    house = str(tmp_path / "house.ply")
    scene.add("house", mesh=house, sdf="mesh", mass=1000)
    scene.add("turned", mesh=house, sdf="mesh", mass=1000, position=back, euler_xyz_deg=(0, 0, 90))
    return scene.save(tmp_path / "survey.yaml")


# Boxes [2, 3] of the two houses relative to FAR, by hand.
HOUSES = {"house": [[0, 0, 0], [8, 8, 3]], "turned": [[12, 0, 0], [20, 8, 3]]}


def test_a_glb_keeps_the_form_of_what_is_far_from_its_origin(survey: Path) -> None:
    report = export(survey, survey.with_suffix(".glb"))
    assert any("far from its origin" in note and "512349.27 5401238.61 332.5" in note for note in report["notes"])
    found: dict[str, Any] = {}
    scene = trimesh.load_scene(survey.with_suffix(".glb"), process=False)
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        places = trimesh.transform_points(scene.geometry[name].vertices, matrix)
        found[node] = np.stack([places[:, 0], -places[:, 2], places[:, 1]], axis=1) - FAR
    for name, box in HOUSES.items():
        np.testing.assert_allclose([found[name].min(0), found[name].max(0)], box, atol=1e-4)
    ground = found["ground"]  # without end, but drawn below the houses
    assert ground[:, 0].min() < 0 and ground[:, 0].max() > 20 and np.allclose(ground[:, 2], -0.5)


def test_mujoco_loads_what_is_far_from_its_origin(survey: Path) -> None:
    export(survey, survey.with_suffix(".xml"))
    model, data = at_start(survey.with_suffix(".xml"))
    mujoco.mj_step(model, data, 1000)
    # Each has fallen by the half metre, and lies there. The centre of the L, by hand: 24 m^2 at (4, 1.5), 15 at
    # (1.5, 5.5).
    com = np.array([(24 * 4 + 15 * 1.5) / 39, (24 * 1.5 + 15 * 5.5) / 39, 1.0])
    for name, place in (("house", com), ("turned", np.array([20 - com[1], com[0], 1.0]))):
        np.testing.assert_allclose(data.body(name).xipos - FAR, place, atol=0.02)


def test_a_csv_has_the_poses_of_the_origins_wherever_they_are(survey: Path) -> None:
    export(survey, survey.with_suffix(".csv"))
    rows = list(csv.DictReader(survey.with_suffix(".csv").open()))
    assert [float(rows[1][axis]) for axis in "xyz"] == [0.0, 0.0, 0.0]
    export(survey, survey.with_suffix(".urdf"))
    rows = list(csv.DictReader(survey.with_suffix(".poses.csv").open()))
    np.testing.assert_allclose([float(rows[1][axis]) for axis in "xyz"], FAR + np.array([4, 4, 1.5]), atol=1e-6)


def test_names_of_any_script_are_kept_where_the_format_can(tmp_path: Path) -> None:
    analytic_shape("box", size=(0.1, 0.1, 0.1)).save(tmp_path / "box")
    mesh_shape(primitives.box((0.1, 0.1, 0.1)), name="木", kind="mesh").save(tmp_path / "木")
    scene = SceneBuilder()
    names = ["椅子", "कुर्सी", "стул", "Cafe\u0301 1", "chair"]
    for k, name in enumerate(names):
        scene.add(name, asset=tmp_path / ("木" if k == 0 else "box"), position=(k, 0, 0))
    file = scene.save(tmp_path / "scene.yaml")
    kept = ["椅子", "कुर्सी", "стул", "Café_1", "chair"]
    report = export(file, tmp_path / "out.glb")
    assert "Cafe\u0301 1 is called Café_1" in report["notes"]
    assert set(kept) <= set(trimesh.load_scene(tmp_path / "out.glb").graph.nodes)
    export(file, tmp_path / "out.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    assert all(stage.GetPrimAtPath(f"/World/{name}").IsValid() for name in kept)
    export(file, tmp_path / "out.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    assert [model.body(k).name for k in range(1, 6)] == kept
    report = export(file, tmp_path / "out.urdf")
    (line,) = (note for note in report["notes"] if "is called" in note)
    assert line.startswith("椅子 is called _, कुर्सी is called __1, стул is called __2, Cafe\u0301 1 is called Caf__1")
    assert "chair is" not in line and all((tmp_path / f"out.{name}.urdf").is_file() for name in ("_", "__1", "__2"))


@pytest.mark.parametrize("fps", [24, 29.97, 1000])
def test_motion_has_the_rate_that_was_asked_for(dropped, tmp_path, fps):
    """Whole frames of an editing program, where a run has a step of its own; the poses are those of the run."""
    export(dropped.folder, tmp_path / "run.glb", fps=fps, allow_outside=True)
    tree, binary = chunks(tmp_path / "run.glb")
    (animation,) = tree["animations"]
    time = values(tree, binary, animation["samplers"][0]["input"])[:, 0]
    end = dropped.rollout.time[-1]
    np.testing.assert_allclose(time, np.arange(len(time)) / fps, atol=1e-6)
    assert end - 1e-3 / fps <= time[-1] < end + 1 / fps
    node = next(k for k, n in enumerate(tree["nodes"]) if n["name"] == "ball")
    channel = next(c for c in animation["channels"] if c["target"] == {"node": node, "path": "translation"})
    place = values(tree, binary, animation["samplers"][channel["sampler"]]["output"])
    true = dropped.rollout.position[:, dropped.index("ball")]  # the centre of a ball is its origin
    for axis in range(3):
        np.testing.assert_allclose(place[:, axis], np.interp(time, dropped.rollout.time, true[:, axis]), atol=2e-4)


def test_a_flight_stays_a_parabola_at_another_rate_and_urdf_replaces_no_recording(tmp_path):
    import pybullet

    scene = sdfsim.Scene().add("ball", sphere={"radius": 0.1}, position=(0, 0, 3.0), velocity=(1.0, 0, 2.0))
    scene.frame("tip", "ball", position=(0, 0, 0.1))
    scene.save(tmp_path / "toss.yaml")
    report = simulate(tmp_path / "toss.yaml", tmp_path / "run", seconds=0.6)
    assert report["status"] == "done"
    export(tmp_path / "run", tmp_path / "toss.csv", fps=100)
    kept = (tmp_path / "toss.csv").read_text()
    rows = [row for row in csv.DictReader(kept.splitlines()) if row["body"] == "ball"]
    for row in rows[:-1]:
        t = float(row["time"])
        assert float(row["z"]) == pytest.approx(3.0 + 2.0 * t - 0.5 * 9.81 * t**2, abs=1e-7)
    scene.add("other", sphere={"radius": 0.1}, position=(1.0, 0, 0))
    export(scene.load(), tmp_path / "toss.urdf")
    assert (tmp_path / "toss.csv").read_text() == kept and (tmp_path / "toss.poses.csv").is_file()
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(str(tmp_path / "toss.ball.urdf"), physicsClientId=client)
    weights = [pybullet.getDynamicsInfo(body, k, physicsClientId=client)[0] for k in range(-1, 1)]
    pybullet.disconnect(client)
    assert sum(weights) == pytest.approx(scene.load().bodies[0].mass, rel=1e-6)
    for ending, told in (("usda", "frames"), ("glb", "frames")):
        assert told in export(scene.load(), tmp_path / f"toss.{ending}")["left_out"]


def test_a_usd_keeps_the_form_of_what_is_far_from_its_origin(survey: Path) -> None:
    export(survey, survey.with_suffix(".usda"))
    stage = Usd.Stage.Open(str(survey.with_suffix(".usda")))
    for name, box in HOUSES.items():
        prim = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}/geometry/solid"))
        to_world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
        points = np.array(prim.GetPointsAttr().Get(), dtype=float) @ to_world[:3, :3] + to_world[3, :3] - FAR
        np.testing.assert_allclose([points.min(0), points.max(0)], box, atol=1e-4)


def test_cones_and_rings_are_meshes_for_engines(tmp_path: Path) -> None:
    """As few of them have these forms; a cone is one convex piece."""
    made = SceneBuilder().add("floor", plane={})
    made.add("cone", cone={"radius": 0.1, "height": 0.2}, position=(0, 0, 0.2), mass=1.0)
    made.add("ring", torus={"radius": 0.1, "tube": 0.03}, position=(0.5, 0, 0.2), mass=2.0)
    files = {suffix: tmp_path / f"out.{suffix}" for suffix in ("xml", "usda", "glb")}
    for file in files.values():
        export(made.save(tmp_path / "scene.yaml"), file)
    model = mujoco.MjModel.from_xml_path(str(files["xml"]))
    geoms = [model.geom(k) for k in range(model.ngeom)]
    assert sum(geom.name.startswith("cone") for geom in geoms) == 1
    assert sum(geom.name.startswith("ring") for geom in geoms) > 4
    assert model.body("cone").ipos == pytest.approx((0, 0, -0.05), abs=1e-6)
    assert model.body("ring").inertia.max() == pytest.approx(2.0 * (0.1**2 + 0.75 * 0.03**2), rel=1e-6)
    assert '"Cone"' not in files["usda"].read_text()
    assert files["glb"].stat().st_size > 10_000
