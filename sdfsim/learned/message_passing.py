"""Encode, process, decode on typed graphs: a network knows a graph by its sets of nodes, and the kinds of edges that
join them (`Layout`)."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Features:
    """The number of features, and the columns at which vectors begin (a mirror reverses their y)."""

    size: int
    vectors: tuple[int, ...] = ()


@dataclass(frozen=True)
class EdgeKind:
    """Edges from nodes of the set `sender` to nodes of the set `receiver`."""

    sender: str
    receiver: str
    features: Features


@dataclass(frozen=True)
class Layout:
    """The parts of a network's graphs; the set "node" is decoded."""

    nodes: dict[str, Features]
    edges: dict[str, EdgeKind]


@dataclass(frozen=True)
class EdgeSet:
    features: Tensor  # [E, F] float32
    # sender, receiver: [E] int64, in the sets that the kind names
    sender: Tensor
    receiver: Tensor


@dataclass(frozen=True)
class MultiGraph:
    nodes: dict[str, Tensor]  # features [n, F] float32 of each set
    edges: dict[str, EdgeSet]  # edges of each kind

    def __len__(self) -> int:
        return sum(len(features) for features in self.nodes.values())

    @property
    def edge_count(self) -> int:
        """Number of edges, counting both directions."""
        return sum(len(edges.sender) for edges in self.edges.values())

    def mirrored(self, layout: Layout) -> "MultiGraph":
        """The graph of the scene's mirror image: y of every vector feature reversed."""
        nodes = {name: flipped(x, layout.nodes[name]) for name, x in self.nodes.items()}
        kinds = layout.edges
        edges = {k: replace(e, features=flipped(e.features, kinds[k].features)) for k, e in self.edges.items()}
        return MultiGraph(nodes, edges)


def flipped(values: Tensor, kind: Features) -> Tensor:
    """`values` [n, F] with y of their vectors reversed."""
    sign = torch.ones(values.shape[-1], dtype=values.dtype, device=values.device)
    sign[[column + 1 for column in kind.vectors]] = -1.0
    return values * sign


@dataclass(frozen=True)
class GraphConfig:
    """Sizes of a network (published: width 128, 10 steps)."""

    width: int = 128  # width of every latent and hidden layer
    steps: int = 10  # steps of message passing, each with its own weights


def mlp(inputs: int, width: int, outputs: int, *, normalised: bool = True) -> nn.Sequential:
    """Two hidden layers, then LayerNorm unless it decodes."""
    layers = [nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, outputs)]
    return nn.Sequential(*layers, *([nn.LayerNorm(outputs)] if normalised else []))


class EdgeUpdate(nn.Module):
    """MLP over [edge, its senders, its receivers], with its first layer split so that each part is computed as cheaply
    as possible."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.edge = nn.Linear(width, width)
        self.sender = nn.Linear(width, width, bias=False)
        self.receiver = nn.Linear(width, width, bias=False)
        self.rest = nn.Sequential(
            nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.LayerNorm(width)
        )

    def forward(self, sent: Tensor, received: Tensor, edge: Tensor, sender: Tensor, receiver: Tensor) -> Tensor:
        """[E, width] updates of edges from nodes `sender` [E] to `receiver` [E]."""
        ends = _gathered(self.sender, sent, sender) + _gathered(self.receiver, received, receiver)
        return self.rest(self.edge(edge) + ends)


def _gathered(layer: nn.Linear, latent: Tensor, index: Tensor) -> Tensor:
    """[E, width] a layer applied to the latents of nodes `index` [E]: per edge, or first once per node."""
    return layer(latent[index]) if len(index) < len(latent) else layer(latent)[index]


class Step(nn.Module):
    """One step of message passing: all kinds of edges, then all sets of nodes; residual latents."""

    edges: nn.ModuleDict
    nodes: nn.ModuleDict

    def __init__(self, layout: Layout, width: int) -> None:
        super().__init__()
        self.edges = nn.ModuleDict({name: EdgeUpdate(width) for name in layout.edges})
        received = {name: 1 + sum(kind.receiver == name for kind in layout.edges.values()) for name in layout.nodes}
        self.nodes = nn.ModuleDict({name: mlp(count * width, width, width) for name, count in received.items()})


class GraphNetwork(nn.Module):
    """Encode, `steps` of message passing, decode; inputs and targets are normalised by statistics of training data."""

    def __init__(self, layout: Layout, config: GraphConfig) -> None:
        super().__init__()
        self.layout, self.config = layout, config
        width = config.width
        sizes = {name: features.size for name, features in layout.nodes.items()}
        sizes |= {name: kind.features.size for name, kind in layout.edges.items()}
        self.scale = nn.ModuleDict({name: Normaliser(size) for name, size in sizes.items()})
        self.target = Normaliser(3)
        self.encode = nn.ModuleDict({name: mlp(size, width, width) for name, size in sizes.items()})
        self.steps = nn.ModuleList([Step(layout, width) for _ in range(config.steps)])
        self.decode = mlp(width, width, 3, normalised=False)

    def observe(self, graph: MultiGraph) -> None:
        """Count the features of a graph into the statistics."""
        for name, features in graph.nodes.items():
            cast("Normaliser", self.scale[name]).observe(features)
        for name, edges in graph.edges.items():
            cast("Normaliser", self.scale[name]).observe(edges.features)

    def forward(self, graph: MultiGraph) -> Tensor:
        """Standardised accelerations (change of displacement a step) of the set "node", [n, 3]."""

        def encoded(name: str, features: Tensor) -> Tensor:
            return self.encode[name](self.scale[name](features))

        node = {name: encoded(name, features) for name, features in graph.nodes.items()}
        edge = {name: encoded(name, edges.features) for name, edges in graph.edges.items()}
        for step in cast("Iterable[Step]", self.steps):
            received = {name: [latent] for name, latent in node.items()}
            for name, kind in self.layout.edges.items():
                ends, sent, received_by = graph.edges[name], node[kind.sender], node[kind.receiver]
                edge[name] = edge[name] + step.edges[name](sent, received_by, edge[name], ends.sender, ends.receiver)
                total = torch.zeros_like(node[kind.receiver])
                received[kind.receiver].append(total.index_add_(0, ends.receiver, edge[name]))
            node = {name: node[name] + step.nodes[name](torch.cat(parts, -1)) for name, parts in received.items()}
        return self.decode(node["node"])


class Normaliser(nn.Module):
    """Standardises features by mean and deviation, which are gathered before training and stored with the weights."""

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
        # A feature that never varied (such as a constant coefficient) is only centred.
        deviation = torch.where(variance > 1e-12, variance.sqrt(), torch.ones_like(variance))
        return mean.float(), deviation.float()

    def forward(self, values: Tensor) -> Tensor:
        mean, deviation = self.moments()
        return (values - mean) / deviation

    def undo(self, values: Tensor) -> Tensor:
        mean, deviation = self.moments()
        return values * deviation + mean
