"""What an MJCF file says and a scene cannot have. MuJoCo compiles every attribute and flag of a file into a field of
its model, so all fields are compared with those of a model that says nothing: what differs is either used by `mjcf`,
or computed by the compiler, or named. A field that a newer MuJoCo adds is named too."""

from collections.abc import Iterator
from typing import Any

import numpy as np

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
# Elements that are named by their number (see `COUNTED` in `mjcf`), used as they are, or computed.
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
