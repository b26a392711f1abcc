"""From MJCF to links and joints, which `robot` turns into a scene. MuJoCo itself reads the file: its compiler handles
all defaults, frames, inertias and includes, and refuses anything that is not MJCF."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.apps.export import rebound
from sdfsim.apps.robot import UNBOUNDED, Link, LinkJoint, Pose, Robot, named
from sdfsim.base.errors import SdfsimError, nearest
from sdfsim.base.lazy import optional
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.primitives import sphere
from sdfsim.scene.joints import joint_axes
from sdfsim.shape.parts import Part, moved, pose_of

START = "start"  # the keyframe that our own exports have
SOFTEST = 1.99  # damping ratio from which contacts count as not rebounding
USUAL = (0.02, 1.0)  # MuJoCo's default time and damping ratio of contacts
ALIKE = 1e-3  # smallest difference of two coefficients of friction that is told
NEAR = 1e-4  # m, or relative to a length: how far ends of a loop may be apart
# Contents of a model that a scene cannot have: the field that counts them, and their name.
COUNTED = {
    "nsensor": "sensors",
    "ncam": "cameras",
    "nlight": "lights",
    "nflex": "deformable bodies (flex)",
    "nskin": "skins",
    "nplugin": "plugins",
    "npair": "contact pairs with coefficients of their own: those of the two bodies are used",
    "ntex": "textures: colours replace them",
    "nnumeric": "custom numbers",
    "ntext": "custom texts",
    "ntuple": "custom tuples",
}


# What a file says and a scene cannot have is named. MuJoCo compiles every attribute and flag of a file into a field of
# its model, so all fields are compared with those of a model that says nothing: what differs is either used here, or
# computed by the compiler, or named. A field that a newer MuJoCo adds is named too.

# Every element of which a model has rows, with nothing said about it.
PLAIN = """<mujoco><asset><material name="m"/></asset><worldbody>
<body><joint name="j"/><geom size="1" material="m"/><site name="a"/></body>
<body><freejoint/><geom size="1"/><site name="b"/></body></worldbody>
<tendon><spatial><site site="a"/><site site="b"/></spatial></tendon>
<equality><joint joint1="j"/></equality><actuator><motor joint="j"/></actuator></mujoco>"""
# Flags that are done: the fields that each sets to zero.
LIMIT, EQUALITY = ("jnt_limited", "tendon_limited"), ("eq_active0",)
LOSS = ("dof_frictionloss", "tendon_frictionloss")
SPRING = ("jnt_stiffness", "jnt_stiffnesspoly", "tendon_stiffness", "tendon_stiffnesspoly")
DAMPER = ("dof_damping", "dof_dampingpoly", "tendon_damping", "tendon_dampingpoly")
SWITCHED: dict[str, tuple[str, ...]] = {
    "constraint": (*LIMIT, *EQUALITY, *LOSS), "limit": LIMIT, "equality": EQUALITY, "frictionloss": LOSS,
    "spring": SPRING, "damper": DAMPER, "passive": (*SPRING, *DAMPER, "body_gravcomp"), "gravity": ("body_gravcomp",),
    "contact": (), "actuation": (),
}  # fmt: skip
# Fields, by the element before their first underscore. Those of `USED` are read elsewhere in the import, or have a line
# of their own there; those of `MADE` are computed by the compiler, or only drawn.
USED = {
    "body": "gravcomp inertia ipos iquat mass mocapid parentid pos quat",
    "jnt": "actfrclimited actfrcrange axis bodyid limited pos range stiffness stiffnesspoly type",
    "dof": "armature damping dampingpoly frictionloss",
    "geom": "bodyid conaffinity condim contype dataid friction matid pos quat rgba size solref type",
    "eq": "active0 data obj1id obj2id objtype type",
    "tendon": "damping lengthspring limited num range stiffness",
    "actuator": "biasprm biastype ctrllimited ctrlrange dynprm dyntype forcelimited forcerange gainprm gaintype gear "
    "trnid trntype",
    "mat": "rgba texid",
}
MADE = {
    "body": "bvhadr bvhnum conaffinity contype dofadr dofnum geomadr geomnum invweight0 jntadr jntnum margin plugin "
    "rootid sameframe simple subtreemass treeid weldid",
    "jnt": "actuatorid dofadr group plasticadr qposadr",
    "dof": "M0 Madr bodyid invweight0 jntid length parentid simplenum treeid",
    "geom": "aabb castshadow group plugin rbound sameframe",
    "tendon": "actuatorid adr group invweight0 length0 matid plasticadr rgba treeid treenum type width",
    "actuator": "acc0 actadr actnum ctrladr ctrlnum ctrlspec group history historyadr length0 lengthrange outadr "
    "outnum plugin",
    "mat": "texrepeat texuniform",
}
# Elements that are named by their number (see `COUNTED`), used as they are, or computed.
WHOLE = set(
    "B D M bvh cam efm0 efmC exclude flex flexedge hfield key light mapD2M mapM2D mapM2M mesh name names numeric oct "
    "pair paths plugin qpos0 qpos sensor site skin ten tex text tree tuple wrap flg signature".split()
)
OF_OPTION = "density disableflags enableflags gravity magnetic o_friction o_margin o_solimp o_solref viscosity wind"
# What the lines call fields; any other is called by its own name.
_LIMITS = "margin and softness of limits: they are rigid here"
_SOFT = "softness of equalities and tendons: they are rigid here"
_MIXED = "priority and solmix of geoms: the product of two bodies' coefficients counts here"
_BAND = "margin and gap of geoms: bodies touch at their surface here"
_SHINE = "shine of materials"
LINES = {
    "geom_margin": _BAND, "geom_gap": _BAND, "geom_priority": _MIXED, "geom_solmix": _MIXED,
    "geom_solimp": "solimp of geoms: contacts are rigid here", "geom_fluid": "fluidshape of geoms",
    "jnt_margin": _LIMITS, "jnt_solref": _LIMITS, "jnt_solimp": _LIMITS,
    "dof_solref": "softness of joint friction", "dof_solimp": "softness of joint friction",
    "eq_solref": _SOFT, "eq_solimp": _SOFT, "tendon_solref_lim": _SOFT, "tendon_solimp_lim": _SOFT,
    "tendon_frictionloss": "friction of tendons", "tendon_armature": "armature of tendons",
    **{f"mat_{key}": _SHINE for key in ("emission", "metallic", "reflectance", "roughness", "shininess", "specular")},
}  # fmt: skip


def read_mjcf(path: Path, *, key: str | None = None) -> Robot:
    """The bodies and joints of an MJCF file, in the keyframe `key`, or else in one called start, or in the file's
    initial pose. Raises SdfsimError if MuJoCo is not installed or refuses the file, if there is no such keyframe, or
    for geometry that a body cannot have."""
    mujoco = optional("mujoco", "mujoco", "export")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, RuntimeError) as error:
        message = "; ".join(part.strip() for part in str(error).splitlines() if part.strip())
        line = re.search(r"\bline (\d+)", message)
        where = f"{path}:{line[1]}" if line else str(path)
        hint = "a URDF needs the ending .urdf" if "<robot" in path.read_text(encoding="utf-8", errors="replace") else ""
        raise SdfsimError(f"{where}: MuJoCo refuses it ({message})", hint) from error
    return _Reader(path, mujoco, model, key).robot()


class _Reader:
    def __init__(self, path: Path, mujoco: Any, model: Any, key: str | None) -> None:
        self.mj, self.path, self.model, self.data = mujoco, path, model, mujoco.MjData(model)
        self.left: list[str] = []
        self.notes: list[str] = []
        self.keyed: dict[str, list[float]] = {}  # targets of motors in the keyframes
        self._switched_off()
        keys = [model.key(k).name or f"key {k}" for k in range(model.nkey)]
        if key is not None and key not in keys:
            there = ", ".join(keys) or "none"
            raise SdfsimError(f"{path}: no keyframe is called {key!r}{nearest(key, keys)}", f"there are {there}")
        mujoco.mj_resetData(model, self.data)
        chosen = key if key is not None else START if START in keys else None
        if chosen is not None:
            mujoco.mj_resetDataKeyframe(model, self.data, keys.index(chosen))
        self.keys = keys
        self._within_limits()
        mujoco.mj_forward(model, self.data)

    def _switched_off(self) -> None:
        """Do what the file's flags say: what is switched off becomes zero in the model."""
        model, said = self.model, flags(self.mj, self.model)
        done = [flag for flag in said if flag.endswith("disable") and flag.split()[0] in SWITCHED]
        self.off = {flag.split()[0] for flag in done}
        for name in (name for flag in self.off for name in SWITCHED[flag]):
            if hasattr(model, name):  # older versions lack some
                getattr(model, name)[:] = 0
        if "gravity" in self.off:
            model.opt.gravity[:] = 0.0
        self.notes += named("the file switches off", [flag.split()[0] for flag in done])
        self.left += named("flags of MuJoCo", [flag for flag in said if flag not in done])

    def _within_limits(self) -> None:
        model, types = self.model, self.mj.mjtJoint
        for j in range(model.njnt):
            if model.jnt_limited[j] and types(int(model.jnt_type[j])) in (types.mjJNT_HINGE, types.mjJNT_SLIDE):
                at = model.jnt_qposadr[j]
                within = float(np.clip(self.data.qpos[at], *model.jnt_range[j]))
                if within != self.data.qpos[at]:
                    self.notes.append(f"joint {self._joint_name(j)} starts at {within:.6g}, the nearest of its limits")
                    self.data.qpos[at] = within

    def robot(self) -> Robot:
        model = self.model
        for counter, what in COUNTED.items():
            if count := int(getattr(model, counter, 0)):
                self.left.append(f"{what} ({count})")
        roots = [b for b in range(1, model.nbody) if model.body_weldid[b] == 0 and model.body_mocapid[b] < 0]
        held = [b for b in roots if any(p == b and model.body_weldid[c] for c, p in enumerate(model.body_parentid))]
        message = "bodies without a joint to the world stand still, and hold others (<freejoint/> lets them go)"
        self.notes += named(message, [self._body_name(b) for b in held])
        if model.opt.density or model.opt.viscosity or np.any(model.opt.wind):
            self.left.append("air: density, viscosity and wind")
        self.left += named("gravcomp of bodies", self._names(model.body, np.flatnonzero(model.body_gravcomp)))
        links: list[Link] = []
        geoms: list[list[int]] = []  # geoms with which each link touches others
        self.link: list[int] = []  # the first link of every body; -1 for the world, and if there is none
        for b in range(model.nbody):
            made = self._links(b)
            self.link.append(len(links) if b and made else -1)
            links += [link for link, _ in made]
            geoms += [own for _, own in made]
        joints = [joint for b in range(1, model.nbody) for joint in self._joints(b)]
        couplings = tuple(self._couplings())
        motors = {} if "actuation" in self.off else self._motors(couplings)
        joints = [replace(joint, motor=motors.get(joint.name)) for joint in joints]
        free = model.jnt_type[model.dof_jntid] == int(self.mj.mjtJoint.mjJNT_FREE)
        rotors = sorted({int(model.dof_jntid[dof]) for dof in np.flatnonzero(free & (model.dof_armature > 0.0))})
        self.left += named("armature of free joints", list(map(self._joint_name, rotors)))
        joints += [*self._loops(), *self._ropes()]
        apart = self._apart(geoms)
        meets = self.off.isdisjoint(("contact", "constraint"))
        self._left_out([g for own in geoms for g in own] if meets else [])
        links = self._slippery(links, geoms, apart) if meets else links
        ends = model.wrap_objid[model.wrap_type == int(self.mj.mjtWrap.mjWRAP_SITE)]  # those of tendons are no frames
        frames = [self._frame(s) for s in range(model.nsite) if s not in ends and model.site(s).name]
        return Robot(
            self.path.stem, tuple(links), tuple(joints), np.array(model.opt.gravity), apart, tuple(self.left),
            tuple(self.notes), contact=meets, frames=tuple(frames), keyframes=self._keyframes(), couplings=couplings,
        )  # fmt: skip

    def _frame(self, s: int) -> tuple[str, int, np.ndarray]:
        """A site, in its link, or in the world."""
        model, data = self.model, self.data
        name, k = model.site(s).name, self.link[model.site_bodyid[s]]
        if k < 0 or model.body_weldid[model.site_bodyid[s]] == 0:
            return name, -1, pose_of(data.site_xpos[s], Rotation.from_matrix(data.site_xmat[s].reshape(3, 3)))
        return name, k, pose_of(model.site_pos[s], Rotation.from_quat(np.roll(model.site_quat[s], -1)))

    def _keyframes(self) -> dict[str, Pose]:
        """The keyframes of the file: joints within their limits."""
        model, mj, found, start = self.model, self.mj, {}, self.data
        types = mj.mjtJoint
        for number, key in enumerate(self.keys):
            data = mj.MjData(model)
            mj.mj_resetDataKeyframe(model, data, number)
            mj.mj_forward(model, data)
            joints: dict[str, Any] = {}
            speeds: dict[str, Any] = {}
            links: dict[int, tuple[np.ndarray, ...]] = {}
            for j in range(model.njnt):
                kind, at, b = types(int(model.jnt_type[j])), model.jnt_qposadr[j], int(model.jnt_bodyid[j])
                name, moves = self._joint_name(j), data.qvel[model.jnt_dofadr[j] :]
                turns = Rotation.from_matrix(np.stack([d.xmat[b].reshape(3, 3) for d in (start, data)]))
                if kind == types.mjJNT_FREE:
                    fast = np.zeros(6)
                    mj.mj_objectVelocity(model, data, mj.mjtObj.mjOBJ_BODY, b, fast, 0)
                    links[self.link[b]] = pose_of(data.xpos[b], turns[1]), fast[3:], fast[:3]
                elif kind == types.mjJNT_BALL:
                    parent = model.body_parentid[b]
                    there = Rotation.from_matrix(np.stack([d.xmat[parent].reshape(3, 3) for d in (start, data)]))
                    turn = there[0] * there[1].inv() * turns[1] * turns[0].inv()
                    axes = joint_axes(turns[0].as_matrix()[:, 0] if model.jnt_limited[j] else None)
                    joints[name] = (axes.inv() * turn * axes).as_quat()
                    spin = turns[1].apply(moves[:3])
                    speeds |= {name: (there[1] * there[0].inv() * axes).inv().apply(spin)} if np.any(spin) else {}
                else:
                    value, ends = float(data.qpos[at]), model.jnt_range[j]
                    joints[name] = float(np.clip(value, *ends)) if model.jnt_limited[j] else value
                    speeds |= {name: float(moves[0])} if moves[0] else {}
            # A keyframe that says nothing of controls has zeros; motors then aim at its positions.
            goals = self.keyed.items() if np.any(model.key_ctrl[number]) else ()
            found[key] = Pose(joints, links, speeds, {name: keyed[number] for name, keyed in goals})
        return found

    def _couplings(self) -> Iterator[tuple[str, str, float, float]]:
        """Equalities of two joints, and of fixed tendons between two, that are linear."""
        model, mj = self.model, self.mj
        for k in range(model.neq):
            kind = mj.mjtEq(int(model.eq_type[k]))
            first, second, data = int(model.eq_obj1id[k]), int(model.eq_obj2id[k]), model.eq_data[k]
            if not self._couples(k):
                continue
            if kind == mj.mjtEq.mjEQ_JOINT:
                ref = [float(model.qpos0[model.jnt_qposadr[j]]) for j in (first, second)]
                yield (
                    self._joint_name(first), self._joint_name(second), float(data[1]),
                    float(data[0] + ref[0] - data[1] * ref[1]),
                )  # fmt: skip
            else:
                at = model.tendon_adr[first]
                one, other = (int(j) for j in model.wrap_objid[at : at + 2])
                gear, arm = (float(value) for value in model.wrap_prm[at : at + 2])
                offset = float(model.tendon_length0[first] + data[0]) / gear
                yield self._joint_name(one), self._joint_name(other), -arm / gear, offset

    def _couples(self, k: int) -> bool:
        """Whether equality `k` is a linear relation between two hinges or slides."""
        model, mj = self.model, self.mj
        kind, ends = mj.mjtEq(int(model.eq_type[k])), [int(model.eq_obj1id[k]), int(model.eq_obj2id[k])]
        if not self.data.eq_active[k] or (kind == mj.mjtEq.mjEQ_JOINT and np.any(model.eq_data[k, 2:5])):
            return False
        if kind == mj.mjtEq.mjEQ_TENDON and ends[1] < 0:
            at, count = int(model.tendon_adr[ends[0]]), int(model.tendon_num[ends[0]])
            wraps = range(at, at + count)
            if count != 2 or any(model.wrap_type[w] != int(mj.mjtWrap.mjWRAP_JOINT) for w in wraps):
                return False
            ends = [int(model.wrap_objid[w]) for w in wraps]
        elif kind != mj.mjtEq.mjEQ_JOINT or ends[1] < 0:
            return False
        return all(model.jnt_type[j] in (int(mj.mjtJoint.mjJNT_HINGE), int(mj.mjtJoint.mjJNT_SLIDE)) for j in ends)

    def _left_out(self, solid: list[int]) -> None:
        """Name every field of the model that says something and is not used. Geoms count that touch others: `solid`."""
        model, mj = self.model, self.mj
        plain = mj.MjModel.from_xml_string(PLAIN)
        self.left += named("options of MuJoCo's step", settings(model, plain))
        if str(model.vis) != str(plain.vis):
            self.left.append("settings of MuJoCo's viewer")
        free = [j for j in range(model.njnt) if model.jnt_type[j] == mj.mjtJoint.mjJNT_FREE]
        drag = ("dof_damping", "dof_dampingpoly", "dof_frictionloss")
        held = [
            j for j in free if model.jnt_stiffness[j]
            or any(np.any(getattr(model, name, np.zeros(model.nv))[model.jnt_dofadr[j] :][:6]) for name in drag)
        ]  # fmt: skip
        self.left += named("damping, stiffness and friction of free joints", list(map(self._joint_name, held)))
        rolls = [g for g in solid if model.geom_condim[g] > 3]
        self.left += named("friction against spinning and rolling", self._names(model.geom, rolls))
        found: dict[str, dict[str, None]] = {}
        for element, line, rows in unused(model, plain):
            rows = [int(k) for k in rows if element != "geom" or k in solid]
            if element in ("jnt", "dof"):
                joints = rows if element == "jnt" else [int(model.dof_jntid[k]) for k in rows]
                names = list(map(self._joint_name, joints))
            else:
                known = getattr(model, {"eq": "eq", "mat": "material"}.get(element, element), None)
                names = self._names(known, rows) if callable(known) else [f"number {k}" for k in rows]
            if names or not element:
                found.setdefault(line, {}).update(dict.fromkeys(names))
        for line, names in found.items():
            self.left += named(line, list(names)) or [line]

    def _slippery(self, links: list[Link], geoms: list[list[int]], apart: frozenset[tuple[int, int]]) -> list[Link]:
        """The links, without friction if none of their contacts in MuJoCo has any (condim 1). A note says where the
        product of two bodies' friction is not what MuJoCo takes: the larger one, or that of the geom with the higher
        priority."""
        model, met = self.model, [g for own in geoms for g in own]
        owner = np.array([k for k, own in enumerate(geoms) for _ in own], np.int64)
        weld = model.body_weldid[model.geom_bodyid[met]]
        above = model.body_weldid[model.body_parentid[weld]]
        order, dims, slides = model.geom_priority[met], model.geom_condim[met], model.geom_friction[met, 0]

        def mixed(values: np.ndarray) -> np.ndarray:
            one, other = np.broadcast_arrays(values[:, None], values)
            first, second = np.broadcast_arrays(order[:, None], order)
            return np.where(first > second, one, np.where(first < second, other, np.maximum(one, other)))

        # [G, G] the friction of each pair of geoms, and whether they touch.
        friction = np.where(mixed(dims) == 1, 0.0, mixed(slides))
        denied = np.eye(len(links), dtype=bool)
        for a, b in apart:
            denied[a, b] = denied[b, a] = True
        child = (weld[:, None] == above) & (above != 0)  # a body and its parent do not touch, unless it is the world
        meet = ~(denied[owner[:, None], owner] | (weld[:, None] == weld) | child | child.T)
        rough = {int(k) for k in owner[(meet & (friction > 0.0)).any(1)]}
        smooth = {int(k) for k in owner[meet.any(1)]} - rough
        links = [replace(link, friction=0.0) if k in smooth else link for k, link in enumerate(links)]
        has = np.array([link.friction for link in links])[owner]
        off = meet & (np.abs(has[:, None] * has - friction) > ALIKE)
        if pairs := {tuple(sorted(pair)) for pair in owner[np.argwhere(off)].tolist()}:
            self.notes.append(f"friction of {len(pairs)} pairs of bodies is the product of theirs, unlike MuJoCo's")
        return links

    def _names(self, of: Any, which: Any) -> list[str]:
        return [of(int(k)).name or f"number {k}" for k in which]

    def _body_name(self, b: int) -> str:
        return self.model.body(b).name or f"body_{b}"

    def _joint_name(self, j: int) -> str:
        joint = self.model.joint(j)
        if joint.name:
            return joint.name
        first = self.model.body_jntadr[self.model.jnt_bodyid[j]]
        return f"{self._body_name(int(self.model.jnt_bodyid[j]))}_joint" + (f"_{j - first}" if j > first else "")

    # --- bodies ---

    def _links(self, b: int) -> list[tuple[Link, list[int]]]:
        """One link for a body that moves, or one for each geometry of a body that does not."""
        model, data = self.model, self.data
        pose = pose_of(data.xpos[b], Rotation.from_matrix(data.xmat[b].reshape(3, 3)))
        first = model.body_geomadr[b]
        geoms = [g for g in range(first, first + model.body_geomnum[b]) if first >= 0]
        solid = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
        if model.body_weldid[b] == 0:
            if b and model.body_mocapid[b] >= 0:
                self.left.append(f"body {self._body_name(b)} is a mocap body: it stands still")
            return self._still(b, pose, geoms, solid)
        parts = {g: part for g in geoms if (part := self._part(g)) is not None}
        turn = Rotation.from_quat(np.roll(model.body_iquat[b], -1)).as_matrix()
        speed = np.zeros(6)
        self.mj.mj_objectVelocity(model, data, self.mj.mjtObj.mjOBJ_BODY, b, speed, 0)
        link = Link(
            self._body_name(b), pose, tuple(parts[g] for g in solid if g in parts),
            tuple(parts[g] for g in geoms if g in parts and g not in solid), float(model.body_mass[b]),
            np.array(model.body_ipos[b]), turn @ np.diag(model.body_inertia[b]) @ turn.T, velocity=speed[3:],
            spin=speed[:3], where=f"{self.path}: body {self._body_name(b)}", **self._surface(solid, self._body_name(b)),
        )  # fmt: skip
        if link.solid and any(part.kind == "plane" for part in link.shown):
            link = replace(link, shown=tuple(part for part in link.shown if part.kind != "plane"))
        return [(link, solid)]

    def _still(self, b: int, pose: np.ndarray, geoms: list[int], solid: list[int]) -> list[tuple[Link, list[int]]]:
        names, found, name = [], [], self._body_name(b)
        bodies = {self._body_name(k) for k in range(self.model.nbody)}
        for g in geoms:
            part = self._part(g)
            if part is None:
                continue
            called = name if b and len(geoms) == 1 else self.model.geom(g).name or f"{name}_{g}"
            while called in names or (called != name and called in bodies):
                called += "_"
            names.append(called)
            kind: Any = {"solid" if g in solid else "shown": (part,)}
            where = f"{self.path}: geom {called}"
            link = Link(called, pose, still=True, where=where, **kind, **self._surface([g], called))
            found.append((link, [g] if g in solid else []))
        return found

    def _surface(self, geoms: list[int], name: str) -> dict[str, Any]:
        """Coefficients such that the product of two equal ones is MuJoCo's."""
        if not geoms:
            return {}
        frictions = {float(self.model.geom_friction[g, 0]) for g in geoms}
        if len(frictions) > 1:
            values = ", ".join(f"{value:g}" for value in sorted(frictions))
            self.notes.append(f"body {name}: its geoms have different friction ({values}): the largest is used")
        friction = float(np.sqrt(max(frictions)))
        return {"friction": friction, "restitution": max(_restitution(self.model.geom_solref[g]) for g in geoms)}

    def _part(self, g: int) -> Part | None:
        model, types = self.model, self.mj.mjtGeom
        size, kind, mesh = model.geom_size[g], types(int(model.geom_type[g])), None
        where = f"{self.path}: geom {model.geom(g).name or g}"
        pose = pose_of(model.geom_pos[g], Rotation.from_quat(np.roll(model.geom_quat[g], -1)))
        material = model.geom_matid[g]
        rgba = model.geom_rgba[g] if material < 0 else model.mat_rgba[material]
        plain = material < 0 and np.allclose(rgba, 0.5 + 0.5 * (np.arange(4) == 3))  # MuJoCo's own default
        color: Any = None if plain else tuple(round(255 * float(c)) for c in np.clip(rgba[:3], 0.0, 1.0))
        sizes: dict[str, Any] = {}
        if kind == types.mjGEOM_PLANE:
            return Part("plane", pose, where=where, color=color)
        if kind == types.mjGEOM_BOX:
            sizes = {"size": 2.0 * size}
        elif kind == types.mjGEOM_SPHERE:
            sizes = {"radius": float(size[0])}
        elif kind in (types.mjGEOM_CAPSULE, types.mjGEOM_CYLINDER):
            caps = 2.0 * size[0] if kind == types.mjGEOM_CAPSULE else 0.0
            sizes = {"radius": float(size[0]), "height": float(2.0 * size[1] + caps)}
        elif kind == types.mjGEOM_ELLIPSOID:
            mesh = moved(sphere(1.0), np.diag([*size, 1.0]))
        elif kind == types.mjGEOM_MESH:
            k = model.geom_dataid[g]
            corners = slice(model.mesh_vertadr[k], model.mesh_vertadr[k] + model.mesh_vertnum[k])
            faces = slice(model.mesh_faceadr[k], model.mesh_faceadr[k] + model.mesh_facenum[k])
            mesh = Mesh(model.mesh_vert[corners].astype(np.float64), model.mesh_face[faces].astype(np.int64))
        else:
            self.left.append(f"{where}: a {kind.name.removeprefix('mjGEOM_').lower()} is not supported as a shape")
            return None
        name: Any = "mesh" if mesh is not None else kind.name.removeprefix("mjGEOM_").lower()
        return Part(name, pose, sizes, mesh, where, color)

    def _apart(self, geoms: list[list[int]]) -> frozenset[tuple[int, int]]:
        """Pairs of links that bit masks or <exclude> keep apart, without those that joints connect."""
        model = self.model
        has, takes = (
            [[int(bits[g]) for g in own] for own in geoms] for bits in (model.geom_contype, model.geom_conaffinity)
        )
        barred = {tuple(sorted(divmod(int(pair), 1 << 16))) for pair in model.exclude_signature}
        body = [int(model.geom_bodyid[own[0]]) if own else -1 for own in geoms]
        found = set()
        for a in range(len(geoms)):
            for b in range(a + 1, len(geoms)):
                meet = any(
                    (c1 & a2) or (c2 & a1)
                    for c1, a1 in zip(has[a], takes[a], strict=True)
                    for c2, a2 in zip(has[b], takes[b], strict=True)
                )
                if not meet or tuple(sorted((body[a], body[b]))) in barred:
                    found.add((a, b))
        return frozenset(found)

    # --- joints ---

    def _joints(self, b: int) -> list[LinkJoint]:
        model, data, types = self.model, self.data, self.mj.mjtJoint
        child, parent = self.link[b], self.link[model.body_parentid[b]]
        if model.body_weldid[b] == 0:
            return []
        first, count = model.body_jntadr[b], model.body_jntnum[b]
        if not count:
            return [LinkJoint(f"{self._body_name(b)}_weld", "fixed", child, parent, data.xpos[b].copy())]
        found = []
        for j in range(first, first + count):
            kind, dof, at = types(int(model.jnt_type[j])), model.jnt_dofadr[j], model.jnt_qposadr[j]
            if kind == types.mjJNT_FREE:
                return []
            name, limited = self._joint_name(j), bool(model.jnt_limited[j])
            others = {"damping": float(model.dof_damping[dof]), "friction": float(model.dof_frictionloss[dof]),
                      "armature": float(model.dof_armature[dof])}  # fmt: skip
            others = {key: value for key, value in others.items() if value}
            held = {"name": name, "child": child, "parent": parent, "anchor": data.xanchor[j].copy(), "others": others}
            if any(np.any(getattr(model, poly)[k]) for poly, k in (("dof_dampingpoly", dof), ("jnt_stiffnesspoly", j))):
                self.left.append(f"joint {name}: stiffness or damping that is not linear")
            stiff = float(model.jnt_stiffness[j])
            if kind == types.mjJNT_BALL:
                cone = (0.0, min(float(model.jnt_range[j, 1]), np.pi)) if limited else None
                if limited:
                    self.notes.append(
                        f"joint {name}: MuJoCo bounds its rotation; here the lean of its body's x axis is bounded"
                    )
                    held["axis"] = data.xmat[b].reshape(3, 3)[:, 0].copy()
                if stiff:
                    self.left.append(f"joint {name}: the stiffness of a ball")
                found.append(LinkJoint(kind="ball", **held, limits=cone))
                continue
            limits = tuple(float(end) for end in model.jnt_range[j]) if limited else None
            spring = (stiff, float(model.qpos_spring[at])) if stiff else None
            held |= {"axis": data.xaxis[j].copy(), "start": float(data.qpos[at]), "limits": limits, "spring": spring}
            found.append(LinkJoint(kind="hinge" if kind == types.mjJNT_HINGE else "slider", **held))
        return found

    def _drives(self, k: int, couplings: Sequence[tuple[str, str, float, float]]) -> tuple[int, float, float] | None:
        """The joint that actuator `k` drives, and its length as number x position + number. None for what
        is not a hinge or slide, or a fixed tendon of joints that all follow one of them by `couplings`."""
        model, mj = self.model, self.mj
        of, gear = int(model.actuator_trnid[k, 0]), float(model.actuator_gear[k, 0])
        kind = int(model.actuator_trntype[k])
        parts = [(of, 1.0)] if kind in (int(mj.mjtTrn.mjTRN_JOINT), int(mj.mjtTrn.mjTRN_JOINTINPARENT)) else []
        if kind == int(mj.mjtTrn.mjTRN_TENDON):
            at = range(int(model.tendon_adr[of]), int(model.tendon_adr[of] + model.tendon_num[of]))
            if all(model.wrap_type[w] == int(mj.mjtWrap.mjWRAP_JOINT) for w in at):
                parts = [(int(model.wrap_objid[w]), float(model.wrap_prm[w])) for w in at]
        numbers = {self._joint_name(j): j for j in range(model.njnt)}
        follows = {first: (second, ratio, offset) for first, second, ratio, offset in couplings}
        found, ratio, offset = set(), 0.0, 0.0
        for j, arm in parts:
            name = self._joint_name(j)
            for _ in follows if len(parts) > 1 else ():
                if name in follows:
                    name, by, shift = follows[name]
                    offset, arm = offset + arm * shift, arm * by
            found.add(numbers[name])
            ratio += arm
        moves = (int(mj.mjtJoint.mjJNT_HINGE), int(mj.mjtJoint.mjJNT_SLIDE))
        (joint,) = found if len(found) == 1 else (-1,)
        return (joint, gear * ratio, gear * offset) if joint >= 0 and model.jnt_type[joint] in moves else None

    def _motors(self, couplings: Sequence[tuple[str, str, float, float]]) -> dict[str, dict[str, Any]]:
        """Actuators of hinges and slides, by their joints: those that keep a speed or a position, and those that give a
        torque, which do nothing until it is set. Each with what it has in every keyframe."""
        model, mj = self.model, self.mj
        found: dict[str, dict[str, Any]] = {}
        others, freely, idle = [], [], []
        for k in range(model.nu):
            called, driven = model.actuator(k).name or f"number {k}", self._drives(k, couplings)
            joint, gear, shift = driven or (0, 0.0, 0.0)
            name = self._joint_name(joint) if driven else ""
            gain, bias = (array[k].copy() for array in (model.actuator_gainprm, model.actuator_biasprm))
            linear = int(model.actuator_gaintype[k]) == int(mj.mjtGain.mjGAIN_FIXED)
            linear &= int(model.actuator_dyntype[k]) == int(mj.mjtDyn.mjDYN_NONE)
            affine = int(model.actuator_biastype[k]) == int(mj.mjtBias.mjBIAS_AFFINE)
            alone = int(model.actuator_biastype[k]) == int(mj.mjtBias.mjBIAS_NONE)
            bias = np.zeros(3) if alone else bias
            torque = not (bias[1] or bias[2])
            plain = (affine and not (torque and bias[0])) or alone
            if not (linear and plain and gear) or name in found or bias[1] > 0 or bias[2] > 0:
                others.append(called)
                continue
            # Its force at the joint is gear x (gain x control + bias[0] + bias[1] x (gear x place + shift) + bias[2] x
            # gear x speed).
            bounds = [abs(gear) * np.abs(model.actuator_forcerange[k]).max()] * bool(model.actuator_forcelimited[k])
            bounds += [np.abs(model.jnt_actfrcrange[joint]).max()] * bool(model.jnt_actfrclimited[joint])
            reach = np.abs(model.actuator_ctrlrange[k]).max() * abs(gear * gain[0])
            bounds += [reach] * bool(torque and model.actuator_ctrllimited[k])
            most = float(min(bounds, default=0.0))
            if not most > 0.0:
                most = UNBOUNDED
                freely.append(called)
            wanted = gain[0] * np.append(self.data.ctrl[k], model.key_ctrl[:, k]) + bias[0] + bias[1] * shift
            if torque:
                found[name] = {"max_force": most}
                idle.append(called)
            elif bias[1] < 0:
                goal, *keyed = (wanted / (-bias[1] * gear)).tolist()
                if model.jnt_limited[joint] and goal != (near := float(np.clip(goal, *model.jnt_range[joint]))):
                    self.notes.append(f"actuator {called} aims at {goal:.6g}: {near:.6g} is the nearest of its limits")
                    goal = near
                stiff = float(-bias[1] * gear**2)
                found[name] = {"position": goal, "max_force": most, "gain": stiff, "time": float(bias[2] / bias[1])}
                self.keyed[name] = keyed
            else:
                speed, *self.keyed[name] = (wanted / (-bias[2] * gear)).tolist()
                found[name] = {"speed": speed, "max_force": most, "gain": float(-bias[2] * gear**2)}
        self.notes += named("motors do nothing until an effort or a target of their joint is set", idle)
        self.notes += named(f"actuators without a force limit get one of {UNBOUNDED:g}", freely)
        what = "actuators other than motor, position and velocity of a hinge, slide or a tendon that moves one"
        self.left += named(what, others)
        return found

    def _loops(self) -> list[LinkJoint]:
        """Connect and weld equalities of two bodies, which close loops."""
        model, mj = self.model, self.mj
        found, others, idle = [], [], []
        for k in range(model.neq):
            kind, name = mj.mjtEq(int(model.eq_type[k])), model.eq(k).name or f"equality_{k}"
            if not self.data.eq_active[k]:
                idle.append(name)
                continue
            if kind == mj.mjtEq.mjEQ_TENDON or self._couples(k):
                continue
            ends = [int(model.eq_obj1id[k]), max(int(model.eq_obj2id[k]), 0)]
            of_bodies = int(model.eq_objtype[k]) == int(mj.mjtObj.mjOBJ_BODY)
            both = [self.link[b] for b in ends] if of_bodies else [-1, -1]
            moves = of_bodies and any(model.body_weldid[b] != 0 for b in ends)
            known = kind in (mj.mjtEq.mjEQ_CONNECT, mj.mjtEq.mjEQ_WELD) and moves
            if not known:
                others.append(name)
                continue
            ball = kind == mj.mjtEq.mjEQ_CONNECT
            # For a weld, the second body's anchor comes first; for a connect, the first body's.
            first, second = (ends[0], ends[1]) if ball else (ends[1], ends[0])
            places = [
                self.data.xpos[b] + self.data.xmat[b].reshape(3, 3) @ model.eq_data[k, 3 * i : 3 * i + 3]
                for i, b in enumerate((first, second))
            ]
            if np.linalg.norm(places[0] - places[1]) > NEAR:
                self.notes.append(f"equality {name}: its ends are apart at the start; it keeps them at that distance")
            child, parent = both if both[0] >= 0 else both[::-1]
            found.append(LinkJoint(name, "ball" if ball else "fixed", child, parent, places[0], loop=True))
        self.left += named("equalities other than connect or weld of two bodies", others)
        self.left += named("equalities that are switched off", idle)
        return found

    def _ropes(self) -> list[LinkJoint]:
        model, mj = self.model, self.mj
        rods = {
            int(model.eq_obj1id[k])
            for k in range(model.neq)
            if int(model.eq_type[k]) == int(mj.mjtEq.mjEQ_TENDON) and model.eq_obj2id[k] < 0 and model.eq_active0[k]
        }
        coupled = {int(model.eq_obj1id[k]) for k in range(model.neq)
                   if int(model.eq_type[k]) == int(mj.mjtEq.mjEQ_TENDON) and self._couples(k)}  # fmt: skip
        driven = {int(model.actuator_trnid[k, 0]) for k in range(model.nu)
                  if int(model.actuator_trntype[k]) == int(mj.mjtTrn.mjTRN_TENDON)}  # fmt: skip
        found, others = [], []
        for k in range(model.ntendon):
            name, first = model.tendon(k).name or f"tendon_{k}", model.tendon_adr[k]
            wraps = range(first, first + model.tendon_num[k])
            sites = [int(model.wrap_objid[w]) for w in wraps if int(model.wrap_type[w]) == int(mj.mjtWrap.mjWRAP_SITE)]
            ends_of = [int(model.site_bodyid[s]) for s in sites]
            both, moves = [self.link[b] for b in ends_of], any(model.body_weldid[b] != 0 for b in ends_of)
            stiff, low = float(model.tendon_stiffness[k]), float(model.tendon_range[k, 0])
            rope = bool(model.tendon_limited[k])
            known = len(sites) == len(wraps) == 2 and moves and both[0] != both[1]
            if (k in coupled or k in driven) and not (rope or stiff or (k in driven and model.tendon_damping[k])):
                continue
            if not known or not (rope or stiff or k in rods) or (rope and low > NEAR):
                others.append(name)
                continue
            order = (0, 1) if both[0] >= 0 else (1, 0)
            ends = [self.data.site_xpos[sites[i]].copy() for i in order]
            made: dict[str, Any] = {"to": ends[1]}
            if k in rods:
                made["rod"] = float(np.linalg.norm(ends[0] - ends[1]))
            if model.tendon_damping[k] and k not in rods:
                made["damping"] = float(model.tendon_damping[k])
            found.append(
                LinkJoint(
                    name, "distance", both[order[0]], both[order[1]], ends[0], loop=True, others=made,
                    limits=(0.0, float(model.tendon_range[k, 1])) if rope and k not in rods else None,
                    spring=(stiff, float(model.tendon_lengthspring[k, 1])) if stiff and k not in rods else None,
                )
            )  # fmt: skip
        self.left += named("tendons other than a rope, rod or spring between two sites", others)
        return found


