"""From photos and meshes to shapes: reconstruct, its stages, and fit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from sdfsim.base.arguments import Budget, Cluster, Out, command, tell_failed
from sdfsim.base.console import Session, duration
from sdfsim.base.errors import EXIT_ERROR, EXIT_USAGE, SdfsimError

Presets = Literal["quick", "standard", "fine", "volsdf"]
Preset = Annotated[
    Presets, typer.Option(help="How much time to spend; volsdf is the network of the paper of that name, for a GPU.")
]
Photos = Annotated[
    Path,
    typer.Argument(
        help="Folder of photos, a video, a transforms.json, a COLMAP model, or a phone's capture.", show_default=False
    ),
]
KeptPreset = Annotated[Presets | None, typer.Option(help="Default: as before.")]
Stage = Literal["photos", "poses", "distill", "mesh", "fit", "scene"]
Size = Annotated[float | None, typer.Option(help="Widest side of the scene, metres.", min=0.0)]
Distance = Annotated[
    tuple[str, str, float] | None,
    typer.Option(
        metavar="PLACE PLACE METRES",
        help="A distance that you know. A place is PHOTO:X,Y, what that pixel shows, or PHOTO, the camera itself.",
        show_default=False,
    ),
]
Crop = Annotated[
    tuple[str, str] | None,
    typer.Option(
        metavar="X,Y,Z X,Y,Z", help="Corners of the box to keep, metres, the lower one first.", show_default=False
    ),
]
Materials = Annotated[
    list[str] | None,
    typer.Option(
        "--material",
        metavar="BODY=MATERIAL",
        help="What a body is made of: object1=wood, or object1=ceramic:4mm where it is hollow. Can be repeated.",
        show_default=False,
    ),
]
DropShape = Annotated[Literal["box", "ball", "none"], typer.Option("--drop", help="What falls onto the scene.")]


@command
def reconstruct(
    session: Session,
    photos: Photos,
    out: Out,
    preset: Preset = "standard",
    first: Annotated[Stage | None, typer.Option("--from", help="Do this stage and those after it again.")] = None,
    last: Annotated[Stage | None, typer.Option("--until", help="Stop after this stage.")] = None,
    size: Size = None,
    distance: Distance = None,
    crop: Crop = None,
    drop: DropShape = "box",
    material: Materials = None,
    budget: Budget = None,
    device: str = "auto",
) -> None:
    """Photos -> a scene that can be simulated, by all stages."""
    corners, materials = _corners(crop), _by_body(material or [])
    from pipeline import stages

    report = stages.reconstruct(
        photos, out, preset=preset, size=size, distance=list(distance) if distance else None, crop=corners, drop=drop,
        material=materials, budget=budget, from_stage=first, until_stage=last, device=device,
        progress=session.stage_progress,
    )  # fmt: skip
    _report_stages(session, report, out)


@command
def poses(session: Session, photos: Photos, out: Out, preset: KeptPreset = None, device: str = "auto") -> None:
    """Photos -> camera poses and sparse points."""
    from pipeline import stages

    report = stages.find_poses(photos, out, preset=preset, device=device, progress=session.stage_progress)
    _report_stages(session, report, out)


@command
def distill(
    session: Session,
    folder: Annotated[Path, typer.Argument(help="Folder that poses has written.", show_default=False)],
    preset: KeptPreset = None,
    budget: Budget = None,
    device: str = "auto",
) -> None:
    """Posed photos -> a signed-distance and colour field."""
    _stage(session, "distill", folder, preset=preset, budget=budget, device=device)


@command
def mesh(
    session: Session,
    folder: Annotated[Path, typer.Argument(help="Folder that distill has written.", show_default=False)],
    preset: KeptPreset = None,
    size: Size = None,
    distance: Distance = None,
    crop: Crop = None,
    device: str = "auto",
) -> None:
    """Field -> upright meshes of the scenery and of the bodies that stand on it."""
    known = list(distance) if distance else None
    _stage(session, "mesh", folder, preset=preset, size=size, distance=known, crop=_corners(crop), device=device)


def _corners(crop: tuple[str, str] | None) -> list[float] | None:
    """Six numbers from two corners x,y,z."""
    if crop is None:
        return None
    try:
        corners = [[float(part) for part in corner.split(",")] for corner in crop]
    except ValueError:
        corners = []
    if [len(corner) for corner in corners] != [3, 3]:
        raise SdfsimError(f"--crop takes two corners X,Y,Z in metres (got {' '.join(crop)})", exit_code=EXIT_USAGE)
    return corners[0] + corners[1]


def _by_body(materials: list[str]) -> dict[str, str]:
    """Materials by the body's name, from texts BODY=MATERIAL."""
    found: dict[str, str] = {}
    for text in materials:
        body, _, material = text.partition("=")
        if not body or not material or body in found:
            told = f"--material takes BODY=MATERIAL once for a body, such as object1=wood (got {text})"
            raise SdfsimError(told, exit_code=EXIT_USAGE)
        found[body] = material
    return found


