"""From URDF to links and joints, which `robot` turns into a scene."""

import codecs
import importlib
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from graphlib import CycleError, TopologicalSorter
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.apps.robot import UNBOUNDED, Link, LinkJoint, Robot
from sdfsim.base.errors import SdfsimError, nearest
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import MESH_SUFFIXES, Loaded, load_textured
from sdfsim.scene.scene import WORLD
from sdfsim.shape.parts import Part, moved, pose_of

MOST_BYTES = 64 * 2**20  # largest size of a file
OPTIONAL = re.compile(r"\$\((?:opt)?env +(\w+)([^()]*)\)")  # of ROS: an environment variable, or else the rest
MARKS = {
    codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
}  # fmt: skip
DECLARED = re.compile(rb"\s*<\?xml[^>]*?encoding\s*=\s*[\"']([^\"'>]*)[\"']")
KINDS = {
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "slider",
    "spherical": "ball",
    "fixed": "fixed",
    "floating": "",
    "planar": "",
}
GEOMETRIES = ("box", "sphere", "cylinder", "capsule", "mesh", "plane")
_ORIGIN = (0.0, 0.0, 0.0)
_ROOT = ("link", "joint", "material")
_OF_LINK = ("inertial", "visual", "collision", "contact")
_OF_PART = ("geometry", "origin", "material")
_OF_JOINT = ("parent", "child", "origin", "axis", "limit", "dynamics", "mimic")
_OF_CONTACT = ("lateral_friction", "restitution")


def read_urdf(path: Path, *, packages: Sequence[Path] = (), fixed: bool = False) -> Robot:
    """The robot of a URDF file at its zero pose, or as near to it as joint limits allow. With `fixed`, its root never
    moves; a root called world never does. `packages` are folders in which package:// paths are searched, besides the
    folders around the file and those of ROS_PACKAGE_PATH.

    Raises SdfsimError, with file, line and element, for anything that is not URDF, is missing, or is not a tree.
    """
    return _Reader(path, packages).robot(fixed)


def _environment(found: re.Match[str]) -> str:
    value = os.environ.get(found[1], found[2].strip())
    return value.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")


