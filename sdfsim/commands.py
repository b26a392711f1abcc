"""The commands on scenes and motion: simulate, plan, view, render, export, import, identify, info; dataset, train,
evaluate; tradeoff, stress."""

from functools import partial
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

import typer

from sdfsim.base.arguments import Cluster, Model, Out, Outside, command, print_failed
from sdfsim.base.console import Session, columns, duration
from sdfsim.base.errors import EXIT_USAGE, SdfsimError

SceneFile = Annotated[Path, typer.Argument(help="scene.yaml, or a name of `sdfsim samples`.", show_default=False)]
OfRun = Annotated[Path | None, typer.Option(help="scene.yaml of a run (default: that of the run folder).")]
FILMS = {".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm"}
Models = Annotated[
    list[str] | None,
    typer.Option(help="Bundled model or path; repeat it for more (default: those that run on the contact solve)."),
]


@command
def simulate(
    session: Session,
    scene: SceneFile,
    out: Out,
    model: Model = None,
    seconds: Annotated[float | None, typer.Option(help="Simulated time (default: the scene's).", min=0)] = None,
    seed: Annotated[int | None, typer.Option(help="Default: the scene's.", min=0)] = None,
    viewer: Annotated[Literal["none", "file", "native", "web"], typer.Option(help="Where to watch.")] = "file",
    until_settled: Annotated[
        bool, typer.Option("--until-settled", help="End as soon as everything is at rest (at --seconds at the latest).")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the interrupted run in the folder.")] = False,
    beside: Annotated[
        Path | None,
        typer.Option(
            metavar="RECORDING",
            help="A recorded motion of the scene, or FILE[K] of many, to begin the run with and to show beside it.",
        ),
    ] = None,
    allow_outside: Outside = False,
    device: str = "auto",
) -> None:
    """Scene -> motion, in a run folder."""
    from sdfsim.apps import run

    recorded = None
    if beside is not None:
        from sdfsim.apps.observed import load_beside

        shapes = partial(session.stage_progress, "shapes")
        recorded = load_beside(beside, scene, allow_outside=allow_outside, on_progress=shapes)
    more = {"beside": recorded, "on_progress": session.stage_progress, "say": session.say}
    report = run.simulate(scene, **session.given("scene", "beside"), **more)
    median, compiling = report["step_ms_median"], report.get("compiling_s", 0.0)
    lines = [
        f"{report['steps']} steps of {report['dt_s']:.4g} s in {duration(report['wall_s'])}"
        + (f", after {duration(compiling)} of compiling" if compiling >= 1.0 else "")
        + ("" if median is None else f" (median {float(f'{median:.2g}'):g} ms a step)"),
        f"mean contacts {report['contacts_mean']:.1f}, worst penetration {report['worst_penetration_m']:.2g} m",
        *run.ending_lines(report),
        *run.beside_lines(report),
        *([] if report.get("settled", True) else ["not settled: give it more --seconds"]),
        f"wrote {out}",
        *(f"usable, not exact: {line}" for line in report["caveats"]),
    ]
    print_failed(session, report)
    if "recording" in report:
        lines.append(
            "watch it: sdfsim view {}   (or: rerun {})".format(*(quote(str(p)) for p in (out, report["recording"])))
        )
    lines += [f"outside the model's training: {line}" for line in report["outside_training"]]
    lines.append(f"laws: surfaces measured in {report['frames_measured']} of {report['frames']} frames, energy in all")
    lines += [f"breaks a law: {line}" for line in report["broken_laws"]]
    session.report(report, lines)
    if viewer == "web":
        session.hold("the page stays up until Ctrl-C, or until this process is ended")


@command
def play(
    session: Session,
    source: Annotated[
        Path,
        typer.Argument(
            help="scene.yaml, a sample's name, a room, a Shape folder, a mesh, or a robot (.urdf .xml .mjcf).",
            show_default=False,
        ),
    ],
    model: Model = None,
    paused: Annotated[bool, typer.Option("--paused", help="Time stands still at first.")] = False,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of the page (default: 8080, or a free one).")
    ] = None,
    allow_outside: Outside = False,
) -> None:
    """Scene, room, shape, mesh or robot -> a live page: drag, throw, pause, save (docs/viewing.md)."""
    from sdfsim.apps import play as room

    with room.play(**session.given(), on_progress=session.stage_progress) as playing:
        session.report({"page": playing.address}, [f"play at {playing.address}"])
        session.hold("the page stays up until Ctrl-C, or until this process is ended")


