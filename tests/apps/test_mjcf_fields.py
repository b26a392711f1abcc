"""What an MJCF file says is done or named: every flag, every attribute, and fields that only a newer MuJoCo has. Judged
by MuJoCo itself."""

from pathlib import Path
from typing import Any

import mujoco  # noqa: TID253
import numpy as np
import pytest

from sdfsim import load_scene
from sdfsim.apps import mjcf
from sdfsim.apps.import_robot import import_robot
from sdfsim.scene.scene import Scene

SCENE = """<mujoco><option>{option}</option><worldbody>
  <geom name="ground" type="plane" size="1 1 1" {ground}/>
  <body name="arm" pos="0 0 1"><joint name="j" axis="0 1 0" range="-20 20" limited="true" stiffness="3" damping="0.4"
    frictionloss="0.2" {joint}/><geom name="rod" type="capsule" size="0.05" fromto="0 0 0 0.4 0 0" {rod}/></body>
  <body name="ball" pos="2 0 0.1"><joint type="free" name="free" {free}/><geom name="round" size="0.1" {ball}/></body>
  <body name="bob" pos="0.4 0 0.8"><freejoint/><geom name="bead" size="0.05"/></body>
  </worldbody><equality><connect name="pin" body1="arm" body2="bob" anchor="0.4 0 0" {pin}/></equality>
  <actuator><motor name="m" joint="j" {motor}/></actuator></mujoco>"""


def text(**said: str) -> str:
    places = dict.fromkeys(("option", "ground", "joint", "rod", "free", "ball", "pin", "motor"), "")
    return SCENE.format(**places | said)


def imported(folder: Path, xml: str) -> tuple[Scene, dict[str, Any]]:
    (folder / "scene.xml").write_text(xml)
    report = import_robot(folder / "scene.xml", folder / "scene.yaml")
    return load_scene(folder / "scene.yaml"), report


def features(scene: Scene) -> dict[str, bool]:
    joint = next(joint for joint in scene.joints if joint.name == "j")
    return {
        "gravity": bool(np.any(scene.gravity)),
        "limit": joint.limits is not None,
        "spring": joint.spring is not None,
        "damper": joint.damping > 0,
        "frictionloss": joint.friction > 0,
        "equality": any(joint.name == "pin" for joint in scene.joints),
        "contact": scene.effects.contact != "off",
        "actuation": joint.motor is not None,
    }


@pytest.mark.parametrize("flag", ["gravity", "limit", "spring", "damper", "frictionloss", "equality", "contact",
                                  "actuation", "constraint"])  # fmt: skip
def test_what_a_flag_switches_off_is_off_and_nothing_else(tmp_path: Path, flag: str) -> None:
    scene, report = imported(tmp_path, text(option=f'<flag {flag}="disable"/>'))
    off = ["limit", "frictionloss", "equality", "contact"] if flag == "constraint" else [flag]
    assert features(scene) == {name: name not in off for name in features(scene)}
    assert f"the file switches off (1: {flag})" in report["notes"]


def test_flags_that_are_not_done_are_named(tmp_path: Path) -> None:
    _, report = imported(tmp_path, text(option='<flag energy="enable" filterparent="disable" warmstart="disable"/>'))
    named = next(line for line in report["left_out"] if line.startswith("flags of MuJoCo"))
    assert all(flag in named for flag in ("energy enable", "filterparent disable", "warmstart disable"))


@pytest.mark.parametrize(
    ("said", "line"),
    [
        ({"rod": 'margin="0.01"'}, "margin and gap of geoms: bodies touch at their surface here (1: rod)"),
        ({"ball": 'gap="0.01"'}, "margin and gap of geoms: bodies touch at their surface here (1: round)"),
        ({"rod": 'solmix="2"'}, "(1: rod)"),
        ({"ball": 'priority="1"'}, "priority and solmix of geoms"),
        ({"ball": 'solimp="0.5 0.9 0.01"'}, "solimp of geoms: contacts are rigid here (1: round)"),
        ({"ball": 'condim="6"'}, "friction against spinning and rolling (1: round)"),
        ({"free": 'damping="0.1"'}, "damping, stiffness and friction of free joints (1: free)"),
        ({"free": 'stiffness="0.1"'}, "damping, stiffness and friction of free joints (1: free)"),
        ({"free": 'frictionloss="0.1"'}, "damping, stiffness and friction of free joints (1: free)"),
        ({"joint": 'solreflimit="0.1 1"'}, "margin and softness of limits: they are rigid here (1: j)"),
        ({"pin": 'solref="0.1 1"'}, "softness of equalities and tendons: they are rigid here (1: pin)"),
        ({"motor": 'user="4"'}, "actuator_user of MuJoCo's model (1: m)"),
        ({"option": '<flag gravity="enable"/>'}, ""),
        ({"pin": 'active="false"'}, "equalities that are switched off (1: pin)"),
    ],
)
def test_what_is_said_of_an_element_is_named(tmp_path: Path, said: dict[str, str], line: str) -> None:
    plain = set(imported(tmp_path, text())[1]["left_out"])
    assert plain == set()
    left = imported(tmp_path, text(**said))[1]["left_out"]
    assert (len(left) == 1 and line in left[0]) if line else not left


def test_options_of_the_step_are_named_together(tmp_path: Path) -> None:
    xml = text().replace("<option>", '<option timestep="0.004" cone="elliptic" wind="1 0 0">')
    left = imported(tmp_path, xml)[1]["left_out"]
    assert left == ["air: density, viscosity and wind", "options of MuJoCo's step (2: cone, timestep)"]


class Newer:
    """A model as a newer MuJoCo may have it, with fields that this one lacks."""

    def __init__(self, model: mujoco.MjModel, **added: Any) -> None:
        self._model, self._added = model, added

    def __getattr__(self, name: str) -> Any:
        return self._added[name] if name in self._added else getattr(self._model, name)

    def __dir__(self) -> list[str]:
        return [*dir(self._model), *self._added]


def test_a_field_that_only_a_newer_mujoco_has_is_named() -> None:
    model = mujoco.MjModel.from_xml_string(text())
    plain = mujoco.MjModel.from_xml_string(mjcf.PLAIN)
    glue = np.zeros((model.ngeom, 2))
    assert not list(mjcf.unused(Newer(model, geom_glue=glue, moon=0.0), plain))
    glue[2, 1] = 0.5
    quiet = Newer(model, geom_glue=glue, foam_size=np.ones(1), moon=1.6, nfoam=1)
    found = [(element, line, rows.tolist()) for element, line, rows in mjcf.unused(quiet, plain)]
    assert found == [
        ("foam", "foam_size of MuJoCo's model", [0]),
        ("geom", "geom_glue of MuJoCo's model", [2]),
        ("", "moon of MuJoCo's model", []),
    ]


def test_a_body_slides_without_friction_if_all_of_its_contacts_do(tmp_path: Path) -> None:
    scene, report = imported(tmp_path, text(ground='condim="1"', ball='condim="1"', rod='condim="1"'))
    rough = {body.name: body.friction for body in scene.bodies}
    # The bead has friction, so it and all that it may touch keep theirs; only what it never touches slides.
    assert rough["ground"] > 0 and rough["ball"] > 0 and rough["bob"] > 0
    assert any(note.startswith("friction of ") for note in report["notes"])
    alone = text(ground='condim="1"', ball='condim="1"', rod='condim="1"').replace('"bead"', '"bead" condim="1"')
    scene, report = imported(tmp_path, alone)
    assert all(body.friction == 0.0 for body in scene.bodies)
    assert not any("friction of" in note for note in report["notes"])
