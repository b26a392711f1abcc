"""Photos of one thing in two states, such as a door shut and open -> a scene with the joint of what moves.

All photos are posed together: what stands still ties the states. Each state then has its own field and surface. What
differs gives the joint, and the scene is made of the state that shows most of the part, whose pixels are its labels.

Folders: `first` and `second` hold a reconstruction of each state as far as its meshes, `together` the poses, and the
folder itself a whole reconstruction of one state, with the joint.
"""

from __future__ import annotations

import itertools
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.cameras import PosedPhotos, load_poses, save_views
from pipeline.field.training import load_field
from pipeline.inputs.labels import FOLDER, NAMES, load_names
from pipeline.inputs.photos import KNOWN_CAMERAS, Photo, load_photos, save_photos
from pipeline.mesh.joint import JOINT, PART, HeldPart, find_joint
from pipeline.mesh.moving_part import CELLS, alike, label_images, load_state, part_of, which_move
from pipeline.mesh.placement import check_distance, load_placement
from pipeline.options import options_of
from pipeline.stages import RECORD, Instead, Project, check_apart, number_of, read_record, run_all
from pipeline.stereo.depth import only
from sdfsim.base.errors import EXIT_QUALITY, EXIT_USAGE, SdfsimError
from sdfsim.base.files import write_arrays, write_json

FIRST, SECOND, TOGETHER = "first", "second", "together"
POSED = 0.5  # of the photos of a state that have to be posed together with the other state's
TIED = 30  # points that photos of both states have to see
TIE = "leave most of what the photos show as it is, and photograph it from the same sides in both states"
WITHOUT = ("crop", "body")  # options that say something of one state's meshes

Said = Callable[[str, float, str], None]


def reconstruct_states(
    first: str | Path, second: str | Path, out: str | Path, *, from_stage: str | None = None,
    until_stage: str | None = None, progress: Said | None = None, **options: Any,
) -> tuple[dict, Path]:  # fmt: skip
    """Photos of a thing in two states -> a scene in which what moves is a body of its own, on a hinge or a slider.

    Takes stages and options as `reconstruct` does, for both states; the size is that of the first state's scene.
    Returns the report of the scene, or of the last stage that was wanted, and its folder. Raises SdfsimError as
    `reconstruct` and `find_joint` do, and where the photos cannot be posed together, or come with cameras or masks.
    """
    out, given = Path(out), (Path(first), Path(second))
    if given[0].resolve() == given[1].resolve():
        raise SdfsimError(f"{second}: is the folder of the first state as well", "give one folder for each state")
    resolved = options_of(photos=str(given[0].absolute()), **options)
    for name in WITHOUT:
        if getattr(resolved, name):
            message = f"--{name} goes without --joint"
            raise SdfsimError(message, "give it to `sdfsim mesh` afterwards", exit_code=EXIT_USAGE)
    start = number_of(from_stage) if from_stage else number_of("scene") + 1
    last = number_of(until_stage or "scene")
    if from_stage and start > last:
        raise SdfsimError(f"from {from_stage} until {until_stage}: {until_stage} comes before {from_stage}")

    def wanted(*names: str) -> dict[str, bool]:
        """Those of some stages that are to be done, and whether also where nothing changed."""
        return {name: number_of(name) >= start for name in names if number_of(name) <= last}

    def project(name: str, **changes: Any) -> Project:
        said = None if progress is None else _named(progress, name or "scene")
        return Project(out / name, resolved.changed(changes), said)

    share = {} if resolved.budget is None else {"budget": 0.5 * resolved.budget}  # each state has half of the time
    states = [project(name, photos=str(path.absolute()), distance=None, **share)
              for name, path in zip((FIRST, SECOND), given, strict=True)]  # fmt: skip
    together, final = project(TOGETHER, distance=None), project("", size=None, distance=None)
    for state, own in itertools.product(states, (*states, together, final)):
        check_apart(replace(own, options=state.options))
    for state in states:
        run_all(state, wanted("photos"))
        check_plain(state)
    scaled = 0
    if (distance := resolved.distance) is not None:
        scaled = measured_in(states, distance)
        states[scaled].options = states[scaled].options.changed({"distance": distance})
    made = [_record(state, "photos")["made"] for state in states]
    together.instead["photos"] = Instead(lambda _, work: merge(states, work), made)
    try:
        report = run_all(together, wanted("photos", "poses"))
    except SdfsimError as error:
        if error.exit_code != EXIT_QUALITY:
            raise
        message = f"the photos of both states cannot be posed together: {error.message}"
        raise SdfsimError(message, f"{TIE}; {error.hint}", exit_code=EXIT_QUALITY) from error
    if last <= number_of("poses"):
        return report, together.folder
    check_tied(states, together)
    posed = _record(together, "poses")["made"]
    for number, state in enumerate(states):
        state.instead["poses"] = Instead(
            lambda _, work, number=number: take_poses(states, together, number, work), posed
        )
        state.started = time.monotonic()
        report = run_all(state, wanted("poses", "distill", "mesh"))
    if last < number_of("mesh"):
        return report, states[1].folder
    final.instead["photos"] = Instead(lambda own, work: label_part(own, states, scaled, work),
                                      [_record(state, "mesh")["made"] for state in states])  # fmt: skip
    run_all(final, wanted("photos"))
    best = states[_record(final, "photos")["report"]["state"]]
    final.options = final.options.changed({"photos": best.options.photos})
    for stage in ("poses", "distill"):
        record = _record(best, stage)
        final.instead[stage] = Instead(lambda _, work, stage=stage: take(best, stage, work), record["made"])
    return run_all(final, wanted("photos", "poses", "distill", "mesh", "fit", "scene")), final.folder


