"""The knobs of a simulation: what can be traded between accuracy and time, and how a scene and a model take it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from sdfsim.dynamics.model import Model
from sdfsim.dynamics.precision import in_bfloat16
from sdfsim.errors import SdfsimError
from sdfsim.scene.types import Scene
from sdfsim.shape.mlp_sdf import MlpSdf
from sdfsim.shape.sdf import GridSdf, Sdf, sample_grid
from sdfsim.shape.shape import Shape, with_nodes, with_sdf
from sdfsim.shape.surface_nodes import hull_nodes


@dataclass(frozen=True)
class Setting:
    """One way to simulate. The defaults are what `sdfsim simulate` does.

    Attributes:
        model: bundled name or path.
        nodes: "own", the shapes' own nodes; "thin K", K of them, outermost first; "grid N", sampled anew from
            N^3 points; "vertices", the vertices of the mesh that is shown.
        sdf: "own"; "grid R", the own distances on a grid of R^3 samples; "width W", a network of that width (own: 64);
            "exact", the geometry that it was fitted to.
        reach: contact radius over the model's own.
        rounds: of message passing, the first so many of the model's (None: all). What is left is a network that
            nobody has trained.
        precision: of the matrix products of the network, "float32" or "bf16".
        free_flight: "exact", or "learned" (paper networks).
        sleep: freeze what has come to rest.
        compiled: the network goes through `torch.compile`.
        threads: of the processor.
        device: "cpu" or "cuda".
    """

    model: str = "small"
    nodes: str = "own"
    sdf: str = "own"
    reach: float = 1.0
    rounds: int | None = None
    precision: str = "float32"
    free_flight: str = "exact"
    sleep: bool = False
    compiled: bool = False
    threads: int = 1
    device: str = "cpu"

    @property
    def label(self) -> str:
        """What a picture calls it: all that is not the default."""
        told = {
            "nodes": f"nodes: {self.nodes.split()[-1]}{'^3' if self.nodes.startswith('grid') else ''}",
            "sdf": f"sdf: {self.sdf}",
            "reach": f"reach x {self.reach:g}",
            "rounds": f"{self.rounds} rounds",
            "precision": self.precision,
            "free_flight": "free flight learned",
            "sleep": "sleep",
            "compiled": "compiled",
            "threads": f"{self.threads} threads",
            "device": self.device,
        }
        changed = [text for name, text in told.items() if getattr(self, name) != getattr(Setting(), name)]
        return ", ".join([_named(self.model), *changed])

    @property
    def key(self) -> str:
        """A file name for it."""
        model = self.model.removesuffix(".safetensors").replace("/", "-").strip("-.")
        rest = self.label.partition(", ")[2]
        kept = "".join(c if c.isalnum() else "-" for c in rest.replace("^3", "").replace(":", "")).strip("-")
        return f"{model}__{kept}" if kept else model

    def to_json(self) -> dict[str, Any]:
        """All knobs by name."""
        return asdict(self)


def _named(model: str) -> str:
    """A model's name; of a file as training leaves it, that of its folder."""
    path = Path(model)
    if path.suffix != ".safetensors":
        return model
    return path.parent.name if path.stem == "model" and path.parent.name else path.stem


def setting_from(stored: Mapping[str, Any]) -> Setting:
    """The setting that `to_json` told. Raises SdfsimError for knobs that this version does not know."""
    try:
        return Setting(**stored)
    except TypeError as error:
        raise SdfsimError(f"not a setting of this version: {error}", "measure again: sdfsim tradeoff") from error


def arranged_model(setting: Setting, model: Model) -> Model:
    """The model as a setting wants it.

    Raises:
        SdfsimError: it has fewer rounds, or is of a kind that the setting does not fit.
    """
    network = model.network
    if setting.rounds is not None:
        rounds = getattr(network, "rounds", None)
        if rounds is None or not 1 <= setting.rounds <= len(rounds):
            raise SdfsimError(f"{model.name}: has no {setting.rounds} rounds", "choose another model")
        network = _shortened(network, setting.rounds)
    if setting.precision == "bf16":
        network = in_bfloat16(network)
    if setting.compiled:
        network = torch.compile(network)
    return replace(model, network=network, reach=model.reach * setting.reach)


