"""A trained model (network, units and ranges of its training data), and its file."""

from __future__ import annotations

import json
import math
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import replacing
from sdfsim.physics.options import GRAVITY, LENGTH, STEP

if TYPE_CHECKING:  # slow to load
    from torch import nn

BUNDLED = Path(__file__).resolve().parent.parent / "models"
MOST = 4096  # largest value of any size of a network
MODEL_VERSION = 4  # of what networks read; files of earlier versions have to be trained again
SOLVER = "solver"
SURFACES = "sdf-sim"  # the network on surface nodes
IMPULSE = "impulse"  # the network on bodies


@dataclass(frozen=True)
class Model:
    """Weights with everything needed to use them."""

    name: str  # bundled name or file stem
    kind: str  # "solver", "impulse" or "sdf-sim"
    network: Any  # an `nn.Module` in evaluation mode; None for the solver, or if loaded without weights
    dt: float  # s, the step of the training data, or of the solver for bodies of `length` at `gravity`
    gravity: float  # m/s^2, its magnitude in the training data
    # m, the middle of the range of training bodies' largest extents, to which other scenes are rescaled. For the
    # solver, scenes are rescaled by their smallest dynamic body.
    length: float
    reach: float  # m, contact radius D
    nodes: int | None = None  # surface nodes per body in training; None for all
    # name -> [low, high] of the training data (friction, restitution, mass_ratio, speed, size)
    ranges: dict[str, list[float]] = field(default_factory=dict)
    card: dict[str, Any] = field(default_factory=dict)  # training record (data, steps, seconds, errors)

    def to(self, device: str) -> Model:
        """The same model with its weights on `device`: this one, or a copy if they are elsewhere. The solver has no
        weights."""
        if self.network is None:
            return self
        there, (kind, _, index) = {w.device for w in self.network.state_dict().values()}, device.partition(":")
        if all(at.type == kind and index in ("", str(at.index)) for at in there):
            return self
        return replace(self, network=deepcopy(self.network).to(device))

    def save(self, path: Path) -> None:
        """Write a `.safetensors` file whose metadata holds everything but the weights (temporary name, then
        renamed)."""
        from safetensors.torch import save

        info = {
            "version": MODEL_VERSION,
            "kind": self.kind,
            "config": asdict(self.network.config),
            **{k: getattr(self, k) for k in ("dt", "gravity", "length", "reach", "nodes", "ranges", "card")},
        }
        weights = {k: v.detach().cpu().contiguous() for k, v in self.network.state_dict().items()}
        with replacing(path) as partial:
            # Written as bytes, not by the library: a full disk is then an OSError like any other.
            partial.write_bytes(save(weights, metadata={"sdfsim_model": json.dumps(info)}))


def new_network(kind: str, config: dict[str, Any]) -> nn.Module:
    """An untrained network of `kind` ("impulse" or "sdf-sim"). Raises KeyError for another kind."""
    if kind == IMPULSE:
        from sdfsim.learned.impulse import ImpulseConfig, ImpulseNetwork

        return ImpulseNetwork(ImpulseConfig(**config))
    if kind != SURFACES:
        raise KeyError(kind)
    from sdfsim.learned.message_passing import GraphConfig, GraphNetwork
    from sdfsim.learned.surfaces import SDF_SIM

    return GraphNetwork(SDF_SIM, GraphConfig(**config))


def bundled_models() -> list[str]:
    """Names of the networks that come with the package."""
    return sorted(p.stem for p in BUNDLED.glob("*.safetensors"))


def model_names() -> list[str]:
    """Names of bundled models: the solver and the networks."""
    return [SOLVER, *bundled_models()]


def load_model(name: str | Path | None = None, *, weights: bool = True) -> Model:
    """A bundled model by name (None: the solver), or any model file by path; without `weights` its network is None.
    Raises SdfsimError for an unknown name, or a file that is unreadable or not a model."""
    from safetensors import SafetensorError, safe_open

    if name is None or name == SOLVER:
        return Model(SOLVER, SOLVER, None, dt=STEP, gravity=GRAVITY, length=LENGTH, reach=0.02)
    path = Path(name) if str(name).endswith(".safetensors") else BUNDLED / f"{name}.safetensors"
    if not path.exists():
        raise SdfsimError(
            f"model {str(name)!r} not found",
            f"models are {', '.join(model_names())}; or give the path of a .safetensors",
        )
    try:
        with safe_open(path, framework="pt" if weights else "np") as file:
            info = json.loads((file.metadata() or {})["sdfsim_model"])
            if info.pop("version", 1) != MODEL_VERSION:
                raise ValueError("it is of an earlier version; train it again")
            config = info.pop("config")
            network = None
            if weights:
                _check_size(info["kind"], config, {k: file.get_slice(k).get_shape() for k in file.keys()})
                network = new_network(info["kind"], config).eval().requires_grad_(False)
                network.load_state_dict({k: file.get_tensor(k) for k in file.keys()})
        model = Model(name=path.stem, network=network, **info)
        for key in ("dt", "gravity", "length", "reach"):
            if not 0 < float(getattr(model, key)) < math.inf:
                raise ValueError(f"{key} must be > 0")
    except (OSError, SafetensorError, LookupError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        raise SdfsimError(f"{path}: not a model of this version of sdfsim: {error}") from error
    return model


def _check_size(kind: str, config: dict[str, Any], found: dict[str, list[int]]) -> None:
    """Raise ValueError if the weights of a file do not fit its network, before memory is allocated for it."""
    if any(isinstance(value, int) and not 0 <= value <= MOST for value in config.values()):
        raise ValueError(f"sizes of its network must be 0 to {MOST} (got {config})")
    import torch

    with torch.device("meta"):
        wanted = {name: list(weight.shape) for name, weight in new_network(kind, config).state_dict().items()}
    if wanted != found:
        odd = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
        raise ValueError(f"the weights do not fit its network: {odd[0]} and {len(odd) - 1} others")