class _Reader:
    def __init__(self, path: Path, packages: Sequence[Path]) -> None:
        self.path = path
        around = [Path(folder) for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder]
        self.packages = [*packages, *path.resolve().parents, *around]
        self.line: dict[int, int] = {}
        self.left: Counter[str] = Counter()
        self.missed: list[str] = []
        self.notes: list[str] = []
        self.meshes: dict[Path, Loaded] = {}
        self.limits: dict[str, tuple[float, float] | None] = {}  # of hinges and sliders, rad or m
        self.start: dict[str, float] = {}
        for folder in packages:
            if not folder.is_dir():
                raise SdfsimError(f"{folder}: no such folder of packages", "give folders that hold the packages")
        self.root = self._parse(self._content())
        if any(element.tag.startswith("xacro:") for element in self.root.iter()):
            self.root = self._parse(self._expanded())

    def _content(self) -> str:
        try:
            if self.path.is_file() and self.path.stat().st_size > MOST_BYTES:
                raise SdfsimError(f"{self.path}: too large for a URDF (at most {MOST_BYTES // 2**20} MiB)")
            content = self.path.read_bytes()
        except OSError as error:
            raise SdfsimError(f"{self.path}: cannot be read ({error.strerror or error})") from error
        return self._decoded(content)

    def _expanded(self) -> str:
        """The file with its xacro macros expanded; from then on lines are those of the result."""
        hint = "expand them first: xacro robot.urdf.xacro > robot.urdf"
        if find_spec("xacro") is None:
            raise self.wrong(
                self.root, "holds xacro macros, and xacro is not installed", f"pip install xacro, or {hint}"
            )
        xacro = importlib.import_module("xacro")
        if find_spec("ament_index_python") is None:  # without ROS nothing else finds packages
            vars(importlib.import_module("xacro.substitution_args"))["_eval_find"] = self._package
        try:
            text = xacro.process_file(str(self.path)).toxml()
        except Exception as error:  # of many types
            why = " ".join(str(error).split()) or type(error).__name__
            raise SdfsimError(f"{self.path}: xacro cannot expand it ({why})", f"or {hint}") from error
        self.notes.append("xacro has expanded its macros: lines are those of the result")
        return text

    def _package(self, name: str) -> str:
        """The folder of a ROS package."""
        places = (*self.packages, *(folder / name for folder in self.packages))
        found = [str(place) for place in places if place.name == name and place.is_dir()]
        if not found:
            raise SdfsimError(f"no folder of a package {name}: give it with --packages")
        return found[0]

    def _parse(self, text: str) -> Element:
        # Blanks before the first element and zero bytes after the last are not valid XML, but common.
        text = text.rstrip("\0 \t\r\n")
        self.line.clear()
        skipped = text[: len(text) - len(text.lstrip())].count("\n")
        builder, parser = TreeBuilder(), expat.ParserCreate("utf-8")  # whatever the file declares

        def start(tag: str, attributes: dict[str, str]) -> None:
            self.line[id(builder.start(tag, attributes))] = parser.CurrentLineNumber + skipped

        parser.StartElementHandler, parser.CharacterDataHandler = start, builder.data
        parser.EndElementHandler = lambda tag: builder.end(tag)
        try:
            parser.Parse(OPTIONAL.sub(_environment, text.lstrip()).encode(), True)
        except expat.ExpatError as error:
            raise SdfsimError(
                f"{self.path}:{error.lineno + skipped}: not valid XML ({expat.ErrorString(error.code)})"
            ) from error
        root = builder.close()
        if root.tag != "robot":
            raise self.wrong(root, "must be <robot>", "a URDF file has one <robot>; give MJCF the ending .xml")
        return root

    def _decoded(self, content: bytes) -> str:
        """The text of the file, in the encoding that its first bytes show or that it declares, else UTF-8. As in other
        readers, a byte that this encoding does not have is replaced, with a note: most are in comments."""
        declared = DECLARED.match(content)
        name = declared[1].decode("ascii", "replace") if declared else "utf-8"
        # What can be read byte by byte is not of two or four bytes a character, whatever it says.
        name = "utf-8" if re.match(r"(?i)utf.?(16|32)|ucs", name) else name
        name = next((shown for mark, shown in MARKS.items() if content.startswith(mark)), name)
        try:
            text = content.decode(name, "replace")
        except (LookupError, UnicodeError) as error:
            hint = 'save the file in UTF-8, and declare it: <?xml version="1.0" encoding="utf-8"?>'
            raise SdfsimError(f"{self.path}:1: unknown encoding {name!r}", hint) from error
        if (at := text.find("\ufffd")) >= 0:
            line = text[:at].count("\n") + 1
            self.notes.append(f"line {line} has bytes that are not {name}: a mark replaces them, here and further on")
        return text

    def where(self, element: Element) -> str:
        return f"{self.path}:{self.line[id(element)]}: <{element.tag}>"

    def wrong(self, element: Element, fault: str, hint: str = "") -> SdfsimError:
        return SdfsimError(f"{self.where(element)} {fault}", hint)

    # --- values ---

    def text(self, element: Element, name: str) -> str:
        value = element.get(name, "").strip()
        if not value:
            raise self.wrong(element, f"needs {name}=")
        return value

    def numbers(self, element: Element, name: str, count: int, default: Sequence[float] | None = None) -> np.ndarray:
        value = element.get(name)
        if value is None or (not value.strip() and default is not None):
            if default is None:
                raise self.wrong(element, f"needs {name}=, {count} numbers")
            return np.array(default, np.float64)
        try:
            found = np.array([float(part) for part in value.split()])
        except ValueError:
            found = np.zeros(0)
        if len(found) != count or not np.isfinite(found).all() or np.abs(found).max(initial=0.0) > 1e12:
            what = "a number" if count == 1 else f"{count} numbers"
            raise self.wrong(element, f"{name} must be {what} (got {value[:40]!r})")
        return found

    def number(self, element: Element, name: str, default: float | None = None, *, least: float = -np.inf) -> float:
        value = float(self.numbers(element, name, 1, None if default is None else [default])[0])
        if value < least:
            raise self.wrong(element, f"{name} must be at least {least:g} (got {value:g})")
        return value

    def child(self, element: Element, tag: str) -> Element | None:
        """The only child with this tag."""
        found = element.findall(tag)
        if len(found) > 1:
            raise self.wrong(found[1], f"a second one in <{element.tag}>: one is allowed")
        return found[0] if found else None

    def origin(self, element: Element) -> np.ndarray:
        """[4, 4] of its <origin>."""
        found = self.child(element, "origin")
        if found is None:
            return np.eye(4)
        turn = Rotation.from_euler("xyz", self.numbers(found, "rpy", 3, _ORIGIN))
        return pose_of(self.numbers(found, "xyz", 3, _ORIGIN), turn)

    # --- the robot ---

    def robot(self, fixed: bool) -> Robot:
        self.left.update(f"<{element.tag}>" for element in self.root if element.tag not in _ROOT)
        colors = {e.get("name", ""): self._rgb(e) for e in self.root.findall("material")}
        elements = self._by_name("link", self.root.findall("link"))
        if not elements:
            raise self.wrong(self.root, "has no <link>")
        links = [self._link(name, element, colors) for name, element in elements.items()]
        number = {name: k for k, name in enumerate(elements)}
        by_child: dict[int, tuple[Element, int]] = {}
        # One without ends and type belongs to a transmission, but is written outside it.
        bare = [e for e in self.root.findall("joint") if e.find("parent") is e.find("child") is e.get("type") is None]
        given = self._by_name("joint", [e for e in self.root.findall("joint") if e not in bare])
        for name, element in given.items():
            ends = []
            for tag in ("parent", "child"):
                end = self.child(element, tag)
                if end is None:
                    raise self.wrong(element, f"{name} needs <{tag} link=>")
                link = self.text(end, "link")
                if link not in number:
                    raise self.wrong(end, f"no link is called {link!r}{nearest(link, number)}")
                ends.append(number[link])
            parent, child = ends
            if child in by_child:
                fault = f"link {links[child].name!r} is held by two joints: URDF supports trees only"
                raise self.wrong(element, fault, "close loops in MJCF (equality connect), or in scene.yaml")
            by_child[child] = element, parent
        try:
            above = {k: [by_child[k][1]] if k in by_child else [] for k in range(len(links))}
            order = list(TopologicalSorter(above).static_order())
        except CycleError as error:
            k = error.args[1][0]
            fault = f"link {links[k].name!r} holds itself: URDF supports trees only"
            raise self.wrong(by_child[k][0], fault) from error
        couplings, joints = tuple(self._mimics(given)), list[LinkJoint]()
        self._range(given, couplings)
        for k in order:
            if k in by_child:
                links[k], made = self._joint(by_child[k][0], links, k, by_child[k][1])
                joints += made
            elif fixed or links[k].name == WORLD:
                links[k] = replace(links[k], still=True)
        left = [f"{what} ({count})" for what, count in self.left.items()]
        return Robot(
            self.root.get("name", self.path.stem), tuple(links), tuple(joints),
            left_out=(*left, *self.missed), notes=tuple(self.notes), couplings=couplings,
        )  # fmt: skip

    def _mimics(self, given: dict[str, Element]) -> Iterator[tuple[str, str, float, float]]:
        for name, element in given.items():
            mimic = self.child(element, "mimic")
            if mimic is None:
                continue
            of = self.text(mimic, "joint")
            if of == name:
                raise self.wrong(mimic, f"{name} cannot follow itself")
            if of not in given:
                raise self.wrong(mimic, f"no other joint is called {of!r}{nearest(of, given)}")
            if any(KINDS.get(given[k].get("type", "")) not in ("hinge", "slider") for k in (name, of)):
                self.left["<mimic> between joints other than hinges and sliders"] += 1
                continue
            yield name, of, self.number(mimic, "multiplier", 1.0), self.number(mimic, "offset", 0.0)

    def _range(self, given: dict[str, Element], couplings: tuple[tuple[str, str, float, float], ...]) -> None:
        """Find the limits of hinges and sliders, and where they start, rad or m: at zero, or at the nearest of their
        limits; one that follows another where it then has to be."""
        follows = {name: (of, ratio, offset) for name, of, ratio, offset in couplings}

        def start(name: str, after: tuple[str, ...] = ()) -> float:
            if name in after:
                raise self.wrong(given[name], f"joints follow each other in a circle: {' -> '.join((*after, name))}")
            limits = self.limits[name]
            if name not in follows:
                return 0.0 if limits is None else min(max(0.0, limits[0]), limits[1])
            of, ratio, offset = follows[name]
            return ratio * start(of, (*after, name)) + offset

        turning = [name for name, element in given.items() if KINDS.get(element.get("type", "")) in ("hinge", "slider")]
        for name in turning:
            self.limits[name] = self._limits(given[name], name, given[name].get("type", ""))
        for name in turning:
            self.start[name] = begin = start(name)
            if begin:
                unit = "m" if given[name].get("type") == "prismatic" else "rad"
                why = "it follows another" if name in follows else "its limits leave zero out"
                self.notes.append(f"joint {name} starts at {begin:.6g} {unit}: {why}")

    def _by_name(self, what: str, elements: Sequence[Element]) -> dict[str, Element]:
        """Links or joints by their names, which differ."""
        found: dict[str, Element] = {}
        for element in elements:
            name = self.text(element, "name")
            if name in found:
                first = self.line[id(found[name])]
                raise self.wrong(element, f"two {what}s are called {name!r} (the first in line {first})")
            found[name] = element
        return found

    def _rgb(self, element: Element | None) -> tuple[int, int, int] | None:
        color = None if element is None else element.find("color")
        if color is None:
            return None
        red, green, blue = (round(255 * c) for c in np.clip(self.numbers(color, "rgba", 4)[:3], 0.0, 1.0))
        return red, green, blue

    def _link(self, name: str, element: Element, colors: dict[str, Any]) -> Link:
        self.left.update(f"<{child.tag}> of links" for child in element if child.tag not in _OF_LINK)
        parts: dict[str, list[Part]] = {"visual": [], "collision": []}
        for tag, found in parts.items():
            for child in element.findall(tag):
                material = child.find("material")
                color = self._rgb(material)
                if color is None and material is not None:
                    color = colors.get(material.get("name", ""))
                self.left.update(f"<{other.tag}> of {tag}s" for other in child if other.tag not in _OF_PART)
                part = self._part(child, color, needed=tag == "collision")
                found += [part] if part else []
        mass, com, inertia = 0.0, np.zeros(3), None
        inertial = self.child(element, "inertial")
        if inertial is not None:
            pose, weight = self.origin(inertial), self.child(inertial, "mass")
            if weight is None:
                raise self.wrong(inertial, "needs <mass value=>")
            mass, com = self.number(weight, "value", least=0.0), pose[:3, 3]
            tensor = self.child(inertial, "inertia")
            if tensor is not None:
                xx, xy, xz, yy, yz, zz = (
                    self.number(tensor, key, 0.0 if len(set(key)) == 3 else None)
                    for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
                )
                about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
                inertia = pose[:3, :3] @ about @ pose[:3, :3].T
        surface: dict[str, Any] = {"friction": 0.5, "restitution": 0.0}
        contact = self.child(element, "contact")
        for child in contact if contact is not None else ():
            if child.tag in _OF_CONTACT:
                key = child.tag.removeprefix("lateral_")
                surface[key] = self.number(child, "value", least=0.0)
                if key == "restitution" and surface[key] > 1.0:
                    raise self.wrong(child, f"value must be at most 1 (got {surface[key]:g})")
            else:
                self.left[f"<{child.tag}> of <contact>"] += 1
        return Link(
            name, np.eye(4), tuple(parts["collision"]), tuple(parts["visual"]), mass, com, inertia,
            where=self.where(element), **surface,
        )  # fmt: skip

    def _part(self, element: Element, color: Any, *, needed: bool) -> Part | None:
        geometry = self.child(element, "geometry")
        if geometry is None:
            raise self.wrong(element, "needs <geometry>")
        forms = [child for child in geometry if child.tag in GEOMETRIES]
        if len(forms) != 1:
            got = ", ".join(child.tag for child in geometry) or "nothing"
            raise self.wrong(geometry, f"must hold one of {', '.join(GEOMETRIES)} (got {got})")
        form, pose, mesh, sizes = forms[0], self.origin(element), None, {}
        if form.tag == "mesh":
            if (mesh := self._mesh(form, needed=needed)) is None:
                return None
        elif form.tag == "plane":
            normal = self.numbers(form, "normal", 3, (0.0, 0.0, 1.0))
            if not np.any(normal):
                raise self.wrong(form, "normal must not be zero")
            pose = pose @ pose_of(turn=Rotation.align_vectors([normal], [[0.0, 0.0, 1.0]])[0])
        elif form.tag == "box":
            sizes = {"size": self.numbers(form, "size", 3)}
        else:
            sizes = {"radius": self.number(form, "radius")}
            if form.tag != "sphere":
                caps = 2.0 * sizes["radius"] if form.tag == "capsule" else 0.0
                sizes["height"] = self.number(form, "length") + caps
        if any(np.min(value) == 0.0 for value in sizes.values()):
            self.notes.append(f"{self.where(form)} has no size: it is left out")
            return None
        for key, value in sizes.items():
            if np.min(value) < 0.0:
                raise self.wrong(form, f"{key} must be above zero (got {form.get(key) or value})")
        return Part(form.tag, pose, sizes, mesh, self.where(form), color)  # type: ignore[arg-type]

    def _mesh(self, element: Element, *, needed: bool) -> Mesh | None:
        """None if it is only for display and cannot be read."""
        name, scale = self.text(element, "filename"), self.numbers(element, "scale", 3, (1.0, 1.0, 1.0))
        place = self._find(name)
        try:
            if place is None:
                tried = "beside the file and above it, in --packages and ROS_PACKAGE_PATH"
                raise self.wrong(element, f"no such file: {name} (looked for {tried})", "give its folder: --packages")
            if place not in self.meshes:
                try:
                    self.meshes[place] = load_textured(place, upright=False)
                except SdfsimError as error:
                    hint = error.hint or "use " + " ".join(MESH_SUFFIXES)
                    raise self.wrong(element, error.message, hint) from error
        except SdfsimError as error:
            if needed:
                raise
            self.missed.append(f"the visual at line {self.line[id(element)]}: {error.message}")
            return None
        if not np.all(scale):
            raise self.wrong(element, f"scale must not be zero (got {element.get('scale')!r})")
        loaded = self.meshes[place]
        mesh = moved(loaded.mesh if needed else loaded.skin or loaded.mesh, np.diag([*scale, 1.0]))
        return mesh if np.prod(scale) > 0 else replace(mesh, faces=mesh.faces[:, ::-1])

    def _find(self, name: str) -> Path | None:
        scheme, _, rest = name.partition("://")
        if not rest:
            scheme, rest = "", name
        if scheme == "file":
            tried = [Path(rest)]
        elif not scheme:
            tried = [self.path.parent / rest, *(folder / rest for folder in self.packages)]
        else:
            package, _, inner = rest.partition("/")
            tried = [folder / rest for folder in self.packages]
            # Then in folders of that name, and in the others: a checkout may have another name than its package.
            tried += [folder / inner for folder in sorted(self.packages, key=lambda folder: folder.name != package)]
        try:
            return next((place for place in tried if place.is_file()), None)
        except (OSError, ValueError):
            return None

    def _joint(self, element: Element, links: list[Link], child: int, parent: int) -> tuple[Link, list[LinkJoint]]:
        """The child with its pose at the start, and the joint that holds it."""
        name, kind = self.text(element, "name"), self.text(element, "type")
        if kind not in KINDS:
            raise self.wrong(element, f"type must be one of {', '.join(KINDS)} (got {kind!r}{nearest(kind, KINDS)})")
        self.left.update(f"<{other.tag}> of joints" for other in element if other.tag not in _OF_JOINT)
        pose = links[parent].pose @ self.origin(element)
        anchor, turn = pose[:3, 3], pose[:3, :3]
        axis = self.child(element, "axis")
        along = np.array([1.0, 0.0, 0.0]) if axis is None else self.numbers(axis, "xyz", 3, (1.0, 0.0, 0.0))
        if not np.any(along) and KINDS[kind] in ("hinge", "slider"):
            raise self.wrong(element if axis is None else axis, "xyz must not be zero")
        along = turn @ along / (np.linalg.norm(along) or 1.0)
        dynamics = self.child(element, "dynamics")
        others = {}
        for key in ("damping", "friction"):
            value = 0.0 if dynamics is None else self.number(dynamics, key, 0.0, least=0.0)
            others |= {key: value} if value else {}
        if others and kind in ("fixed", "floating"):
            self.left[f"<dynamics> of {kind} joints"] += 1
            others = {}
        held = {"name": name, "child": child, "parent": parent, "anchor": anchor}
        if kind == "floating":
            return replace(links[child], pose=pose), []
        if kind == "planar":
            sides = Rotation.align_vectors([along], [[0.0, 0.0, 1.0]])[0].as_matrix()
            made = [LinkJoint(f"{name}_{k}", "slider", child, parent, anchor, sides[:, k]) for k in (0, 1)]
            return replace(links[child], pose=pose), [*made, LinkJoint(name, "hinge", child, parent, anchor, along)]
        if KINDS[kind] in ("fixed", "ball"):
            if KINDS[kind] == "ball" and self.child(element, "limit") is not None:
                self.left["limits of spherical joints"] += 1
            return replace(links[child], pose=pose), [LinkJoint(kind=KINDS[kind], **held, others=others)]  # type: ignore[arg-type]
        limits, start = self.limits[name], self.start[name]
        if kind == "prismatic":
            pose = pose_of(start * along) @ pose
        else:
            pose = pose @ np.eye(4)
            pose[:3, :3] = Rotation.from_rotvec(start * along).as_matrix() @ turn
        effort = self._effort(element)
        held |= {"anchor": pose[:3, 3], "axis": along, "start": start, "limits": limits, "others": others}
        held |= {"motor": {"max_force": effort} if effort > 0.0 else None}
        return replace(links[child], pose=pose), [LinkJoint(kind=KINDS[kind], **held)]  # type: ignore[arg-type]

    def _effort(self, element: Element) -> float:
        """N m or N, the largest effort of its motor; 0 if the file gives none."""
        limit = self.child(element, "limit")
        if limit is None or "effort" not in limit.attrib:
            return 0.0
        effort = limit.get("effort", "").strip().lower().removeprefix("+")
        # Some programs write this for "unlimited".
        return UNBOUNDED if effort in ("inf", "infinity") else min(self.number(limit, "effort", least=0.0), UNBOUNDED)

    def _limits(self, element: Element, name: str, kind: str) -> tuple[float, float] | None:
        limit = self.child(element, "limit")
        if limit is not None:
            self.left["velocity of <limit>"] += "velocity" in limit.attrib
        if kind == "continuous":
            return None
        if limit is None:
            self.notes.append(f"joint {name} has no <limit>: nothing bounds it")
            return None
        low, high = self.number(limit, "lower", 0.0), self.number(limit, "upper", 0.0)
        if low > high:  # PyBullet's way to say "no limits"
            self.notes.append(f"joint {name} has its lower limit above its upper one: nothing bounds it")
            return None
        if low == high == 0.0:
            self.notes.append(
                f"joint {name} has limits of 0 and 0, which lock it: give them, or lower above upper for none"
            )
        return low, high
