"""One training run of the field: VolSDF's losses, and a state that can be saved and resumed."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from pipeline.cameras import Sparse, View
from pipeline.field import (
    BACKGROUND_SAMPLES,
    GridField,
    differences,
    level_step,
    stencil,
)
from pipeline.normalise import Normalisation, point_weights
from pipeline.photos import BACKDROP
from pipeline.rays import Rays
from pipeline.recipe import Recipe, active_levels, beta_at, rate_at, view_dependence_at
from pipeline.render import Samples, choose_samples, composite, sdf_cache
from sdfsim.files import replacing


@dataclass(frozen=True)
class Landmarks:
    """What structure-from-motion knows about the scene, in normalised space.

    Attributes:
        points: [P, 3] surface points in the unit sphere.
        weights: [P] how far each is trusted, mean 1.
        sight: [L, 6] starts and ends of stretches of free space.
    """

    points: np.ndarray
    weights: np.ndarray
    sight: np.ndarray


def find_landmarks(sparse: Sparse, views: list[View], normalisation: Normalisation) -> Landmarks:
    """Sparse points seen by three views or more with a small error, and their lines of sight within the sphere.

    Args:
        sparse: in the world of the poses.
        views: in normalised space.
        normalisation: from one to the other.
    """
    points = normalisation.apply(sparse.xyz)
    seen = np.bincount(sparse.point_of, minlength=len(points))
    good = (seen >= 3) & (sparse.error < 1.5)
    inside = good & (np.linalg.norm(points, axis=1) < 1.0)
    weights = point_weights(sparse, len(points))[inside]
    use = good[sparse.point_of]
    end, start = points[sparse.point_of[use]], np.array([v.center for v in views]).reshape(-1, 3)[sparse.view_of[use]]
    length = np.linalg.norm(end - start, axis=1)
    direction = (end - start) / np.maximum(length, 1e-9)[:, None]
    along = -(start * direction).sum(1)
    half = np.sqrt(np.maximum(1 - ((start**2).sum(1) - along**2), 0))
    # Not all the way: a point is uncertain by a little, and so is the surface there.
    low, high = np.maximum(along - half, 0), np.minimum(along + half, length - 0.04)
    crosses = (half > 0) & (high > low + 0.02)
    sight = np.concatenate([start + low[:, None] * direction, start + high[:, None] * direction], 1)[crosses]
    return Landmarks(points[inside], weights / max(float(weights.mean()), 1e-9) if len(weights) else weights, sight)


class Trainer:
    """One training run.

    Args:
        recipe: how.
        rays: pixels, in normalised space.
        landmarks: sparse points and lines of sight in normalised space.
        seed: of everything random.
        device: where to compute.
    """

    def __init__(self, recipe: Recipe, rays: Rays, landmarks: Landmarks, seed: int, device: str = "cpu") -> None:
        self.recipe, self.rays, self.seed, self.device = recipe, rays.to(device), seed, device
        self.points, self.point_weights, self.sight = (
            torch.tensor(values, dtype=torch.float32, device=device)
            for values in (landmarks.points, landmarks.weights, landmarks.sight)
        )
        self.field = GridField(recipe.size, seed, recipe.start_radius).to(device)
        grids = [*self.field.grids, self.field.background]
        networks = [p for name, p in self.field.named_parameters() if not name.startswith(("grids", "background"))]
        self.optimizer = torch.optim.Adam(
            [
                {"params": grids, "lr": recipe.rate, "base": recipe.rate},
                {"params": networks, "lr": recipe.rate / 4, "base": recipe.rate / 4},
            ],
            betas=(0.9, 0.99), eps=1e-12, fused=True,
        )  # fmt: skip
        self.iteration = 0
        self.iterations = recipe.iterations
        self.seconds = 0.0
        self.cache: Tensor | None = None

    @property
    def fraction(self) -> float:
        """Share of the training that is done."""
        return self.iteration / self.iterations

    def refresh(self) -> None:
        """Brings the cached SDF and the active levels up to date."""
        self.field.active = active_levels(self.recipe, self.fraction)
        self.field.view_dependence = view_dependence_at(self.fraction)
        self.cache = sdf_cache(self.field, 64)

    def step(self) -> dict[str, float]:
        """One step of Adam; returns the losses."""
        recipe, field = self.recipe, self.field
        # A function of the iteration alone, so that a resumed run equals an undisturbed one.
        period = 16 if self.iteration < 256 else 48
        if self.cache is None or self.iteration % period == 0:
            self.refresh()
        assert self.cache is not None
        beta = beta_at(recipe, self.fraction)
        rng = torch.Generator().manual_seed((self.seed + 7) * 1_000_003 + self.iteration)
        index = self.rays.batch(recipe.rays, self.seed, self.iteration)
        origins, directions = self.rays.at(index)
        truth = self.rays.rgb[index].float() / 255
        count, masked = recipe.rays, self.rays.mask is not None
        uniforms = torch.rand(count, recipe.samples + BACKGROUND_SAMPLES, generator=rng).to(self.device)
        samples = choose_samples(self.cache, origins, directions, beta, uniforms[:, : recipe.samples])
        behind = torch.full((3,), BACKDROP, device=self.device)
        if not masked:
            behind = field.background_along(origins, directions, uniforms[:, recipe.samples :])
        width = level_step(recipe.size.levels, field.active)
        around = stencil(self.regularised(samples, rng), width)
        pick = torch.randint(max(1, len(self.points)), (min(256, len(self.points)),), generator=rng).to(self.device)
        # One query for all: each would otherwise fill a gradient buffer as large as the grids.
        parts = [samples.points.view(-1, 3), around.view(-1, 3), self.points[pick], self.free_points(rng)]
        sdf, features, grid = field.geometry_at(torch.cat(parts))
        rendered, stencils = len(parts[0]), len(parts[0]) + len(parts[1])
        pinned = stencils + len(pick)
        out = composite(field, samples, (sdf[:rendered], features[:rendered], grid[:rendered]), beta, behind)
        losses = {"color": (out["rgb"] - truth).abs().mean()}
        if self.rays.mask is not None:
            wanted = self.rays.mask[index].float() / 255
            opacity = out["opacity"].clamp(1e-4, 1 - 1e-4)
            losses["mask"] = torch.nn.functional.binary_cross_entropy(opacity, wanted) * recipe.mask
        gradient, laplacian = differences(sdf[rendered:stencils].view(-1, 7), width)
        losses["eikonal"] = ((gradient.norm(dim=1) - 1) ** 2).mean() * recipe.eikonal
        fade = recipe.curvature * max(0.03, 1 - self.fraction / 0.7)
        losses["curvature"] = (laplacian.abs() * width).clamp_max(10).mean() * fade
        if len(pick):
            # Robust: a wrong point must not pull a surface out of nothing.
            pull = self.point_weights[pick] * sdf[stencils:pinned].abs().clamp_max(0.1)
            losses["sparse"] = pull.mean() * recipe.sparse
        if len(self.sight):
            losses["free"] = torch.relu(0.02 - sdf[pinned:]).mean() * recipe.free
        total = torch.stack(list(losses.values())).sum()
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        factor = rate_at(self.fraction)
        for group in self.optimizer.param_groups:
            group["lr"] = group["base"] * factor
        self.optimizer.step()
        self.iteration += 1
        return {name: float(value.detach()) for name, value in losses.items()}

    def free_points(self, rng: torch.Generator) -> Tensor:
        """Points [P, 3] between cameras and sparse points that they see: free space, whatever the colours say."""
        count = min(256, len(self.sight))
        pick = torch.randint(max(1, len(self.sight)), (count,), generator=rng).to(self.device)
        along = torch.rand(count, 1, generator=rng).to(self.device)
        start, end = self.sight[pick, :3], self.sight[pick, 3:]
        return start + along * (end - start)

    def regularised(self, samples: Samples, rng: torch.Generator) -> Tensor:
        """Points [P, 3] of the sphere for the eikonal and curvature losses, half of them near the surface."""
        count = self.recipe.surface_points // 2
        free = torch.randn(count, 3, generator=rng)
        radius = torch.rand(count, 1, generator=rng) ** (1 / 3)
        free = (free / free.norm(dim=1, keepdim=True) * radius).to(self.device)
        near = samples.points[samples.near_surface]
        return torch.cat([free, near[torch.randint(len(near), (count,), generator=rng).to(self.device)]])

    def save(self, path: Path) -> None:
        """Writes everything needed to go on, atomically."""
        tensors = {f"field.{k}": v.detach().contiguous() for k, v in self.field.state_dict().items()}
        for number, parameter in enumerate(self.parameters()):
            state = self.optimizer.state.get(parameter)
            if state:
                for key, value in state.items():
                    tensors[f"adam.{number}.{key}"] = torch.as_tensor(value).detach().contiguous()
        if self.cache is not None:
            tensors["cache"] = self.cache
        about = {
            "iteration": self.iteration, "iterations": self.iterations, "seconds": self.seconds,
            "active": self.field.active, "view_dependence": self.field.view_dependence,
            "size": self.recipe.size.to_dict(),
        }  # fmt: skip
        # As bytes: safetensors' own writer does not raise OSError where the disk is full.
        with replacing(path) as partial:
            partial.write_bytes(safetensors.torch.save(tensors, metadata={"about": json.dumps(about)}))

    def load(self, path: Path) -> bool:
        """Goes on from a checkpoint; False where there is none that fits."""
        try:
            with safe_open(str(path), "pt") as file:
                about = json.loads(file.metadata()["about"])
                if about["size"] != json.loads(json.dumps(self.recipe.size.to_dict())):
                    return False
                tensors = {key: file.get_tensor(key).to(self.device) for key in file.keys()}
        except (OSError, SafetensorError, KeyError, TypeError, ValueError):
            return False
        self.field.load_state_dict({k[6:]: v for k, v in tensors.items() if k.startswith("field.")})
        for number, parameter in enumerate(self.parameters()):
            names = [k for k in tensors if k.startswith(f"adam.{number}.")]
            if names:
                self.optimizer.state[parameter] = {k.split(".")[2]: tensors[k] for k in names}
        self.iteration, self.iterations = about["iteration"], about["iterations"]
        self.seconds, self.field.active = about["seconds"], about["active"]
        self.field.view_dependence = about["view_dependence"]
        self.cache = tensors.get("cache")
        return True

    def parameters(self) -> list[torch.nn.Parameter]:
        """The optimiser's parameters in a fixed order."""
        return [p for group in self.optimizer.param_groups for p in group["params"]]