def arranged_shape(setting: Setting, shape: Shape, exact: Sdf | None = None) -> Shape:
    """A shape as a setting wants it; closed forms keep their distances, which nothing beats.

    Args:
        setting: see `Setting`.
        shape: with its own distances and nodes.
        exact: the geometry that it was fitted to; None takes its mesh.
    """
    if not len(shape.nodes):
        return shape
    nodes = shape
    if setting.nodes.startswith("grid"):
        nodes = with_nodes(shape, int(setting.nodes.split()[1]))
    elif setting.nodes.startswith("thin"):
        nodes = replace(shape, nodes=hull_nodes(shape.nodes, int(setting.nodes.split()[1])))
    elif setting.nodes == "vertices":
        nodes = replace(shape, nodes=np.unique(shape.mesh.vertices, axis=0))
    if not isinstance(shape.sdf, MlpSdf | GridSdf):
        return nodes
    if setting.sdf.startswith("grid"):
        return replace(nodes, sdf=sample_grid(shape.sdf, shape.sdf.bounds, int(setting.sdf.split()[1])))
    if setting.sdf == "exact":
        return replace(nodes, sdf=exact) if exact is not None else with_sdf(nodes, "mesh")
    return nodes


def arranged_scene(setting: Setting, scene: Scene, shapes: tuple[Shape, ...] | None = None) -> Scene:
    """A scene as a setting wants it, with `shapes` that are arranged already if there are any."""
    shapes = shapes or tuple(arranged_shape(setting, shape) for shape in scene.shapes)
    effects = replace(scene.effects, sleep="on") if setting.sleep else scene.effects
    return replace(scene, shapes=shapes, effects=effects)


@contextmanager
def threads_of(setting: Setting) -> Iterator[None]:
    """Computes with the setting's threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(setting.threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _shortened(network: nn.Module, rounds: int) -> nn.Module:
    """A copy of an impulse network with its first rounds alone."""
    short = deepcopy(network)
    short.rounds = short.rounds[:rounds]  # type: ignore[index]
    return short


def settings(models: list[str], paper: list[str], *, quick: bool, cuda: bool) -> list[Setting]:
    """The settings of a study: each knob alone, then the useful combinations.

    Args:
        models: bundled names or paths; the knobs are turned on the first.
        paper: which of the models are paper networks.
        quick: a few of them only.
        cuda: there is a CUDA device to be measured too.
    """
    base = Setting(model=models[0])
    lean = replace(base, nodes="thin 128", sdf="grid 64")
    chosen = [base, *(replace(base, nodes=nodes) for nodes in ("thin 32", "thin 64", "grid 7", "vertices"))]
    chosen += [replace(base, sdf="grid 64"), replace(base, sdf="exact"), lean, replace(base, precision="bf16")]
    chosen += [replace(base, nodes="thin 32", sdf="grid 32"), replace(base, nodes="grid 7", sdf="grid 64")]
    if models[0] not in paper:
        chosen += [replace(base, rounds=4), replace(lean, rounds=4)]
    if not quick:
        chosen += [replace(base, nodes=f"thin {count}") for count in (128, 256)]
        chosen += [replace(base, nodes=f"grid {side}") for side in (4, 5, 6, 8, 10, 12)]
        chosen += [replace(base, sdf=kind) for kind in ("grid 32", "grid 128", "width 32", "width 128")]
        chosen += [replace(base, reach=factor) for factor in (0.5, 2.0)]
        chosen += [replace(base, rounds=count) for count in (3, 5)] if models[0] not in paper else []
        chosen += [replace(base, sleep=True), replace(base, compiled=True), replace(lean, sleep=True)]
        chosen += [replace(base, nodes=nodes, sdf="grid 64") for nodes in ("thin 64", "thin 256")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    chosen += [replace(base, threads=2)] if cores > 1 and not quick else []
    chosen += [replace(base, device="cuda")] if cuda else []
    for other in models[1:]:
        chosen.append(Setting(model=other))
        if other in paper:
            chosen.append(Setting(model=other, free_flight="learned"))
    return chosen
