"""The commands that start from photos or meshes: reconstruct, its stages, measure, joint, and fit."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

import typer
from pydantic_core import PydanticUndefined

from pipeline.options import Options, form_of
from sdfsim.base.arguments import Budget, Cluster, Out, command, print_failed
from sdfsim.base.console import Session, duration
from sdfsim.base.errors import EXIT_ERROR, EXIT_USAGE, SdfsimError

Photos = Annotated[
    Path,
    typer.Argument(
        help="Folder of photos, a video, a transforms.json, a COLMAP model, or a phone's capture.", show_default=False
    ),
]
Stage = Literal["photos", "poses", "distill", "mesh", "fit", "scene"]


def options(*names: str, kept: bool = False) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command these options of `Options` as keywords, None if they are not given; the command must accept
    `**options`. If they are `kept`, options that are not given keep the values in the folder."""

    def added(work: Callable[..., None]) -> Callable[..., None]:
        parameters = [*inspect.signature(work, eval_str=True).parameters.values()][:-1]
        for name in names:
            field, form = Options.model_fields[name], form_of(name)
            default = None if kept or field.default is PydanticUndefined else field.default
            kind = form["kind"] or (field.annotation if default is not None else Optional[field.annotation])  # noqa: UP045
            flag: Any = typer.Option(help=field.description, metavar=form["metavar"], show_default=default is not None)
            parameters.append(
                inspect.Parameter(
                    name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, flag]
                )
            )
        made: Any = work
        made.__signature__ = inspect.Signature(parameters)
        made.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return made

    return added


@command
@options("preset", "size", "distance", "up", "crop", "body", "drop", "material", "mass", "sdf")
def reconstruct(
    session: Session,
    photos: Photos,
    out: Out,
    other: Annotated[
        Path | None, typer.Argument(help="With --joint: photos of the object in its other state.", show_default=False)
    ] = None,
    joint: Annotated[
        bool, typer.Option("--joint", help="Find the hinge or slider of the part that moves between both states.")
    ] = False,
    first: Annotated[Stage | None, typer.Option("--from", help="Run this stage and the later ones again.")] = None,
    last: Annotated[Stage | None, typer.Option("--until", help="Stop after this stage.")] = None,
    budget: Budget = None,
    device: str = "auto",
    **options: Any,
) -> None:
    """Photos -> a scene that can be simulated. Runs all stages.

    With --joint, photos of one object in two states (door shut and open) -> a scene in which the door turns.
    """
    if joint != (other is not None):
        message = (
            "--joint takes two folders of photos, one for each state" if joint else f"{other}: one folder too many"
        )
        hint = "sdfsim reconstruct SHUT OPEN --joint -o DIR"
        raise SdfsimError(message, hint, exit_code=EXIT_USAGE)
    common = {**_given(options), "budget": budget, "device": device, "from_stage": first, "until_stage": last,
              "progress": session.stage_progress}  # fmt: skip
    if other is not None:
        from pipeline import states

        report, out = states.reconstruct_states(photos, other, out, **common)
    else:
        from pipeline import stages

        report = stages.reconstruct(photos, out, **common)
    _report_stages(session, report, out)


@command
def measure(
    session: Session,
    photos: Photos,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="The page to write.")] = Path("measure.html"),
) -> None:
    """Photos or a film -> a page in which clicks give --distance, --body, and points for identify."""
    from pipeline.measure import measure as write_page

    report = write_page(photos, out, on_progress=session.progress)
    told = f"wrote {out}: {report['photos']} photos, {report['mib']} MiB"
    session.report(report, [told, "open it in a browser: clicks give --distance, --body, and identify --points"])


@command
def joint(
    session: Session,
    one: Annotated[Path, typer.Argument(help="Mesh of the object in one state.", show_default=False)],
    other: Annotated[
        Path, typer.Argument(help="Mesh of the other state, in the same frame and scale.", show_default=False)
    ],
) -> None:
    """Meshes of one object in two states -> its hinge or slider."""
    from pipeline.mesh.joint import find_joint, scene_keys
    from sdfsim.geometry.mesh_io import load_mesh

    found = find_joint(load_mesh(one), load_mesh(other))
    told = {"type": found.kind, **scene_keys(found), "moving_faces": int(found.moving.sum()), "off_m": found.off}
    session.report(told, [found.line()])