def _restitution(solref: np.ndarray) -> float:
    """Restitution of a body against one like itself, from the damping of its contacts. MuJoCo's default counts as no
    rebound."""
    time, damping = float(solref[0]), float(solref[1])
    if time <= 0.0 or damping <= 0.0 or damping >= SOFTEST or (time, damping) == USUAL:
        return 0.0
    return float(np.sqrt(rebound(np.array(damping if abs(damping - 1.0) > 1e-6 else 1.0 - 1e-6))))


# --- what a file says and a scene cannot have ---


def flags(mujoco: Any, model: Any) -> list[str]:
    """The flags that a file has set, as it writes them: `gravity disable`, `energy enable`; a bit without a name in
    this MuJoCo by its number."""
    found = []
    for bits, kind, prefix, state in (
        (int(model.opt.disableflags), mujoco.mjtDisableBit, "mjDSBL_", "disable"),
        (int(model.opt.enableflags), mujoco.mjtEnableBit, "mjENBL_", "enable"),
    ):
        names = {int(bit): name for name, bit in kind.__members__.items() if name.startswith(prefix)}
        for bit in (1 << k for k in range(bits.bit_length())):
            if bits & bit:
                found.append(f"{names.get(bit, f'bit {bit}').removeprefix(prefix).lower()} {state}")
    return found