def _named(progress: Said, name: str) -> Said:
    return lambda stage, done, message: progress(f"{name}: {stage}", done, message)


def _record(project: Project, stage: str) -> dict:
    found = read_record(project.place(stage))
    assert found is not None  # It has just been run.
    return found


def check_plain(state: Project) -> None:
    """Raises SdfsimError where the photos of a state come with cameras, depth or masks, which say what is in one world
    or one thing and not what stands still."""
    folder, given = state.place("photos"), state.options.photos
    photos = load_photos(folder)
    hint = "for both states give a folder of photos, or a video, and nothing else"
    if (folder / KNOWN_CAMERAS).exists():
        raise SdfsimError(f"{given}: --joint finds the cameras of both states together, and takes none that are known",
                          hint)  # fmt: skip
    if all(photo.mask for photo in photos) or load_names(folder):
        raise SdfsimError(f"{given}: --joint takes no masks: what stands still around the thing ties both states", hint)


def measured_in(states: Sequence[Project], distance: Any) -> int:
    """Which state's photos hold both places of a known distance. Raises SdfsimError: neither's."""
    errors = []
    for number, state in enumerate(states):
        try:
            check_distance(distance, load_photos(state.place("photos")))
            return number
        except SdfsimError as error:
            errors.append(error)
    raise SdfsimError(f"{errors[0].message} in the first state; in the second: {errors[1].message}", errors[0].hint)


def merge(states: Sequence[Project], work: Path) -> dict:
    """The prepared photos of both states in one folder, those of the first state first."""
    (work / "images").mkdir()
    photos: list[Photo] = []
    for number, (name, state) in enumerate(zip((FIRST, SECOND), states, strict=True)):
        for photo in load_photos(state.place("photos")):
            called = f"{len(photos):04d}.jpg"
            _link(state.place("photos") / "images" / photo.name, work / "images" / called)
            source = f"{name}/{photo.source}"
            photos.append(replace(photo, name=called, source=source, mask=False, state=number))
    save_photos(photos, work)
    return {"count": len(photos), "notes": [], "masks": 0}


def _of_state(poses: PosedPhotos, together: Project, number: int) -> list[int]:
    """Which of the views show a state."""
    shows = {photo.name: photo.state for photo in load_photos(together.place("photos"))}
    return [k for k, view in enumerate(poses.views) if shows[view.name] == number]


def check_tied(states: Sequence[Project], together: Project) -> None:
    """Raises SdfsimError (exit code 3) where the poses that were found are mostly of one state, or hardly any point is
    seen in both."""
    poses = load_poses(together.place("poses"))
    shown = np.zeros((2, len(poses.sparse.xyz)), bool)
    for number, state in enumerate(states):
        views, count = _of_state(poses, together, number), len(load_photos(state.place("photos")))
        if len(views) < POSED * count:
            message = (
                f"{state.options.photos}: only {len(views)} of {count} photos could be posed with the other state's"
            )
            raise SdfsimError(message, TIE, exit_code=EXIT_QUALITY)
        shown[number, poses.sparse.point_of[np.isin(poses.sparse.view_of, views)]] = True
    if shown.all(0).sum() < TIED:
        message = f"only {shown.all(0).sum()} points are seen in both states: their cameras have nothing in common"
        raise SdfsimError(message, TIE, exit_code=EXIT_QUALITY)