@command
@options("preset", kept=True)
def poses(session: Session, photos: Photos, out: Out, device: str = "auto", **options: Any) -> None:
    """Photos -> camera poses and sparse points."""
    from pipeline import stages

    report = stages.find_poses(photos, out, **_given(options), device=device, progress=session.stage_progress)
    _report_stages(session, report, out)


@command
@options("preset", kept=True)
def distill(
    session: Session,
    folder: Annotated[Path, typer.Argument(help="Folder that poses has written.", show_default=False)],
    budget: Budget = None,
    device: str = "auto",
    **options: Any,
) -> None:
    """Posed photos -> a signed-distance and colour field."""
    _run_stage(session, "distill", folder, budget=budget, device=device, **options)


@command
@options("preset", "size", "distance", "up", "crop", "body", kept=True)
def mesh(
    session: Session,
    folder: Annotated[Path, typer.Argument(help="Folder that distill has written.", show_default=False)],
    device: str = "auto",
    **options: Any,
) -> None:
    """Field -> upright meshes of the scenery and of the bodies that stand on it."""
    _run_stage(session, "mesh", folder, device=device, **options)


def _given(options: dict[str, Any]) -> dict[str, Any]:
    """The options that were given."""
    return {name: value for name, value in options.items() if value is not None}


@command
@options("recipe", "sdf", kept=True)
def fit(
    session: Session,
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...", help="Mesh files, folders of them, or a folder of mesh.", show_default=False
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Shape folder for one mesh file; for several, a folder for them.")
    ] = None,
    budget: Budget = None,
    cap: Annotated[bool, typer.Option("--cap", help="Close openings of any size (with -o).")] = False,
    thicken: Annotated[
        float | None, typer.Option(help="Thickness to give an open sheet, metres (with -o).", min=0.0)
    ] = None,
    units: Annotated[
        Literal["m", "cm", "mm", "in"] | None,
        typer.Option(help="Unit of the mesh files (with -o); metres by default.", show_default=False),
    ] = None,
    cluster: Cluster = None,
    device: str = "auto",
    **options: Any,
) -> None:
    """Mesh -> compact SDF network with certified errors.

    Several meshes, or a folder, with -o DIR: a shape folder DIR/NAME for each; existing ones are kept. A folder that
    `mesh` has written, without -o: its shapes and scene.yaml.
    """
    if out is None:
        if len(sources) > 1 or not sources[0].is_dir():
            raise SdfsimError("a mesh file needs -o SHAPE_DIR", exit_code=EXIT_USAGE)
        if cap or thicken is not None or units is not None or cluster is not None:
            raise SdfsimError("--cap, --thicken, --units and --cluster need -o", exit_code=EXIT_USAGE)
        _run_stage(session, "fit", sources[0], then="scene", budget=budget, device=device, **options)
        return
    if options["sdf"] == "grid":
        message = "--sdf grid cannot be combined with -o: a scene samples a mesh file itself (mesh: FILE, sdf: grid)"
        raise SdfsimError(message, exit_code=EXIT_USAGE)
    from sdfsim.apps import fit as fitting
    from sdfsim.base.parallel import cluster as working_on

    with working_on(cluster):
        report = fitting.fit(
            sources, out, recipe=options["recipe"] or "default", budget=budget, cap=cap, thicken=thicken, units=units,
            device=device, on_progress=session.progress,
        )  # fmt: skip
    print_failed(session, report)
    if any("error" in shape for shape in report.get("shapes", {}).values()):
        session.exit_code = EXIT_ERROR
    session.report(report, fitting.fit_lines(report))


def _run_stage(session: Session, name: str, folder: Path, *, then: Stage | None = None, **options: Any) -> None:
    """Runs one stage, and `then` another one that takes almost no time."""
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
    print_failed(session, report)
    session.report(report, lines)
