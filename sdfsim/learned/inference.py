"""The *impulse* network on the CPU: its weights and a solved step as the compiled code wants them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache
from typing import cast

import numpy as np
import torch
from threadpoolctl import ThreadpoolController
from torch import Tensor, nn

from sdfsim.base.compiling import warn_compiling
from sdfsim.learned.contact_graph import REST_SPEED
from sdfsim.learned.impulse import CALM, LIVELY, ImpulseNetwork, Round
from sdfsim.physics import solver as kernels
from sdfsim.physics.bodies import State
from sdfsim.physics.motion import MOTION
from sdfsim.physics.solver.record import Edges
from sdfsim.physics.solver.world import World

with kernels.kept():
    from sdfsim.physics.solver import impulse as compiled
from sdfsim.physics.options import Options


def packed(network: ImpulseNetwork, *, friction: bool) -> compiled.Weights:
    """Copies of the weights of a network."""
    warn_compiling(compiled.correct, "the network", "half a minute")
    rounds = list(cast("Iterable[Round]", network.rounds))

    def layer(*modules: Iterable[nn.Linear | nn.LayerNorm]) -> compiled.Layer:
        """Of every round the modules side by side."""
        each = list(zip(*modules, strict=True))
        weight = [torch.cat([m.weight.mT if m.weight.ndim == 2 else m.weight for m in some], -1) for some in each]
        return compiled.Layer(_array(weight), _array([torch.cat([m.bias for m in some]) for some in each]))

    def linear(sequences: list[nn.Module]) -> tuple[compiled.Layer, ...]:
        return tuple(layer(cast("Iterable[nn.Linear]", ms)) for ms in zip(*map(_linear, sequences), strict=True))

    impulse = layer([r.normal_impulse for r in rounds])
    if friction:
        both = layer([r.normal_impulse for r in rounds], [r.tangent_impulse for r in rounds])
        order = [0, 1, 2, 4, 3, 5]  # tangential columns have both axes together, here each axis has (end, mean)
        impulse = compiled.Layer(*(np.ascontiguousarray(values[..., order]) for values in both))
    return compiled.Weights(
        encode=linear([network.encode]),  # type: ignore[arg-type]
        normalise=layer([r.normalise for r in rounds]),
        edge=linear([r.edge for r in rounds]),  # type: ignore[arg-type]
        attention=layer([r.attention for r in rounds]),
        impulse=impulse,
        tell=layer([r.latent for r in rounds], [r.message for r in rounds]),
        body=linear([r.body for r in rounds]),  # type: ignore[arg-type]
        alone=bool(network.config.alone),
    )


def _linear(sequence: nn.Module) -> Iterator[nn.Module]:
    return (m for m in sequence.children() if isinstance(m, nn.Linear))


def _array(values: list[Tensor]) -> np.ndarray:
    return np.ascontiguousarray(torch.stack(values).detach().cpu().float().numpy())


def corrected(
    weights: compiled.Weights, world: World, before: State, solved: State, edges: Edges, terms: compiled.Terms
) -> State:  # fmt: skip
    """What the network makes of a step of the solve, whose `edges`, at least one, are its own; those of a pair of
    bodies stand together."""
    start, end = compiled.Poses(*_poses(before)), compiled.Poses(*(array.copy() for array in _poses(solved)))
    with _blas().limit(limits=1):
        compiled.correct(weights, world, start, end, edges.pair, edges.value, terms)
    return replace(solved, **dict(zip(MOTION, end, strict=True)))


@cache
def _blas() -> ThreadpoolController:
    """The matrix libraries that the compiled network calls. With layers as small as its own, a second thread of theirs
    doubles the processor time and ends no sooner."""
    import scipy.linalg.cython_blas  # noqa: F401  # numba's np.dot loads it when it first runs, too late to be listed

    return ThreadpoolController().select(user_api="blas")


def terms_of(options: Options, known: float, trust: float = 1.0) -> compiled.Terms:
    """The terms of a step for a network that was trained on steps of `known`; `trust` (0 to 1) scales what it adds."""
    return compiled.Terms(
        gravity=options.gravity, dt=options.dt, known=known, friction=options.friction,
        restitution=options.restitution, rotation=options.rotation, trust=trust, rest=REST_SPEED, calm=CALM,
        lively=LIVELY,
    )  # fmt: skip


def _poses(state: State) -> list[np.ndarray]:
    return [np.ascontiguousarray(getattr(state, name)) for name in MOTION]
