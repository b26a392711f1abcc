"""`save_run`: what somebody's own steps did, as a run folder like that of `simulate`."""

from pathlib import Path

from sdfsim.apps.play import saved
from sdfsim.base.errors import SdfsimError
from sdfsim.physics.rollout import Rollout
from sdfsim.simulate.record import Recording, at_frame
from sdfsim.simulate.simulator import Simulator


def save_run(simulator: Simulator, run: Recording | Rollout, folder: Path | str) -> Path:
    """Write a recording of a simulator as a run folder, which `view`, `render`, `export` and `identify` read: its
    motion, with joints, efforts and forces, and its scene as it was in the first frame. Returns the folder. Raises
    SdfsimError if the recording has no step or is of other bodies, or if the folder holds other results."""
    rollout = run.rollout if isinstance(run, Recording) else run
    if rollout.names != tuple(body.name for body in simulator.scene.bodies):
        raise SdfsimError(
            "run: its bodies are not those of the simulator", "save it before bodies are added or removed"
        )
    if not len(rollout):
        raise SdfsimError("run: has no step", "make steps inside the block: with simulator.record() as run: ...")
    return saved.save_run(at_frame(simulator.scene, rollout), rollout, Path(folder))