@command
def plan(
    session: Session, scene: SceneFile, model: Model = None, allow_outside: Outside = False, device: str = "auto"
) -> None:
    """Which effects are on in a scene, why, and what a step costs."""
    from sdfsim.apps import plan as room

    report = room.describe(scene, **session.given("scene"), on_progress=session.stage_progress)
    for note in report["notes"]:
        session.say(note)
    for check in report["failed_checks"]:  # reported only: a plan is as good with a shape that is less exact
        session.say(f"failed check: {check}")
    session.report(report, room.plan_lines(report))


@command
def samples(
    session: Session,
    out: Annotated[Path | None, typer.Option("-o", "--out", metavar="PATH", help="Copy all of them here.")] = None,
) -> None:
    """List the scenes that come with sdfsim, or copy them to a folder."""
    from sdfsim.scene import bundled

    known = bundled.samples()
    lines = columns(list(known.items()))
    if out is not None:
        lines = [f"wrote {bundled.copy_samples(out)}: {', '.join(known)}"]
    session.report({"samples": known, "folder": out or bundled.sample_folder()}, lines)


@command
def view(
    session: Session,
    recording: Annotated[Path, typer.Argument(help="Run folder, rollout.rrd or rollout.npz.", show_default=False)],
    scene: OfRun = None,
    web: Annotated[bool, typer.Option("--web", help="In the browser.")] = False,
    allow_outside: Outside = False,
) -> None:
    """Watch a recording. A run without one is drawn from its rollout.npz first."""
    from sdfsim.apps import run, viewer

    shapes = partial(session.stage_progress, "shapes")
    recording = run.recorded(recording, scene, say=session.say, allow_outside=allow_outside, on_progress=shapes)
    viewer.show(recording, web=web, say=session.say)
    session.report({"recording": recording})


@command
def render(
    session: Session,
    source: Annotated[Path, typer.Argument(help="Run folder or rollout.npz.", show_default=False)],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help=".mp4 or .png.", show_default=False)],
    scene: OfRun = None,
    camera: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Where the camera is, m (default: all of the motion is in sight)."),
    ] = None,
    look_at: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--look-at", metavar="X Y Z", help="What it looks at, m (default: the middle of the scene)."),
    ] = None,
    at: Annotated[float | None, typer.Option(help="Time of a picture, s (default: the end).")] = None,
    size: Annotated[
        tuple[int, int] | None, typer.Option(metavar="W H", help="Width and height, px (default: 960 540).")
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames of a movie in a second (default: 30).")] = None,
    light: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Direction to the sun (default: above and beside the camera)."),
    ] = None,
    background: Annotated[
        str | None, typer.Option(help="A colour, such as white or #202830; none: transparent, for pictures.")
    ] = None,
    opacity: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=SHARE", help="Make a body translucent, 0 (left out) to 1; repeat it for more."),
    ] = None,
    allow_outside: Outside = False,
) -> None:
    """Run -> movie or picture, without a screen."""
    if at is not None and out.suffix != ".png":
        raise SdfsimError("--at needs a picture, -o FILE.png", exit_code=EXIT_USAGE)
    if fps is not None and out.suffix == ".png":
        raise SdfsimError("--fps needs a movie, -o FILE.mp4", exit_code=EXIT_USAGE)
    from sdfsim.apps import render as room
    from sdfsim.apps.beside import beside_of
    from sdfsim.apps.run import read_run

    room.check_format(out)
    shapes, frames = partial(session.stage_progress, "shapes"), partial(session.stage_progress, "render")
    loaded, rollout = read_run(source, scene, allow_outside=allow_outside, on_progress=shapes)
    beside = beside_of(source, loaded)
    room.render(
        loaded, rollout, out, camera=camera, look_at=look_at, at=at, size=size, light=light, beside=beside,
        fps=room.FRAMES if fps is None else fps, background=background or room.SKY,
        opacity=room.shares(opacity or []), on_progress=frames,
    )  # fmt: skip
    session.report({"picture" if out.suffix == ".png" else "movie": out}, [f"wrote {out}"])


