"""The *paper* network: encode-process-decode on body nodes and surface nodes, as published.

Graph (paper, section 3 and appendix): every body has one body node and its surface nodes; intra edges join them both
ways; a surface node within the contact radius of another body joins that body's node both ways. The decoder gives
every surface node an acceleration; shape matching turns those of a body into its next pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import cast

import torch
from torch import Tensor, nn

NODE_FEATURES = 13  # of surface nodes and of body nodes
INTRA_FEATURES = 8
CONTACT_FEATURES = 15
KINDS = ("intra_up", "intra_down", "contact_up", "contact_down")  # up: surface node -> body node


@dataclass(frozen=True)
class PaperConfig:
    """Sizes of the network (published: width 128, 10 steps).

    Attributes:
        width: of every latent and hidden layer.
        steps: of message passing, each with weights of its own.
    """

    width: int = 128
    steps: int = 10


@dataclass(frozen=True)
class SurfaceGraph:
    """N bodies, M surface nodes, E contact edges; float32 features, see `surface_graph`.

    Attributes:
        body: [N, NODE_FEATURES].
        node: [M, NODE_FEATURES].
        owner: [M] int64, the body of each surface node.
        intra: [M, INTRA_FEATURES], of the edge between a surface node and its body node (both directions).
        contact_node, contact_body: [E] int64.
        contact: [E, CONTACT_FEATURES] (both directions).
    """

    body: Tensor
    node: Tensor
    owner: Tensor
    intra: Tensor
    contact_node: Tensor
    contact_body: Tensor
    contact: Tensor


def by_rows(function: Callable[..., Tensor], rows: int | None, *inputs: Tensor) -> Tensor:
    """`function` of inputs [E, ...] that treats every row alone, on at most `rows` of them at once."""
    if rows is None or len(inputs[0]) <= rows:
        return function(*inputs)
    return torch.cat([function(*part) for part in zip(*(v.split(rows) for v in inputs), strict=True)])


def mlp(inputs: int, width: int, outputs: int, *, normalised: bool = True) -> nn.Sequential:
    """Two hidden layers, then LayerNorm unless it decodes."""
    layers = [nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, outputs)]
    return nn.Sequential(*layers, *([nn.LayerNorm(outputs)] if normalised else []))


class EdgeUpdate(nn.Module):
    """MLP over [edge, sender, receiver], its first layer split so that nodes are projected once, not once an edge."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.edge = nn.Linear(width, width)
        self.sender = nn.Linear(width, width, bias=False)
        self.receiver = nn.Linear(width, width, bias=False)
        self.rest = nn.Sequential(
            nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.LayerNorm(width)
        )

    def project(self, sender: Tensor, receiver: Tensor) -> tuple[Tensor, Tensor]:
        """The nodes' parts of the first layer."""
        return self.sender(sender), self.receiver(receiver)

    def forward(self, sent: Tensor, received: Tensor, edge: Tensor, source: Tensor, target: Tensor) -> Tensor:
        """[E, width] updates of edges from node `source` [E] (`sent` is projected) to `target` [E] (`received`)."""
        return self.rest(self.edge(edge) + sent[source] + received[target])


class Step(nn.Module):
    """One step of message passing: all four kinds of edges, then both kinds of nodes; residual latents."""

    edges: nn.ModuleDict
    node: nn.Module
    body: nn.Module

    def __init__(self, width: int) -> None:
        super().__init__()
        self.edges = nn.ModuleDict({kind: EdgeUpdate(width) for kind in KINDS})
        self.node = mlp(3 * width, width, width)
        self.body = mlp(3 * width, width, width)


class PaperNetwork(nn.Module):
    """Encode, `steps` of message passing, decode; inputs and targets are normalised by statistics of the training data.

    Args:
        config: sizes.
    """

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        sizes = {"body": NODE_FEATURES, "node": NODE_FEATURES, "intra": INTRA_FEATURES, "contact": CONTACT_FEATURES}
        self.scale = nn.ModuleDict({name: Normaliser(size) for name, size in sizes.items()})
        self.target = Normaliser(3)
        self.encode = nn.ModuleDict({name: mlp(sizes[name], width, width) for name in ("body", "node")})
        self.encode_edge = nn.ModuleDict({kind: mlp(sizes[kind.split("_")[0]], width, width) for kind in KINDS})
        self.steps = nn.ModuleList([Step(width) for _ in range(config.steps)])
        self.decode = mlp(width, width, 3, normalised=False)

    def forward(self, graph: SurfaceGraph, *, rows: int | None = None) -> Tensor:
        """Standardised accelerations (change of displacement a step) of the surface nodes, [M, 3].

        Args:
            graph: nodes and edges.
            rows: update no more than that many edges at once; None for all.
        """
        g = graph
        node = self.encode["node"](self.scale["node"](g.node))
        body = self.encode["body"](self.scale["body"](g.body))
        scaled = {name: self.scale[name](getattr(g, name)) for name in ("intra", "contact")}
        edges = {kind: self.encode_edge[kind](scaled[kind.split("_")[0]]) for kind in KINDS}
        every = torch.arange(len(node), device=node.device)
        ends = {
            "intra_up": (every, g.owner),
            "intra_down": (g.owner, every),
            "contact_up": (g.contact_node, g.contact_body),
            "contact_down": (g.contact_body, g.contact_node),
        }
        for step in cast("Iterable[Step]", self.steps):
            heard = {}
            for kind in KINDS:
                sender, receiver = (node, body) if kind.endswith("up") else (body, node)
                update = step.edges[kind]
                project = update.project(sender, receiver)  # type: ignore[operator]
                edges[kind] = edges[kind] + by_rows(partial(update, *project), rows, edges[kind], *ends[kind])
                heard[kind] = torch.zeros_like(receiver).index_add_(0, ends[kind][1], edges[kind])
            node, body = (
                node + step.node(torch.cat([node, heard["intra_down"], heard["contact_down"]], -1)),
                body + step.body(torch.cat([body, heard["intra_up"], heard["contact_up"]], -1)),
            )
        return self.decode(node)


class Normaliser(nn.Module):
    """Standardises features by mean and deviation that are gathered before training and kept with the weights."""

    total: Tensor
    sum: Tensor
    squares: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("total", torch.zeros((), dtype=torch.float64))
        self.register_buffer("sum", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(size, dtype=torch.float64))

    def observe(self, values: Tensor) -> None:
        """Count [*, size] values in."""
        values = values.detach().to(torch.float64)
        self.total += len(values)
        self.sum += values.sum(0)
        self.squares += values.square().sum(0)

    def moments(self) -> tuple[Tensor, Tensor]:
        """Mean and deviation (at least 1e-6), float32 [size] each."""
        mean = self.sum / self.total.clamp_min(1)
        variance = (self.squares / self.total.clamp_min(1) - mean.square()).clamp_min(0.0)
        # A feature that never varied (a constant coefficient) is only centred.
        deviation = torch.where(variance > 1e-12, variance.sqrt(), torch.ones_like(variance))
        return mean.float(), deviation.float()

    def forward(self, values: Tensor) -> Tensor:
        """Standardised values."""
        mean, deviation = self.moments()
        return (values - mean) / deviation

    def undo(self, values: Tensor) -> Tensor:
        """Back from standardised values."""
        mean, deviation = self.moments()
        return values * deviation + mean
