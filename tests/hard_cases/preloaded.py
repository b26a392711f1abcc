"""What every command needs, imported once in the server that the children of `crashing` are forked from."""

import cli
import pipeline.stages
import sdfsim.fitting
import sdfsim.run
import sdfsim.shape.fit
import sdfsim.training.train

__all__ = ["cli", "pipeline", "sdfsim"]