def settings(model: Any, plain: Any) -> list[str]:
    """The options of MuJoCo's own step that are not its defaults."""
    own = [name for name in _fields(model.opt) if name not in OF_OPTION.split()]
    return [name for name in own if not _same(getattr(model.opt, name), getattr(plain.opt, name, 0.0))]


def unused(model: Any, plain: Any) -> Iterator[tuple[str, str, np.ndarray]]:
    """All fields of elements in which a model differs from a `plain` one (see `PLAIN`), and that neither the import
    uses nor the compiler computes: their element, what a line calls them, and the rows that differ."""
    for name in _fields(model):
        element, _, what = name.partition("_")
        if element in WHOLE or what in f"{USED.get(element, '')} {MADE.get(element, '')}".split():
            continue
        values, usual = getattr(model, name), getattr(plain, name, 0.0)
        if not isinstance(values, np.ndarray):
            known = name[:1] == "n" or name in ("opt", "stat", "vis") or isinstance(values, bytes)
            if not known and not _same(values, usual):
                yield "", f"{name} of MuJoCo's model", np.zeros(0, np.int64)
            continue
        usual = np.asarray(usual)
        usual = usual[0] if usual.ndim == values.ndim and len(usual) and usual.shape[1:] == values.shape[1:] else 0
        differs = ~np.isclose(values.astype(np.float64), usual)
        if len(rows := np.flatnonzero(differs.any(axis=tuple(range(1, values.ndim))))):
            yield element, LINES.get(name, f"{name} of MuJoCo's model"), rows


def _fields(of: Any) -> list[str]:
    return [name for name in dir(of) if name[0] != "_" and not callable(getattr(of, name))]


def _same(one: Any, other: Any) -> bool:
    return bool(np.all(np.isclose(one, other)))
