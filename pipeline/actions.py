"""What each stage does: the call that turns the results before it into its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pipeline import record
from pipeline.options import Options
from pipeline.report import place_of

Progress = Callable[[str, float, str], None]

# Share of an overall time budget that fitting may take, and what the other stages need after training, s.
FIT_SHARE, AFTER_TRAINING = 0.15, 40.0


@dataclass
class Run:
    """One call: where it works and what it has done so far.

    Attributes:
        folder: of all stages.
        options: as in its config.yaml.
        progress: called with (stage, fraction, message).
        own_budget: s for the one stage that is run; None: it has its share of the budget for everything.
        started: when, on the monotonic clock.
    """

    folder: Path
    options: Options
    progress: Progress | None = None
    own_budget: float | None = None
    started: float = field(default_factory=time.monotonic)

    def tell(self, stage: str) -> Callable[[float, str], None]:
        """The progress callback of one stage."""
        return lambda fraction, message: self.progress(stage, fraction, message) if self.progress else None

    def place(self, stage: str) -> Path:
        """Where a stage's result lies."""
        return place_of(self.folder, stage)

    def device(self) -> str:
        """Where to compute, as torch names it.

        Raises:
            SdfsimError: cuda was asked for and is not there.
        """
        from sdfsim.dynamics.simulator import pick_device

        return str(pick_device(self.options.device))


def do_photos(run: Run, work: Path) -> dict:
    """Photos stage."""
    from pipeline.photos import prepare_photos

    photos, notes = prepare_photos(Path(run.options.photos), work, on_progress=run.tell("photos"))
    return {"count": len(photos), "notes": notes, "masks": sum(p.mask for p in photos)}


def do_poses(run: Run, work: Path) -> dict:
    """Poses stage."""
    from pipeline.photos import load_photos
    from pipeline.poses import solve
    from pipeline.scale import check_places

    folder = run.place("photos")
    photos, known = load_photos(folder), run.options.wishes().distance
    if known is not None:
        check_places(known, photos)  # rather than after minutes of poses and training
    return solve(photos, folder, work, seed=run.options.seed, on_progress=run.tell("poses"))


def do_distill(run: Run, work: Path) -> dict:
    """Distill stage."""
    from pipeline.cameras import load_sparse, load_views
    from pipeline.distill import train
    from pipeline.recipe import PRESETS as RECIPES

    budget = run.own_budget
    if budget is None and run.options.budget is not None:
        spent = time.monotonic() - run.started
        budget = max(20.0, run.options.budget * (1 - FIT_SHARE) - spent - AFTER_TRAINING)
    poses = run.place("poses")
    trained = train(
        load_views(poses), load_sparse(poses), run.place("photos"), work, recipe=RECIPES[run.options.preset],
        budget=budget, seed=run.options.seed, device=run.device(), on_progress=run.tell("distill"),
    )  # fmt: skip
    return trained.report


def do_mesh(run: Run, work: Path) -> dict:
    """Mesh stage."""
    from pipeline.meshing import make_meshes
    from pipeline.sources import find_source

    named = find_source(Path(run.options.photos)).folder
    return make_meshes(
        run.place("distill"), run.place("poses"), run.place("photos"), named, work,
        preset=run.options.preset, wishes=run.options.wishes(), device=run.device(),
        on_progress=run.tell("mesh"),
    )  # fmt: skip


def do_fit(run: Run, work: Path) -> dict:
    """Fit stage."""
    from pipeline.asset import fit_parts
    from sdfsim.parallel import choose_threads, network_work

    choose_threads(network_work, repeat=10)
    budget = run.own_budget
    if budget is None and run.options.budget is not None:
        budget = max(10.0, FIT_SHARE * run.options.budget)
    return fit_parts(
        run.place("mesh"), work, budget=budget, recipe=run.options.fit_recipe(), seed=run.options.seed,
        device=run.device(), on_progress=run.tell("fit"),
    )  # fmt: skip


def do_scene(run: Run, work: Path) -> dict:
    """Scene stage."""
    from pipeline.scene_file import write_scene

    before = record.read(run.place("scene"))
    written = before["report"].get("scene_sha256") if before else None
    return write_scene(
        run.place("mesh"), run.folder / "scene.yaml", shape=run.options.drop, static=run.options.static,
        written=written, seed=run.options.seed,
    )  # fmt: skip


ACTIONS: dict[str, Callable[[Run, Path], dict]] = {
    "photos": do_photos, "poses": do_poses, "distill": do_distill, "mesh": do_mesh, "fit": do_fit, "scene": do_scene,
}  # fmt: skip