@command
def export(
    session: Session,
    source: Annotated[Path, typer.Argument(help="Run folder, rollout.npz, scene.yaml or Shape folder.")],
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--out", metavar="FILE", help="Ends in .html .glb .usd .usda .usdc .xml .mjcf .urdf or .csv."
        ),
    ],
    scene: OfRun = None,
    fps: Annotated[float | None, typer.Option(help="Frames of the motion in a second (default: every step).")] = None,
    collide: Annotated[
        Literal["pieces", "sdf"], typer.Option(help="How MuJoCo collides meshes; sdf is exact there, and slow.")
    ] = "pieces",
    allow_outside: Outside = False,
) -> None:
    """Shape, scene or run -> a file of other programs (docs/import-and-export.md)."""
    from sdfsim.apps import export as room

    report = room.export(**session.given("scene"), scene_file=scene, on_progress=session.stage_progress)
    files = report["files"]
    lines = [
        f"bodies {report['bodies']}, frames {report['frames']}",
        f"wrote {files[0]}" + (f" and {len(files) - 1} files beside it" if len(files) > 1 else ""),
        *report["notes"],
        *(f"not in it: {line}" for line in report["left_out"]),
    ]
    session.report(report, lines)


@command
def import_(
    session: Session,
    source: Annotated[Path, typer.Argument(metavar="FILE", help="Ends in .urdf, .xml or .mjcf.", show_default=False)],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="FILE", help="The scene.yaml to write.", show_default=False)
    ],
    packages: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of packages that package:// paths name (URDF); repeat it for more."),
    ] = None,
    fixed: Annotated[bool, typer.Option("--fixed", help="The root never moves (URDF).")] = False,
    floor: Annotated[bool, typer.Option("--floor", help="Add a floor at z = 0, and stand everything on it.")] = False,
    key: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="The keyframe to start from (MJCF; default: the one called start)."),
    ] = None,
) -> None:
    """URDF or MJCF -> scene.yaml with joints (docs/import-and-export.md)."""
    from sdfsim.apps import import_robot as room

    given = session.given("packages")
    report = room.import_robot(**given, packages=packages or [], on_progress=session.stage_progress)
    lines = [
        f"links {report['links']}, joints {report['joints']}",
        f"wrote {report['files'][0]}" + (f" and {n} shapes beside it" if (n := len(report["files"]) - 1) else ""),
        *report["notes"],
        *(f"not in it: {line}" for line in report["left_out"]),
    ]
    session.report(report, lines)


