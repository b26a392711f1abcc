"""The recorded scenes that settings are compared on, and what they have in common."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from sdfsim.data.batching import scene_of
from sdfsim.data.dataset import (
    FLOOR,
    Trajectory,
    check_alike,
    floor_of,
    home_of,
    load_shapes,
    read_info,
    trajectory_files,
)
from sdfsim.data.replay import first_frames
from sdfsim.data.velocities import at_instants, engine_substep
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.baselines import engine_file
from sdfsim.evaluation.penetration import Solid, engine_pieces, exact_solids
from sdfsim.evaluation.tradeoff_shapes import digest_of
from sdfsim.scene.types import Scene
from sdfsim.shape.distance import PiecesDistance
from sdfsim.shape.mesh import Mesh
from sdfsim.shape.sdf import accepts_numpy
from sdfsim.shape.shape import Shape

MOST, MOST_QUICK = 20, 8  # trajectories
STEPS, TIMED_STEPS = 100, 80


@dataclass(frozen=True)
class Cases:
    """What every contender simulates.

    Attributes:
        data: dataset folder.
        scratch: folder for what is made once and used again.
        recorded: as the teacher moved them, from their first frames on.
        starts: the same with velocities at the instants of the positions: what ours start from.
        shapes: of every name in use, their origins at the centres of mass.
        urdfs: the engine's files, by name; none where they are not at hand.
        pieces: the convex pieces that the engine collides, by name; none where they are not at hand.
        solids: the exact geometry, by name.
        floor: its friction and restitution.
        timed: which of the trajectories are timed.
        timed_steps: how many steps of them.
        length, time: m and s of the scene in one of these; recordings are 1.
    """

    data: Path
    scratch: Path
    recorded: list[Trajectory]
    starts: list[Trajectory]
    shapes: dict[str, Shape]
    urdfs: dict[str, Path]
    pieces: dict[str, list[Mesh]]
    solids: dict[str, Solid]
    floor: tuple[float, float]
    timed: list[int]
    timed_steps: int
    length: float = 1.0
    time: float = 1.0

    @property
    def steps(self) -> int:
        """How far all are simulated."""
        return len(self.recorded[0].position) - 1

    @property
    def bodies(self) -> int:
        """How many bodies move in all."""
        return int(sum((~t.static.astype(bool)).sum() for t in self.recorded))

    def scene(self, index: int, shapes: dict[str, Shape]) -> Scene:
        """One of the trajectories as a scene of its own."""
        return scene_of([self.starts[index]], [0], shapes, self.floor)[0]

    def digest(self) -> str:
        """Changes with all that a measurement depends on but the contender itself."""
        plain = (self.steps, self.timed, self.timed_steps, self.floor, self.length, self.time)
        told = hashlib.sha256(repr(plain).encode())
        for t in (*self.recorded, *self.starts):
            for name, value in vars(t).items():
                told.update(name.encode() + np.ascontiguousarray(value).tobytes())
        for name, shape in sorted(self.shapes.items()):
            pieces = [piece.digest() for piece in self.pieces.get(name, [])]
            told.update(repr((name, digest_of(shape), pieces)).encode())
        return told.hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class PiecesSdf:
    """The exact signed distance to a union of convex pieces, as an Sdf; by bounding-volume hierarchy, on the CPU."""

    oracle: PiecesDistance

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m."""
        return self.oracle.bounds

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] (0 on the surface itself)."""
        asked = points.detach().cpu().numpy().astype(np.float64)
        truth = self.oracle(asked)
        away = np.where(truth.distance == 0, 1.0, truth.distance)[:, None]
        return torch.from_numpy(truth.distance).to(points), torch.from_numpy((asked - truth.closest) / away).to(points)


def load_cases(data: Path, scratch: Path, *, quick: bool) -> Cases:
    """The trajectories of a dataset's test split, at most `MOST`; a quick study takes fewer and shorter ones.

    Args:
        data: dataset folder.
        scratch: see `Cases`.
        quick: a quick study.

    Raises:
        SdfsimError: no or unreadable trajectories or shapes, or recordings of different steps or gravities.
    """
    files = trajectory_files(data, "test")[: MOST_QUICK if quick else MOST]
    recorded = [t for t in map(Trajectory.load, files) if not t.static.all()]
    if not recorded:
        raise SdfsimError(f"{data}: nothing moves in any trajectory")
    check_alike(str(data), recorded)
    longest = min(50 if quick else STEPS, *(len(t.position) - 1 for t in recorded))
    recorded = [first_frames(t, longest + 1) for t in recorded]
    substep = engine_substep(data)
    shapes = load_shapes(data, {str(n) for t in recorded for n in t.shape})
    order = np.argsort([t.position.shape[1] for t in recorded], kind="stable")
    places = (2,) if quick else (1, 3)  # quarters of the scenes by their bodies
    timed = sorted({int(order[k * (len(order) - 1) // 4]) for k in places})
    return Cases(
        data=data,
        scratch=scratch,
        recorded=recorded,
        starts=[at_instants(t, substep) for t in recorded],
        shapes={name: replace(shape, com=np.zeros(3)) for name, shape in shapes.items()},
        urdfs=_engine_files(data, shapes),
        pieces={name: engine_pieces(data, name) for name in shapes},
        solids=exact_solids(data, shapes),
        floor=FLOOR if (home := home_of(data)) is None else floor_of(read_info(home)),
        timed=timed,
        timed_steps=min(30 if quick else TIMED_STEPS, longest),
    )


def _engine_files(data: Path, names: Iterable[str]) -> dict[str, Path]:
    """The engine's files that are at hand; without them the engine is left out, and says so."""
    found = {}
    for name in names:
        with suppress(SdfsimError):
            found[name] = engine_file(data, name)
    return found
