"""Options: one model checks them, whoever gives them, and says which stages they change; materials by name."""

from pathlib import Path

import pytest
import yaml

from pipeline.materials import MATERIALS, materials_of
from pipeline.options import OptionKeys, Options, options_of, read_config, write_config
from sdfsim.base.errors import SdfsimError
from tests.helpers.command import run as command


@pytest.mark.parametrize(
    ("values", "name", "got"),
    [
        ({"preset": "volsdf"}, "preset", "'volsdf'"),
        ({"size": -1.0}, "size", "-1"),
        ({"size": float("nan")}, "size", "nan"),
        ({"distance": ["a", "b", 0]}, "distance", "0"),
        ({"distance": ["a", "b"]}, "distance", "['a', 'b']"),
        ({"crop": [5, 5, 5, 1, 6, 6]}, "crop", "[5.0, 5.0, 5.0, 1.0, 6.0, 6.0]"),
        ({"crop": [1, 2, 3]}, "crop", "[1, 2, 3]"),
        ({"budget": float("inf")}, "budget", "inf"),
        ({"recipe": "best"}, "recipe", "'best'"),
        ({"material": {"cup": 3}}, "material", "3"),
    ],
)
def test_a_value_that_makes_no_sense_is_one_line_with_its_option(values, name, got):
    with pytest.raises(SdfsimError) as caught:
        options_of(**values)
    message = caught.value.message
    assert message.startswith(f"{name}: ") and f"(got {got})" in message and "\n" not in message


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["cup"], "takes NAME=PHOTO:X,Y, such as"),
        (["=a.jpg:1,2"], "takes NAME=PHOTO:X,Y, such as"),
        (["cup="], r"\(got cup=\)"),
        (["my cup=a.jpg:1,2"], "body: no body can be called 'my cup'"),
        (["floor=a.jpg:1,2"], "body: no body can be called 'floor'"),
        (["no=a.jpg:1,2"], "body: no body can be called 'no'"),
    ],
)
def test_a_body_that_cannot_be_pointed_at_is_one_line(given, says):
    with pytest.raises(SdfsimError, match=says) as caught:
        options_of(body=given)
    assert "\n" not in caught.value.message


def test_places_of_one_body_are_put_together():
    given = options_of(body=["cup=a.jpg:1,2", "vase=b=c.jpg:3,4.5", "cup=d/e.jpg:5,6"])
    assert given.body == {"cup": ["a.jpg:1,2", "d/e.jpg:5,6"], "vase": ["b=c.jpg:3,4.5"]}
    assert options_of(**given.model_dump()) == given and "body" in given.of_stage("mesh")


def test_an_option_that_does_not_exist_is_named_with_those_that_do():
    with pytest.raises(SdfsimError, match="colour") as caught:
        options_of(colour="red")
    assert "crop" in caught.value.hint


def test_config_gives_back_every_option(tmp_path):
    given = options_of(
        photos="/a", preset="quick", budget=90, seed=3, distance=["a.jpg:1,2", "b.jpg", 2], crop=["0,0,0", "1,2,3.5"],
        drop="ball", material={"cup": "ceramic:4mm"}, recipe="quick", device="cpu",
    )  # fmt: skip
    write_config(given, tmp_path)
    assert read_config(tmp_path) == given
    content = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert content["crop"] == [0, 0, 0, 1, 2, 3.5] and content["distance"] == ["a.jpg:1,2", "b.jpg", 2]


@pytest.mark.parametrize("content", ["", "[1, 2]", "command: simulate\nversion: 1\nscene: a.yaml\n", "a: [", None])
def test_a_folder_of_something_else_is_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(SdfsimError, match=tmp_path.name):
        read_config(tmp_path)


def test_a_config_with_a_bad_value_names_file_and_option(tmp_path):
    write_config(Options(), tmp_path)
    text = (tmp_path / "config.yaml").read_text().replace("preset: standard", "preset: slow")
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(SdfsimError, match=r"config\.yaml: preset: .*'slow'"):
        read_config(tmp_path)


def test_what_changes_one_changes_the_other():
    sized = options_of(size=2.0)
    known = sized.changed({"distance": ["a", "b", 1.0]})
    assert known.size is None and known.changed({"size": 3.0}).distance is None


def test_commands_take_what_changes_their_stage():
    for stage in ("mesh", "distill", "fit"):
        shown = command(stage, "--help").stdout
        options = [name for name in options_of().of_stage(stage) if name not in ("seed", "budget")]
        assert options and all(f"--{name}" in shown for name in options)


@pytest.mark.parametrize(
    ("given", "code"),
    [(("1,2,3", "4,5,x"), 2), (("1,2", "3,4,5"), 2), (("1,2,3", "4,5,1"), 1), (("0,0,0", "1,2,3"), 0)],
)
def test_corners_on_the_command_line(photos, tmp_path, calls, monkeypatch, given, code):
    monkeypatch.setattr("pipeline.report.write_recording", lambda folder, done: None)
    assert command("reconstruct", photos, "-o", tmp_path / "out", "--crop", *given).exit_code == code
    if code:
        assert not (tmp_path / "out").exists()
    else:
        assert read_config(tmp_path / "out").crop == (0, 0, 0, 1, 2, 3)


def test_type_checkers_know_the_options():
    assert set(OptionKeys.__annotations__) == set(Options.model_fields) - {"photos"}


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
