"""Photos of one object in two states, such as a door shut and open -> a scene with the joint of the moving part.

Each state is reconstructed separately, because nothing moves within a state. Most surfaces that look alike in both are
static and align the two. The remaining difference gives the joint. The scene is made from the state that shows most of
the part; the part's pixels are its labels.

Posing the photos of both states together would fail if the part fills the photos, because the cameras would follow it.

Folders: `first` and `second` hold a reconstruction of each state up to its meshes, and the folder itself a whole
reconstruction of one of them, with the joint.
"""

import itertools
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from PIL import Image

from pipeline import stages
from pipeline.cameras import STILL
from pipeline.field.training import load_field
from pipeline.inputs.labels import FOLDER, NAMES, load_names
from pipeline.inputs.photos import load_photos
from pipeline.mesh.joint import JOINT, PART, HeldPart, find_joint
from pipeline.mesh.moving_part import CELLS, alike, label_images, load_state, tie, which_move
from pipeline.mesh.placement import check_distance, load_placement
from pipeline.options import OptionKeys, options_of
from pipeline.records import PhotosReport, read
from pipeline.stages import RECORD, Instead, Project, Record, check_apart, read_record, run_all, wanted_stages
from sdfsim.base.errors import EXIT_QUALITY, EXIT_USAGE, SdfsimError
from sdfsim.base.files import write_json
from sdfsim.base.parallel import StageProgress

FIRST, SECOND = "first", "second"
WITHOUT = ("crop", "body", "up")  # options that refer to one state's meshes


def reconstruct(
    photos: str | Path, out: str | Path, *, joint: str | Path | None = None, from_stage: str | None = None,
    until_stage: str | None = None, progress: StageProgress | None = None, **options: Unpack[OptionKeys],
) -> dict:  # fmt: skip
    """Photos -> a scene that can be simulated.

        sdfsim.reconstruct("PHOTOS", "room", preset="quick", size=1.8, progress=print)
        sdfsim.reconstruct("SHUT", "cupboard", joint="OPEN", preset="quick")

    `joint` are photos of the same object in another state, for example with its door open: the moving part becomes a
    separate body, called `part`, on a hinge or a slider. `options` are those of `sdfsim reconstruct --help` with the
    same names, and `seed` and `recipe` (see `OptionKeys`); `from_stage` and `until_stage` are its --from and --until.
    `progress` is called with the stage, its finished share, and a line.

    Writes one folder per stage, Shape folders in `assets/`, `scene.yaml`, `config.yaml`, `report.json` and `report.md`
    to `out` (for two states also a folder for each), and returns the report. Skips a stage if its inputs, options and
    version are those of its last run, and resumes a killed one. Photos (see `find_source`) are never written to. Raises
    SdfsimError for bad photos or options (exit code 1), or if poses, surface or joint are not good enough (3).
    """
    given: Any = {"from_stage": from_stage, "until_stage": until_stage, "progress": progress, **options}
    return (
        stages.reconstruct(photos, out, **given)
        if joint is None
        else reconstruct_states(photos, joint, out, **given)[0]
    )


def reconstruct_states(
    first: str | Path, second: str | Path, out: str | Path, *, from_stage: str | None = None,
    until_stage: str | None = None, progress: StageProgress | None = None, **options: Any,
) -> tuple[dict, Path]:  # fmt: skip
    """Photos of an object in two states -> a scene in which the moving part is a separate body, on a hinge or a slider.

    Takes the stages and options of `reconstruct` for both states; the size is that of the first state's scene. Returns
    the report of the scene, or of the last wanted stage, and its folder. Raises the SdfsimErrors of `reconstruct`,
    `tie` and `find_joint`, and one if the photos come with masks.
    """
    out, given = Path(out), (Path(first), Path(second))
    if given[0].resolve() == given[1].resolve():
        raise SdfsimError(f"{second}: is the folder of the first state as well", "give one folder for each state")
    resolved = options_of(photos=str(given[0].absolute()), **options)
    for name in WITHOUT:
        if getattr(resolved, name):
            message = f"--{name} cannot be combined with --joint"
            raise SdfsimError(message, "give it to `sdfsim mesh` afterwards", exit_code=EXIT_USAGE)
    again = wanted_stages(from_stage, until_stage)

    def wanted(*names: str) -> dict[str, bool]:
        """Those of some stages that have to run, and whether also if nothing changed."""
        return {name: again[name] for name in names if name in again}

    def project(name: str, **changes: Any) -> Project:
        def said(stage: str, done: float, message: str) -> None:
            if progress is not None:
                progress(f"{name or 'scene'}: {stage}", done, message)

        return Project(out / name, resolved.changed(changes), said)

    share = {} if resolved.budget is None else {"budget": 0.5 * resolved.budget}  # each state gets half of the time
    states = [project(name, photos=str(path.absolute()), distance=None, **share)
              for name, path in zip((FIRST, SECOND), given, strict=True)]  # fmt: skip
    final = project("", size=None, distance=None)
    for state, own in itertools.product(states, (*states, final)):
        check_apart(replace(own, options=state.options))
    for state in states:
        run_all(state, wanted("photos"))
        check_unmasked(state)
    scaled = 0
    if (distance := resolved.distance) is not None:
        scaled = measured_in(states, distance)
        states[scaled].options = states[scaled].options.changed({"distance": distance})
    report: dict = {}
    for state in states:
        state.started = time.monotonic()
        report = run_all(state, wanted("photos", "poses", "distill", "mesh"))
    if "mesh" not in again:
        return report, states[1].folder
    final.instead["photos"] = Instead(lambda own, work: label_part(own, states, scaled, work),
                                      [_record(state, "mesh").made for state in states])  # fmt: skip
    run_all(final, wanted("photos"))
    best = states[read(PhotosReport, _record(final, "photos").report).state]
    final.options = final.options.changed({"photos": best.options.photos})
    for stage in ("poses", "distill"):
        final.instead[stage] = Instead(lambda _, work, stage=stage: take(best, stage, work), _record(best, stage).made)
    return run_all(final, again), final.folder


