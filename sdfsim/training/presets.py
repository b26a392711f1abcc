"""Presets: the kind of network, its size, and the length of training."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Preset:
    kind: str  # "impulse" or "sdf-sim"
    config: dict[str, int]  # sizes of the network
    steps: int  # steps of the optimiser
    batch: int  # contact frames (impulse) or recorded steps (others) a step
    rate: float  # peak learning rate of Adam; it falls to a hundredth along a cosine
    reach: float = 0.1  # m, contact radius D
    nodes: int | None = None  # surface nodes of a body; None for all
    noise: float | None = None  # m, standard deviation of pose noise, for networks on surface nodes (None: no noise)
    # peak learning rate of Muon, which then trains the hidden matrices; None: Adam trains everything, as published
    matrix_rate: float | None = None


PRESETS = {
    "gnn": Preset("impulse", {"width": 32, "rounds": 4}, steps=30_000, batch=32, rate=2e-3, matrix_rate=0.01),
    # SDF-Sim as published
    "sdf-sim": Preset("sdf-sim", {"width": 128, "steps": 10}, 1_000_000, batch=8, rate=1e-3, nodes=64, noise=0.003),
    # SDF-Sim's graph with a network that is small enough for a CPU
    "sdf-sim-small": Preset("sdf-sim", {"width": 64, "steps": 5}, 20_000, batch=32, rate=1e-3, nodes=64, noise=0.003),
}
