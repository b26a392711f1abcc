"""The command line: arguments -> one call -> report. Heavy imports happen inside the commands."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from sdfsim.errors import EXIT_ERROR, EXIT_QUALITY
from sdfsim.progress import Session, duration

app = typer.Typer(
    name="sdfsim",
    help="Rigid-body simulation over learned signed-distance functions, from photos to motion.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _seconds(text: str) -> float:
    """`90s`, `10m`, `1h` or plain seconds."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh]?)", text.strip())
    if not match or float(match[1]) == 0:
        raise typer.BadParameter(f"{text!r} is not a length of time: write it as 90s, 10m or 1h")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]


Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout, everything else on stderr.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Tracebacks with errors.")]
Device = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Where to compute.")]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder to write.", show_default=False)]
Model = Annotated[str | None, typer.Option(help="Bundled model or path (default: the scene's, else the best one).")]
Preset = Annotated[Literal["quick", "standard", "fine"], typer.Option(help="How much time to spend.")]
KeptPreset = Annotated[Literal["quick", "standard", "fine"] | None, typer.Option(help="Default: as before.")]
Stage = Literal["photos", "poses", "distill", "mesh", "fit", "scene"]
Size = Annotated[float | None, typer.Option(help="Widest side of the scene, metres.", min=0.0)]
Budget = Annotated[
    float | None, typer.Option(parser=_seconds, metavar="TIME", help="Longest time to take, such as 90s, 10m or 1h.")
]
Cluster = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Scheduler of a Dask cluster to work on, tcp://HOST:8786.")
]


