"""What training looks like while it goes on: the mesh so far and the PSNR, as a rerun recording that grows."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from pipeline.field.held_out import HeldOut
from pipeline.field.training import Trainer
from pipeline.mesh.extraction import Volume
from sdfsim.errors import SdfsimError

NAME = "training.rrd"
EVERY = 0.05  # of the training
SHARE = 0.04  # of the time that snapshots may take


class Snapshots:
    """A recording of one run; one that goes on after a kill begins anew.

    Args:
        out: folder of the stage.
        trainer: to look at.
        held: held-out views, or None where there are too few photos; the first that shows anything is rendered.
    """

    def __init__(self, out: Path, trainer: Trainer, held: HeldOut | None) -> None:
        import rerun as rr

        self.trainer, self.held = trainer, held
        self.stream = rr.RecordingStream("sdfsim-training")
        self.stream.save(str(out / NAME))
        self.curve: list[dict] = []
        self.spent, self.started, self.next = 0.0, time.monotonic(), trainer.fraction + EVERY

    def take(self, losses: dict[str, float]) -> None:
        """Records the state of training, where it is time to.

        Args:
            losses: smoothed.
        """
        now = time.monotonic()
        if self.trainer.fraction < self.next or self.spent > SHARE * (now - self.started):
            return
        self.next = self.trainer.fraction + EVERY
        import rerun as rr

        trainer = self.trainer
        trainer.show()
        self.stream.set_time("step", sequence=trainer.iteration)
        for name, value in losses.items():
            self.stream.log(f"loss/{name}", rr.Scalars(value))
        entry = {"step": trainer.iteration, "seconds": round(trainer.seconds, 1)}
        if self.held is not None and self.held.shown:
            seen = self.held.compare(self.held.shown[0])
            self.stream.log("held_out/psnr", rr.Scalars(seen.psnr))
            self.stream.log("held_out/render", rr.Image(seen.picture))
            entry["psnr"] = round(seen.psnr, 2)
        self._mesh(rr)
        self.curve.append(entry)
        self.spent += time.monotonic() - now

    def _mesh(self, rr) -> None:
        """The surface on the cached grid, in normalised space."""
        assert self.trainer.cache is not None
        values = self.trainer.cache[..., 0].permute(2, 1, 0).cpu().numpy()
        try:
            mesh = Volume(values, -np.ones(3), 2 / (len(values) - 1)).mesh()
        except SdfsimError:
            return  # No surface yet.
        self.stream.log("surface", rr.Mesh3D(vertex_positions=mesh.vertices, triangle_indices=mesh.faces))
