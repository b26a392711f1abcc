"""From trajectories to models: dataset, train, evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from sdfsim.commands.arguments import Cluster, Model, Out, command
from sdfsim.console import Session


@command
def dataset(
    session: Session,
    recipe: Annotated[Literal["movi-b", "movi-c", "bowl", "pile", "varied"], typer.Argument(show_default=False)],
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
        int, typer.Option(help="So many of PyBullet's random solids beside them (not movi-b).", min=0, max=1000)
    ] = 0,
    bodies: Annotated[int | None, typer.Option(help="How many move (bowl, pile).", min=1, max=512)] = None,
    fps: Annotated[Literal["50", "60"], typer.Option(help="Recorded frames a second.")] = "50",
    seed: Annotated[int, typer.Option(min=0)] = 0,
    split: Literal["train", "validation", "test"] = "train",
    cluster: Cluster = None,
) -> None:
    """Trajectories of the teacher (PyBullet) to learn from."""
    from sdfsim.data.generate import make_dataset, report_lines
    from sdfsim.parallel import cluster as working_on

    with working_on(cluster):
        report = make_dataset(
            recipe,
            out,
            trajectories=trajectories,
            shapes=shapes,
            random_solids=random_solids,
            bodies=bodies,
            fps=int(fps),
            seed=seed,
            split=split,
            on_progress=session.progress,
        )
    session.report(report, report_lines(report))


@command
def train(
    session: Session,
    data: Annotated[
        list[Path], typer.Option(help="Dataset folder; several are trained on together.", show_default=False)
    ],
    out: Out,
    preset: Annotated[
        Literal["small", "long", "alone", "base", "paper", "fignet", "fignet-star", "mgn", "mgn-large", "dpi"],
        typer.Option(help="Kind and size of the model."),
    ] = "small",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in the folder.")] = False,
    device: str = "auto",
) -> None:
    """Train a model on datasets."""
    from sdfsim.training.train import train as run_training

    session.report(run_training(data, out, preset=preset, resume=resume, device=device, on_progress=session.progress))


@command
def evaluate(
    session: Session,
    data: Annotated[Path, typer.Argument(help="Dataset folder, or one split of it.", show_default=False)],
    model: Model = None,
    steps: Annotated[int, typer.Option(help="Length of each rollout.", min=1)] = 50,
    free_flight: Annotated[
        Literal["exact", "learned"], typer.Option(help="Bodies without contact (learned: of published networks).")
    ] = "exact",
    chaos_floor: Annotated[
        bool,
        typer.Option("--chaos-floor", help="Also the teacher again from starts slightly off (needs PyBullet)."),
    ] = False,
    device: str = "auto",
) -> None:
    """Errors of a model's rollouts on recorded trajectories, and the quality of its motion."""
    from sdfsim.evaluation.evaluate import evaluate as run_evaluation
    from sdfsim.evaluation.evaluate import report_lines

    report = run_evaluation(
        data,
        model=model,
        steps=steps,
        device=device,
        free_flight=free_flight,
        chaos_floor=chaos_floor,
        on_progress=session.progress,
    )
    session.report(report, report_lines(report))