@command
def identify(
    session: Session,
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Films of a fixed camera (.mp4 .mov .mkv .avi .webm); or run folders, rollout.npz, CSV or npz files "
            "of poses, or folders of these (docs/identify.md); or contactnets-cube or contactnets-elbow: public ones "
            "with their scene, downloaded once.",
            show_default=False,
        ),
    ],
    scene: OfRun = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="FILE",
            help="Write the scene with the values that were found, and a picture of the fit as FILE.png.",
        ),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(help="Of a film: YAML of points of known places (docs/identify.md).", show_default=False),
    ] = None,
    slow: Annotated[float, typer.Option(help="Of a film: how many times slower it plays than things moved.")] = 1.0,
    start: Annotated[float | None, typer.Option(help="Of a film: where to begin, s.", show_default=False)] = None,
    end: Annotated[float | None, typer.Option(help="Of a film: where to end, s.", show_default=False)] = None,
    body: Annotated[
        list[str] | None,
        typer.Option(
            help="Of a film: a body that moves in it, or a static one that is moved along; repeat it (default: all "
            "that move)."
        ),
    ] = None,
    allow_outside: Outside = False,
) -> None:
    """Films or recorded motions -> friction, restitution, sizes, masses, height and tilt of the ground."""
    from sdfsim.apps.identify.optimiser import identify as identified
    from sdfsim.apps.identify.report import picture, report_lines, write_scene
    from sdfsim.apps.observed import load_recordings
    from sdfsim.base.files import check_writable
    from sdfsim.data.public_tosses import public_tosses

    if out is not None:
        check_writable(out.parent)
        if scene is not None and out.resolve() == scene.resolve():
            raise SdfsimError(f"{out}: would replace the scene that it is made from", "give another file: -o")
    shapes, fit = partial(session.stage_progress, "shapes"), partial(session.stage_progress, "identify")
    if any(path.suffix.lower() in FILMS for path in recordings):
        from sdfsim.apps.film.film import identify_clips
        from sdfsim.scene.load import load_scene

        if scene is None or not all(path.suffix.lower() in FILMS for path in recordings):
            raise SdfsimError("films need their scene, and no other recordings beside them", "--scene scene.yaml")
        known = load_scene(scene, shapes, allow_outside=allow_outside)
        beside = None if out is None else out.with_name("beside.mp4")
        seen = identify_clips(
            recordings, known, points=points, slow=slow, start=start, end=end, bodies=body or [], beside=beside,
            on_progress=fit,
        )  # fmt: skip
        lines, wrote = report_lines(seen), {} if out is None else {"wrote": out, "beside": beside}
        if out is not None:
            lines += [*write_scene(seen, scene, out), f"wrote {out}", f"wrote {beside}: the fit's motion over the film"]
        session.report(seen.report() | wrote, lines)
        return
    for name, given in {"points": points, "start": start, "end": end, "body": body}.items():
        if given is not None:
            raise SdfsimError(f"--{name}: is for films", "leave it out for recordings of poses")
    if slow != 1.0:
        raise SdfsimError(f"--slow {slow:g}: is for films", "divide the times of the recording by it")
    paths = [public_tosses(path, partial(session.stage_progress, "fetch")) for path in recordings]
    public = [path for path, given in zip(paths, recordings, strict=True) if path != given]
    scene = scene or next((path / "scene.yaml" for path in public), None)
    motions, known = load_recordings(paths, scene, allow_outside=allow_outside, on_progress=shapes)
    found = identified(motions, known, profiles=out is not None, on_progress=fit)
    lines, wrote = report_lines(found), {}
    if out is not None and known.path is not None:
        lines += [*write_scene(found, known.path, out), f"wrote {out}"]
        wrote, drawn = {"wrote": out}, out.with_suffix(".png")
        if missing := picture(found, drawn):
            lines.append(f"no {drawn.name}: {missing}")
        else:
            wrote["picture"] = drawn
            lines.append(f"wrote {drawn}: the loss against each parameter")
    session.report(found.report() | wrote, lines)


@command
def info(session: Session) -> None:
    """Versions, devices and bundled models; what is missing here, and how to get it."""
    from sdfsim.apps.about import about, about_lines

    report = about()
    session.report(report, about_lines(report))


@command
def dataset(
    session: Session,
    recipe: Annotated[Literal["movi-b", "movi-c", "varied"], typer.Argument(show_default=False)],
    out: Out,
    trajectories: Annotated[int, typer.Option(help="How many.", min=1, show_default=False)],
    shapes: Annotated[
        Path | None,
        typer.Option(
            help="Folder of meshes (bowl has its own; movi-b: NAME/ folders with convex pieces only), or kubasic or "
            "ycb: public ones, downloaded once."
        ),
    ] = None,
    random_solids: Annotated[
        int, typer.Option(help="Number of PyBullet's random solids to add (not movi-b).", min=0, max=1000)
    ] = 0,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    split: Literal["train", "validation", "test"] = "train",
    cluster: Cluster = None,
) -> None:
    """Simulate training data in PyBullet."""
    from sdfsim.base.parallel import cluster as working_on
    from sdfsim.data.generate import make_dataset, report_lines

    with working_on(cluster):
        report = make_dataset(**session.given("cluster"), on_progress=session.progress)
    session.report(report, report_lines(report))