def take_poses(states: Sequence[Project], together: Project, number: int, work: Path) -> dict:
    """Those of the cameras and points found together that are a state's own."""
    poses, photos = load_poses(together.place("poses")), load_photos(states[number].place("photos"))
    views = _of_state(poses, together, number)
    first = sum(len(load_photos(state.place("photos"))) for state in states[:number])
    named = {f"{first + k:04d}.jpg": photo for k, photo in enumerate(photos)}
    some = only(poses, views)
    often = np.bincount(some.sparse.point_of, minlength=len(some.sparse.xyz)) > 1
    place, there = np.cumsum(often) - 1, often[some.sparse.point_of]
    save_views([replace(view, name=named[view.name].name, source=named[view.name].source) for view in some.views],
               work / "cameras.json")  # fmt: skip
    sparse = {key: getattr(some.sparse, key)[often] for key in ("xyz", "rgb", "error")}
    write_arrays(work / "sparse.npz", {**sparse, "point_of": place[some.sparse.point_of[there]],
                                       "view_of": some.sparse.view_of[there]})  # fmt: skip
    start = f"{(FIRST, SECOND)[number]}/"
    checks = _record(together, "poses")["report"]
    left = [{**one, "photo": one["photo"].removeprefix(start)} for one in checks["left_out"]
            if one["photo"].startswith(start)]  # fmt: skip
    checks = {**checks, "photos": len(photos), "posed": len(views), "points": int(often.sum()), "left_out": left}
    write_json(work / "checks.json", checks)
    return checks


def label_part(own: Project, states: Sequence[Project], scaled: int, work: Path) -> dict:
    """Finds the joint, and takes the photos of the state that shows most of the part, with labels of it and the joint
    in the world of the poses. A unit of that is as long as in the meshes of the `scaled` state."""
    on_progress = own.progress_of("photos")
    one, world = load_state(states[0].folder)
    other, _ = load_state(states[1].folder, world)
    near = CELLS * max(one.cell, other.cell)
    on_progress(0.1, "looking for what has moved")
    try:
        found = find_joint(one.visible, other.visible, seed=own.options.seed, near=near,
                           empty=(one.empty, other.empty), paired=alike(one, other))  # fmt: skip
    except SdfsimError as error:
        raise SdfsimError(f"joint: {error.message}", error.hint, exit_code=EXIT_QUALITY) from error
    shown = [len(np.unique(np.floor(points / near), axis=0)) for points in found.seen]
    number = int(shown[1] >= shown[0])
    best, rest = (one, other)[number], (one, other)[1 - number]
    motion, seen = part_of(found, number == 0)
    on_progress(0.6, "marking what moves in the photos")
    labels = label_images(best, which_move(best.closed, rest, motion, seen))
    source = states[number].place("photos")
    shutil.copytree(source, work, copy_function=_link, ignore=shutil.ignore_patterns(RECORD), dirs_exist_ok=True)
    (work / FOLDER).mkdir()
    for name, image in labels.items():
        Image.fromarray(image).save(work / FOLDER / f"{name}.png")
    write_json(work / FOLDER / NAMES, {"version": 1, "names": [PART]})
    home = motion if number else np.eye(4)
    placed = load_placement(states[scaled].folder / "mesh")
    metres = placed.to_metres.scale * load_field(states[scaled].place("distill")).to_unit.scale
    held = HeldPart(
        found.kind, found.anchor, found.axis, found.travel, home[:3, :3], home[:3, 3], metres / world.scale,
        placed.size_from, placed.size_assumed, found.off, found.doubt, found.follows,
        float(np.linalg.norm(np.ptp(one.visible.vertices, axis=0))),
    )  # fmt: skip
    held.moved(world.inverse()).save(work / JOINT)
    before = _record(states[number], "photos")["report"]
    return {**before, "state": number, "shown": shown}


def take(state: Project, stage: str, work: Path) -> dict:
    """A stage's result as a state has it."""
    place = state.place(stage)
    shutil.copytree(place, work, copy_function=_link, ignore=shutil.ignore_patterns(RECORD), dirs_exist_ok=True)
    return _record(state, stage)["report"]


def _link(source: str | Path, target: str | Path) -> None:
    """A second name of a file, which no stage changes, or a copy where there cannot be one."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
