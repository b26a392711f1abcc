"""sdfsim: rigid-body simulation over learned signed-distance functions, from photos to motion.

The names below load their modules on first use, so that `import sdfsim` stays light.
"""

from __future__ import annotations

import os
import sys
import warnings
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from sdfsim.base.version import __version__ as __version__

if TYPE_CHECKING:
    from pipeline.states import reconstruct
    from sdfsim.apps.export import export
    from sdfsim.apps.film.film import track
    from sdfsim.apps.fit import fit
    from sdfsim.apps.play import play, show
    from sdfsim.apps.play.saved import save_run
    from sdfsim.apps.render import render
    from sdfsim.apps.run import simulate
    from sdfsim.base.errors import SceneError, SdfsimError
    from sdfsim.evaluation.instruments import judged
    from sdfsim.physics.bodies import State
    from sdfsim.physics.rollout import Rollout
    from sdfsim.scene.builder import SceneBuilder as Scene
    from sdfsim.scene.load import load_scene
    from sdfsim.shape.shape import Shape, load_shape
    from sdfsim.simulate.camera import Camera, Style
    from sdfsim.simulate.simulator import Simulator
    from sdfsim.simulate.worlds import Batch

# Threads of torch wait for one another by spinning. Beside other programs they take the processor from the threads that
# they wait for, and a step takes ten times as long. So they spin for some microseconds only, which costs little on a
# free machine. This must be set before torch is imported.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

# Numba warns of an old TBB and takes its next threading layer, which is as good here.
warnings.filterwarnings("ignore", message="The TBB threading layer requires TBB version")

__all__ = [
    "Batch",
    "Camera",
    "Rollout",
    "Scene",
    "SceneError",
    "SdfsimError",
    "Shape",
    "Simulator",
    "State",
    "Style",
    "export",
    "fit",
    "judged",
    "load_scene",
    "load_shape",
    "play",
    "reconstruct",
    "render",
    "save_run",
    "show",
    "simulate",
    "track",
]

_HOME = {
    "Batch": "sdfsim.simulate.worlds",
    "Camera": "sdfsim.simulate.camera",
    "Rollout": "sdfsim.physics.rollout",
    "Scene": "sdfsim.scene.builder",
    "SceneError": "sdfsim.base.errors",
    "SdfsimError": "sdfsim.base.errors",
    "Shape": "sdfsim.shape.shape",
    "Simulator": "sdfsim.simulate.simulator",
    "State": "sdfsim.physics.bodies",
    "Style": "sdfsim.simulate.camera",
    "judged": "sdfsim.evaluation.instruments",
    "load_scene": "sdfsim.scene.load",
    "load_shape": "sdfsim.shape.shape",
    "export": "sdfsim.apps.export",
    "fit": "sdfsim.apps.fit",
    "play": "sdfsim.apps.play",
    "show": "sdfsim.apps.play",
    "reconstruct": "pipeline.states",
    "render": "sdfsim.apps.render",
    "save_run": "sdfsim.apps.play.saved",
    "simulate": "sdfsim.apps.run",
    "track": "sdfsim.apps.film.film",
}
_THERE = {"Scene": "SceneBuilder"}  # names that differ in their module


class _Package(ModuleType):
    """A folder of the package has the name of a function, `simulate`. What is imported from it must not hide that."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'sdfsim' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), _THERE.get(name, name))