@command
def train(
    session: Session,
    data: Annotated[
        list[Path],
        typer.Option(help="Dataset folder, or several to train on together.", show_default=False),
    ],
    out: Out,
    preset: Annotated[
        Literal["gnn", "sdf-sim", "sdf-sim-small"],
        typer.Option(help="Kind and size of the model."),
    ] = "gnn",
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the checkpoint in the folder.")] = False,
    device: str = "auto",
) -> None:
    """Train a model on datasets."""
    from sdfsim.training.train import train as run_training

    session.report(run_training(**session.given(), on_progress=session.progress))


@command
def evaluate(
    session: Session,
    data: Annotated[Path, typer.Argument(help="Dataset folder, or one split of it.", show_default=False)],
    model: Model = None,
    steps: Annotated[int, typer.Option(help="Length of each rollout.", min=1)] = 50,
    free_flight: Annotated[
        Literal["exact", "learned"],
        typer.Option(help="How bodies without contact move: exactly, or as the network predicts, as in the papers."),
    ] = "exact",
    chaos_floor: Annotated[
        bool,
        typer.Option(
            "--chaos-floor", help="Also run PyBullet from slightly different starts, as a lower bound of errors."
        ),
    ] = False,
    device: str = "auto",
) -> None:
    """Errors of a model's rollouts on recorded trajectories, and the quality of its motion."""
    from sdfsim.evaluation.evaluate import evaluate as run_evaluation
    from sdfsim.evaluation.evaluate import report_lines

    report = run_evaluation(**session.given(), on_progress=session.progress)
    session.report(report, report_lines(report))


@command
def tradeoff(
    session: Session,
    out: Out,
    source: Annotated[
        Path | None,
        typer.Argument(metavar="SCENE|DATA_DIR", help="scene.yaml or dataset folder (default: a random scene)."),
    ] = None,
    model: Models = None,
    quick: Annotated[bool, typer.Option("--quick", help="A few settings, in minutes.")] = False,
) -> None:
    """What accuracy costs in time: settings, models and engines on the same scenes. -o keeps what was measured."""
    from sdfsim.apps.mujoco_world import MujocoWorld
    from sdfsim.base.lazy import pyplot
    from sdfsim.evaluation import tradeoff as study
    from sdfsim.evaluation.engines import run_world

    pyplot()  # before minutes of work
    meshes = partial(MujocoWorld, collide="sdf")
    report = study.tradeoff(
        source, out, models=model or [], quick=quick, on_progress=session.stage_progress,
        engines={"MuJoCo": partial(run_world, MujocoWorld), "MuJoCo mesh SDF": partial(run_world, meshes)},
    )  # fmt: skip
    rows, notes = study.report_table(report)
    session.report(report, [*columns(rows), *notes])


@command
def stress(
    session: Session,
    out: Out = Path("stress"),
    model: Models = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter cases, in minutes.")] = False,
    shapes: Annotated[
        Path | None,
        typer.Option(help="Folder of more meshes to let rest on the floor; or ycb, which is downloaded once."),
    ] = None,
    device: str = "auto",
) -> None:
    """Hard cases with the solver, PyBullet and the models that you name: a table, plots, and recordings of what
    went wrong."""
    from sdfsim.apps import stress as study
    from sdfsim.base.lazy import pyplot

    pyplot()
    found = study.stress(**session.given("model"), models=model or [], on_progress=session.progress)
    report = study.write_report(found, out)
    print_failed(session, report)
    table = columns(study.rows(found, {"missed": "!", "behind": "<"}))
    notes = ["! beyond what is wanted, < worse than the teacher", *study.loss_lines(found), f"wrote {out}"]
    session.report(report, [*table, *notes])