@app.command()
def reconstruct(
    photos: Annotated[Path, typer.Argument(help="Folder of photos.", show_default=False)],
    out: Out,
    preset: Preset = "standard",
    first: Annotated[Stage | None, typer.Option("--from", help="Do this stage and those after it again.")] = None,
    last: Annotated[Stage | None, typer.Option("--until", help="Stop after this stage.")] = None,
    size: Size = None,
    budget: Budget = None,
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Photos -> a scene that can be simulated, by all stages."""
    with Session(as_json=as_json, verbose=verbose) as session:
        from pipeline import stages

        report = stages.reconstruct(
            photos,
            out,
            preset=preset,
            size=size,
            budget=budget,
            from_stage=first,
            until_stage=last,
            device=device,
            progress=session.stage_progress,
        )
        _report_stages(session, report, out)


@app.command()
def poses(
    photos: Annotated[Path, typer.Argument(help="Folder of photos.", show_default=False)],
    out: Out,
    preset: Preset = "standard",
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Photos -> camera poses and sparse points."""
    with Session(as_json=as_json, verbose=verbose) as session:
        from pipeline import stages

        report = stages.reconstruct(
            photos, out, preset=preset, until_stage="poses", device=device, progress=session.stage_progress
        )
        _report_stages(session, report, out)


@app.command()
def distill(
    folder: Annotated[Path, typer.Argument(help="Folder that poses has written.", show_default=False)],
    preset: KeptPreset = None,
    budget: Budget = None,
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Posed photos -> a signed-distance and colour field."""
    _stage("distill", folder, as_json, verbose, preset=preset, budget=budget, device=device)


@app.command()
def mesh(
    folder: Annotated[Path, typer.Argument(help="Folder that distill has written.", show_default=False)],
    preset: KeptPreset = None,
    size: Size = None,
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Field -> cleaned, upright mesh."""
    _stage("mesh", folder, as_json, verbose, preset=preset, size=size, device=device)


@app.command()
def fit(
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
        Literal["default", "paper"] | None,
        typer.Option(help="How networks are fitted (a reconstruction: as before).", show_default=False),
    ] = None,
    budget: Budget = None,
    cap: Annotated[bool, typer.Option("--cap", help="Close openings of any size (with -o).")] = False,
    thicken: Annotated[
        float | None, typer.Option(help="Thickness to give an open sheet, metres (with -o).", min=0.0)
    ] = None,
    cluster: Cluster = None,
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Mesh -> compact SDF network, its errors certified.

    Several meshes, or a folder, with -o DIR: a shape folder DIR/NAME each; what is there already is kept. A folder
    that `mesh` has written, without -o: its shape and scene.yaml.
    """
    if out is None:
        if len(sources) > 1 or not sources[0].is_dir():
            raise typer.BadParameter("a mesh file needs -o SHAPE_DIR")
        if cap or thicken is not None or cluster is not None:
            raise typer.BadParameter("--cap, --thicken and --cluster go with -o")
        _stage("fit", sources[0], as_json, verbose, then="scene", budget=budget, recipe=recipe, device=device)
        return
    with Session(as_json=as_json, verbose=verbose) as session:
        from sdfsim import fitting
        from sdfsim.parallel import cluster as working_on

        options = fitting.Options(recipe or "default", budget, cap, thicken)
        if len(sources) == 1 and not sources[0].is_dir():
            report = fitting.fit(sources[0], out, options, device=device, on_progress=session.progress)
            lines = fitting.fit_lines(report)
        else:
            meshes = fitting.named_meshes(sources)
            with working_on(cluster):
                report = fitting.fit_many(meshes, out, options, device=device, on_progress=session.progress)
            lines = fitting.batch_lines(report)
        _tell_failed(session, report)
        if any("error" in shape for shape in report.get("shapes", {}).values()):
            session.exit_code = EXIT_ERROR
        session.report(report, lines)


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(help="scene.yaml", show_default=False)],
    out: Out,
    model: Model = None,
    seconds: Annotated[float | None, typer.Option(help="Simulated time (default: the scene's).")] = None,
    seed: Annotated[int | None, typer.Option(help="Default: the scene's.", min=0)] = None,
    viewer: Annotated[Literal["none", "file", "native", "web"], typer.Option(help="Where to watch.")] = "file",
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Scene -> motion, in a run folder."""
    if seconds is not None and not (0 < seconds < float("inf")):
        raise typer.BadParameter("--seconds must be > 0")
    with Session(as_json=as_json, verbose=verbose) as session:
        from sdfsim import run

        report = run.simulate(
            scene,
            out,
            model=model,
            seconds=seconds,
            seed=seed,
            viewer=viewer,
            device=device,
            on_progress=session.stage_progress,
            on_address=lambda address: session.say(f"watch it at {address}"),
        )
        lines = [
            f"{report['steps']} steps of {report['dt_s']:.4g} s in {duration(report['wall_s'])}"
            f" (median {report['step_ms_median']:.1f} ms a step)",
            f"mean contacts {report['contacts_mean']:.1f}, worst penetration {report['worst_penetration_m']:.2g} m",
            *run.cost_lines(report),
            f"wrote {out}",
            *(f"outside the model's training: {line}" for line in report["outside_training"]),
        ]
        _tell_failed(session, report)
        if viewer != "none":
            lines.append(f"watch it: sdfsim view {report['recording']}   (or: rerun {report['recording']})")
        session.report(report, lines)
        if viewer == "web":
            session.hold("the page stays up until Ctrl-C")


@app.command()
def plan(
    scene: Annotated[Path, typer.Argument(help="scene.yaml", show_default=False)],
    model: Model = None,
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Which effects are in play, why, and what a step costs."""
    with Session(as_json=as_json, verbose=verbose) as session:
        from sdfsim import planning

        report = planning.describe(scene, model=model, device=device, on_progress=session.stage_progress)
        for check in report["failed_checks"]:  # told, but a plan is as good with a shape that is less exact
            session.say(f"failed check: {check}")
        session.report(report, planning.plan_lines(report))


@app.command()
def view(
    recording: Annotated[Path, typer.Argument(help="rollout.rrd", show_default=False)],
    web: Annotated[bool, typer.Option("--web", help="In the browser.")] = False,
    picture: Annotated[Path | None, typer.Option("--screenshot", help="Write a PNG instead; needs no screen.")] = None,
    at: Annotated[float | None, typer.Option(help="Time of the screenshot, s (default: the end).")] = None,
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Watch a recording, or take a picture of it."""
    if at is not None and picture is None:
        raise typer.BadParameter("--at goes with --screenshot")
    with Session(as_json=as_json, verbose=verbose) as session:
        from sdfsim import viewer

        if picture is not None:
            viewer.screenshot(recording, picture, at=at)
            session.report({"screenshot": str(picture)})
        else:
            viewer.show(recording, web=web)
            session.report({"recording": str(recording)})


@app.command()
def dataset(
    recipe: Annotated[Literal["movi-b", "movi-c", "bowl", "pile", "varied"], typer.Argument(show_default=False)],
    out: Out,
    trajectories: Annotated[int, typer.Option(help="How many.", min=1, show_default=False)],
    shapes: Annotated[
        Path | None,
        typer.Option(help="Folder of meshes (bowl has its own; movi-b: NAME/ folders with convex pieces only)."),
    ] = None,
    random_solids: Annotated[
        int, typer.Option(help="So many of PyBullet's random solids beside them (not movi-b).", min=0, max=1000)
    ] = 0,
    bodies: Annotated[int | None, typer.Option(help="How many move (bowl, pile).", min=1, max=512)] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    split: Literal["train", "validation", "test"] = "train",
    cluster: Cluster = None,
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Trajectories of the teacher (PyBullet) to learn from."""
    with Session(as_json=as_json, verbose=verbose) as session:
        from sdfsim.learning.generate import make_dataset, report_lines
        from sdfsim.parallel import cluster as working_on

        with working_on(cluster):
            report = make_dataset(
                recipe,
                out,
                trajectories=trajectories,
                shapes=shapes,
                random_solids=random_solids,
                bodies=bodies,
                seed=seed,
                split=split,
                on_progress=session.progress,
            )
        session.report(report, report_lines(report))


@app.command()
def train(
    data: Annotated[Path, typer.Option(help="Dataset folder.", show_default=False)],
    out: Out,
    preset: Annotated[Literal["small", "base", "paper"], typer.Option(help="Kind and size of the model.")] = "small",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in the folder.")] = False,
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Train a model on a dataset."""
    with Session(as_json=as_json, verbose=verbose) as session:
        from sdfsim.learning.train import train as run_training

        session.report(
            run_training(data, out, preset=preset, resume=resume, device=device, on_progress=session.progress)
        )


@app.command()
def evaluate(
    data: Annotated[Path, typer.Argument(help="Dataset folder, or one split of it.", show_default=False)],
    model: Model = None,
    steps: Annotated[int, typer.Option(help="Length of each rollout.", min=1)] = 50,
    free_flight: Annotated[
        Literal["exact", "learned"], typer.Option(help="Bodies without contact (learned: paper networks only).")
    ] = "exact",
    chaos_floor: Annotated[
        bool,
        typer.Option("--chaos-floor", help="Also the teacher again from starts slightly off (needs PyBullet)."),
    ] = False,
    as_json: Json = False,
    device: Device = "auto",
    verbose: Verbose = False,
) -> None:
    """Errors of a model's rollouts on recorded trajectories, and the quality of its motion."""
    with Session(as_json=as_json, verbose=verbose) as session:
        from sdfsim import run
        from sdfsim.learning.evaluate import evaluate as run_evaluation

        report = run_evaluation(
            data,
            model=model,
            steps=steps,
            device=device,
            free_flight=free_flight,
            chaos_floor=chaos_floor,
            on_progress=session.progress,
        )
        session.report(report, run.evaluation_lines(report))


@app.command()
def info(as_json: Json = False, device: Device = "auto", verbose: Verbose = False) -> None:
    """Versions, devices and bundled models."""
    with Session(as_json=as_json, verbose=verbose) as session:
        from sdfsim import run

        session.report(run.environment())


def _stage(name: str, folder: Path, as_json: bool, verbose: bool, *, then: Stage | None = None, **options: Any) -> None:
    """Run one stage, and `then` another that costs next to nothing."""
    with Session(as_json=as_json, verbose=verbose) as session:
        from pipeline import stages

        report = stages.run_stage(name, folder, progress=session.stage_progress, **options)
        if then is not None:
            report = stages.run_stage(then, folder, progress=session.stage_progress)
        _report_stages(session, report, folder)


def _report_stages(session: Session, report: dict, folder: Path) -> None:
    from pipeline import recording

    if made := recording.record(folder):
        report["paths"]["recording"] = str(made)
    lines = [f"{stage:<8} {duration(seconds)}" for stage, seconds in report["seconds"].items()]
    lines += [f"{what}: {path}" for what, path in report["paths"].items()]
    if "recording" in report["paths"]:
        lines.append(f"look at it: sdfsim view {report['paths']['recording']}")
    if "scene" in report["paths"]:
        lines.append(f"next: sdfsim simulate {report['paths']['scene']} -o RUN")
    for note in report.get("notes", []):
        session.say(note)
    _tell_failed(session, report)
    session.report(report, lines)


def _tell_failed(session: Session, report: dict) -> None:
    for check in report["failed_checks"]:
        session.exit_code = EXIT_QUALITY
        session.say(f"failed check: {check}")