@command
def fit(
    session: Session,
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...", help="Mesh files, folders of them, or a folder of mesh.", show_default=False
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Shape folder of one mesh file; of several, a folder of them.")
    ] = None,
    recipe: Annotated[
        Literal["quick", "default", "paper"] | None,
        typer.Option(
            help="How networks are fitted; paper: as Rubanova et al. did (a reconstruction: as its preset says).",
            show_default=False,
        ),
    ] = None,
    budget: Budget = None,
    cap: Annotated[bool, typer.Option("--cap", help="Close openings of any size (with -o).")] = False,
    thicken: Annotated[
        float | None, typer.Option(help="Thickness to give an open sheet, metres (with -o).", min=0.0)
    ] = None,
    units: Annotated[
        Literal["m", "cm", "mm", "in"] | None,
        typer.Option(help="Of the mesh files (with -o): metres, if not said.", show_default=False),
    ] = None,
    cluster: Cluster = None,
    device: str = "auto",
) -> None:
    """Mesh -> compact SDF network, its errors certified.

    Several meshes, or a folder, with -o DIR: a shape folder DIR/NAME each; what is there already is kept. A folder
    that `mesh` has written, without -o: its shape and scene.yaml.
    """
    if out is None:
        if len(sources) > 1 or not sources[0].is_dir():
            raise SdfsimError("a mesh file needs -o SHAPE_DIR", exit_code=EXIT_USAGE)
        if cap or thicken is not None or units is not None or cluster is not None:
            raise SdfsimError("--cap, --thicken, --units and --cluster go with -o", exit_code=EXIT_USAGE)
        _stage(session, "fit", sources[0], then="scene", budget=budget, recipe=recipe, device=device)
        return
    from sdfsim.apps import fit as room
    from sdfsim.base.parallel import cluster as working_on

    options = room.Options(recipe or "default", budget, cap, thicken, units)
    if len(sources) == 1 and not sources[0].is_dir():
        report = room.fit(sources[0], out, options, device=device, on_progress=session.progress)
    else:
        meshes = room.named_meshes(sources)
        with working_on(cluster):
            report = room.fit_many(meshes, out, options, device=device, on_progress=session.progress)
    tell_failed(session, report)
    if any("error" in shape for shape in report.get("shapes", {}).values()):
        session.exit_code = EXIT_ERROR
    session.report(report, room.fit_lines(report))


def _stage(session: Session, name: str, folder: Path, *, then: Stage | None = None, **options: Any) -> None:
    """Run one stage, and `then` another that costs next to nothing."""
    from pipeline import stages

    report = stages.run_stage(name, folder, progress=session.stage_progress, **options)
    if then is not None:
        report = stages.run_stage(then, folder, progress=session.stage_progress)
    _report_stages(session, report, folder)


def _report_stages(session: Session, report: dict, folder: Path) -> None:
    from pipeline import report as reports
    from pipeline import stages

    if made := reports.write_recording(folder, stages.current(folder)):
        report["paths"]["recording"] = str(made)
    lines = [f"{stage:<8} {duration(seconds)}" for stage, seconds in report["seconds"].items()]
    lines += [f"{what}: {path}" for what, path in report["paths"].items()]
    if "recording" in report["paths"]:
        lines.append(f"look at it: sdfsim view {report['paths']['recording']}")
    if "scene" in report["paths"]:
        lines.append(f"next: sdfsim simulate {report['paths']['scene']} -o RUN")
    for note in report.get("notes", []):
        session.say(note)
    tell_failed(session, report)
    session.report(report, lines)
