"""Materials, and how a command names them."""

from pathlib import Path

import pytest

from pipeline.materials import MATERIALS, materials_of
from pipeline.options import options_of, read_config
from sdfsim.base.errors import SdfsimError
from tests.helpers.command import run as command

ROOT = Path(__file__).parents[2]
# What the Engineering ToolBox has for dry pairs: from the least of the sliding to the most of the static friction.
FRICTION = {
    ("wood", "wood"): (0.2, 0.5), ("wood", "steel"): (0.2, 0.6), ("wood", "concrete"): (0.4, 0.62),
    ("leather", "wood"): (0.3, 0.61), ("glass", "glass"): (0.4, 1.0), ("glass", "steel"): (0.4, 0.7),
    ("steel", "steel"): (0.42, 0.8), ("aluminium", "steel"): (0.47, 0.61), ("plastic", "steel"): (0.3, 0.5),
    ("rubber", "concrete"): (0.6, 1.0), ("rubber", "steel"): (0.64, 0.86), ("rubber", "cardboard"): (0.5, 0.8),
    ("textile", "textile"): (0.3, 0.4),
}  # fmt: skip
# What The Physics Factbook has for balls on a hard floor.
REBOUND = {"wood": 0.6, "steel": 0.6, "glass": 0.66, "plastic": 0.69, "rubber": 0.83}


@pytest.mark.parametrize("pair", FRICTION)
def test_the_product_of_two_frictions_is_that_of_the_pair(pair):
    least, most = FRICTION[pair]
    assert least <= MATERIALS[pair[0]].friction * MATERIALS[pair[1]].friction <= most


@pytest.mark.parametrize("name", REBOUND)
def test_the_product_of_two_restitutions_is_the_rebound_on_a_hard_floor(name):
    product = MATERIALS[name].restitution * MATERIALS["concrete"].restitution
    assert product == pytest.approx(REBOUND[name], rel=0.1)


def test_the_table_of_the_documents_is_that_of_the_code():
    text = (ROOT / "docs" / "objects.md").read_text()
    for name, made in MATERIALS.items():
        known = ((made.density, made.density_from), (made.friction, made.friction_from),
                 (made.restitution, made.restitution_from))  # fmt: skip
        assert f"| `{name}` | " + " | ".join(f"{number:g} ({source})" for number, source in known) + " |" in text


@pytest.mark.parametrize(
    ("text", "wall"), [("glass", None), ("glass:4mm", 0.004), ("glass:.5cm", 0.005), ("glass:2m", 2)]
)
def test_a_material_may_have_the_thickness_of_a_wall(text, wall):
    choice = materials_of({"object1": text})["object1"]
    assert (choice.name, choice.material) == ("glass", MATERIALS["glass"]) and choice.wall == pytest.approx(wall)


@pytest.mark.parametrize(
    ("body", "text", "message"),
    [
        ("object1", "cermic", "object1: no such material: 'cermic' (did you mean 'ceramic'?)"),
        ("object1", "glass:4", "object1: '4' is not the thickness of a wall"),
        ("object1", "glass:0mm", "object1: '0mm' is not the thickness of a wall"),
        ("object1", "glass:-4mm", "object1: '-4mm' is not the thickness of a wall"),
        ("object1", "glass:", "object1: '' is not the thickness of a wall"),
        ("scenery", "glass:4mm", "scenery: needs no thickness: it does not move, so its mass does not matter"),
    ],
)
def test_what_is_no_material_is_refused_before_any_work(body, text, message):
    with pytest.raises(SdfsimError) as caught:
        options_of(material={body: text})
    assert caught.value.message == f"material: {message}" and caught.value.exit_code == 1


@pytest.mark.parametrize(
    ("mass", "message"),
    [({"scenery": 2.0}, "mass: scenery: does not move"), ({"cup": 0.0}, "mass: cup: must be more than 0 kg")],
)
def test_what_is_no_mass_is_refused(mass, message):
    with pytest.raises(SdfsimError, match=message):
        options_of(mass=mass)


def test_the_command_takes_a_material_for_every_body(photos, tmp_path, calls, monkeypatch):
    monkeypatch.setattr("pipeline.report.write_recording", lambda folder, done: None)

    def reconstruct(*materials: str, mass: str = "object1=0.35") -> int:
        options = ["--mass", mass, *(part for text in materials for part in ("--material", text))]
        return command("reconstruct", photos, "-o", tmp_path / "out", *options).exit_code

    assert reconstruct("object1=cermic") == 1
    assert reconstruct("object1") == reconstruct("=wood") == reconstruct("a=wood", "a=glass") == 2
    assert reconstruct("object1=wood", mass="object1=heavy") == 1
    assert calls == [] and not (tmp_path / "out").exists()
    assert reconstruct("object1=ceramic:4mm", "scenery=wood") == 0
    assert read_config(tmp_path / "out").mass == {"object1": 0.35}
    assert read_config(tmp_path / "out").material == {"object1": "ceramic:4mm", "scenery": "wood"}