def _record(project: Project, stage: str) -> Record:
    found = read_record(project.place(stage))
    assert found is not None  # It has just been run.
    return found


def check_unmasked(state: Project) -> None:
    """Raises SdfsimError if the photos of a state come with masks, because most static surfaces are outside of them."""
    folder = state.place("photos")
    if all(photo.mask for photo in load_photos(folder)) or load_names(folder):
        message = "--joint takes no masks: the static surfaces around the object align both states"
        raise SdfsimError(f"{state.options.photos}: {message}", "give the photos without them")


def measured_in(states: Sequence[Project], distance: Any) -> int:
    """The state whose photos show both places of a known distance. Raises SdfsimError if neither's do."""
    errors = []
    for number, state in enumerate(states):
        try:
            check_distance(distance, load_photos(state.place("photos")))
            return number
        except SdfsimError as error:
            errors.append(error)
    raise SdfsimError(f"{errors[0].message} in the first state; in the second: {errors[1].message}", errors[0].hint)


def label_part(own: Project, states: Sequence[Project], scaled: int, work: Path) -> PhotosReport:
    """Finds the joint, and takes the photos of the state that shows most of the part, with labels of the part and the
    joint in the world of the poses. A unit of this world is as long as in the meshes of the `scaled` state."""
    on_progress = own.progress_of("photos")
    one, other = (load_state(state.folder) for state in states)
    on_progress(0.1, "looking for static surfaces")
    onto, _ = tie(other, one)
    other = other.moved(onto)
    near = CELLS * max(one.cell, other.cell)
    on_progress(0.3, "looking for the part that has moved")
    try:
        found = find_joint(one.visible, other.visible, seed=own.options.seed, near=near,
                           empty=(one.empty, other.empty), paired=partial(alike, one, other))  # fmt: skip
    except SdfsimError as error:
        raise SdfsimError(f"joint: {error.message}", error.hint, exit_code=EXIT_QUALITY) from error
    shown = [len(np.unique(np.floor(points / near), axis=0)) for points in found.seen]
    number = int(shown[1] >= shown[0])
    best, rest = (one, other)[number], (one, other)[1 - number]
    motion = found.motion.inverse() if number else found.motion
    on_progress(0.6, "marking the moving part in the photos")
    labels = label_images(best, which_move(best.closed, rest, motion, found.seen[number]))
    source = states[number].place("photos")
    shutil.copytree(source, work, copy_function=_link, ignore=shutil.ignore_patterns(RECORD), dirs_exist_ok=True)
    (work / FOLDER).mkdir()
    for name, image in labels.items():
        Image.fromarray(image).save(work / FOLDER / f"{name}.png")
    write_json(work / FOLDER / NAMES, {"version": 1, "names": [PART]})
    home = motion if number else STILL
    sizes = [load_placement(state.folder / "mesh") for state in states]
    # From metres of the first state's meshes to final metres, and to the world of the chosen state's poses.
    unit = 1.0 if scaled == 0 else 1.0 / onto.scale
    held = HeldPart(
        found.kind, found.anchor, found.axis, found.travel, found.off, found.doubt, found.follows, found.size,
        home.rotation, home.translation, unit, sizes[scaled].size_from, sizes[scaled].size_assumed,
    )  # fmt: skip
    # The best state's own metres, moved into the first's if it is the second, came from the world of its poses.
    state = states[number]
    to_metres = load_placement(state.folder / "mesh").to_metres.after(load_field(state.place("distill")).to_unit)
    to_poses = to_metres.inverse()
    held.moved(to_poses.after(onto.inverse()) if number else to_poses).save(work / JOINT)
    return replace(read(PhotosReport, _record(state, "photos").report), state=number)


def take(state: Project, stage: str, work: Path) -> dict:
    """A stage's result in the folder of a state."""
    place = state.place(stage)
    shutil.copytree(place, work, copy_function=_link, ignore=shutil.ignore_patterns(RECORD), dirs_exist_ok=True)
    return _record(state, stage).report


def _link(source: str | Path, target: str | Path) -> None:
    """A hard link to a file that no stage changes, or a copy if links do not work."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
