"""What every command needs, loaded once in the server that the children of `crashing` are forked from."""

import open3d  # noqa: TID253
import skimage.measure  # noqa: TID253
import torch

import cli
import pipeline.mesh.meshing
import pipeline.stages
import sdfsim.apps.fit
import sdfsim.apps.run
import sdfsim.sdf.fit.train
import sdfsim.training.train

torch.set_num_threads(1)  # what is forked may have no threads
_box = {"box": {"size": (1, 1, 1)}, "position": (0, 0, 0.5)}
sdfsim.Simulator(sdfsim.Scene().add("floor", plane={}).add("a", **_box)).run(steps=2)  # loads what is compiled

_parameter = torch.nn.Parameter(torch.zeros(1))
torch.optim.AdamW([_parameter]).zero_grad()  # imports torch._dynamo, seconds of it

__all__ = ["cli", "open3d", "pipeline", "sdfsim", "skimage"]
