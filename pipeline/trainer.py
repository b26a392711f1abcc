"""One training run of the field: VolSDF's losses, and a state that can be saved and resumed."""

from __future__ import annotations

import json
from pathlib import Path

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from pipeline.field import (
    BACKGROUND_SAMPLES,
    Field,
    FieldSize,
    GridField,
    differences,
    level_step,
    stencil,
)
from pipeline.landmarks import FreeSpace, Landmarks
from pipeline.photo_file import BACKDROP
from pipeline.rays import Rays
from pipeline.recipe import Recipe, active_levels, beta_at, rate_at, view_dependence_at
from pipeline.render import Samples, choose_samples, composite, sdf_cache
from sdfsim.files import replacing

# Steps between updates of the cached SDF, fewer at first; a multiple, so that both fall on the same steps.
EARLY, EARLY_PERIOD, PERIOD = 288, 16, 48
CACHE = 129  # samples a side of the cached SDF; what is thinner than its cells is found by luck only
HOLLOWS = 0.25  # of the training is done before filled free space is looked for


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
        self.points, self.point_weights = (
            torch.tensor(values, dtype=torch.float32, device=device) for values in (landmarks.points, landmarks.weights)
        )
        self.free = FreeSpace(landmarks.sight, device)
        self.field, self.optimizer = self.fresh()
        self.iteration = 0
        self.iterations = recipe.iterations
        self.seconds = 0.0
        self.cache: Tensor | None = None

    def fresh(self) -> tuple[Field, torch.optim.Adam]:
        """A field that nothing was learned by yet, and its optimiser."""
        recipe = self.recipe
        assert isinstance(recipe.size, FieldSize)
        field = GridField(recipe.size, self.seed, recipe.start_radius).to(self.device)
        grids = [*field.grids, field.background]
        networks = [p for name, p in field.named_parameters() if not name.startswith(("grids", "background"))]
        groups = [
            {"params": grids, "lr": recipe.rate, "base": recipe.rate},
            {"params": networks, "lr": recipe.rate / 4, "base": recipe.rate / 4},
        ]
        return field, torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12, fused=True)

    @property
    def beta(self) -> float:
        """Scale of the density now, normalised units."""
        return beta_at(self.recipe, self.fraction)

    @property
    def fraction(self) -> float:
        """Share of the training that is done."""
        return self.iteration / self.iterations

    @property
    def period(self) -> int:
        """Steps between updates of the cache; of the iteration alone, so that a resumed run does the same."""
        return EARLY_PERIOD if self.iteration < EARLY else PERIOD

    def refresh(self) -> None:
        """Brings the cached SDF and the active levels up to date."""
        self.field.active = active_levels(self.recipe, self.fraction)
        self.field.view_dependence = view_dependence_at(self.fraction)
        self.cache = sdf_cache(self.field, CACHE)
        self.look()

    def show(self) -> None:
        """Makes the cached SDF good enough for pictures, without a change to the training."""
        if self.cache is None:
            self.refresh()

    def look(self) -> None:
        """Finds free space that the cached SDF fills, once the field is fine enough to have room for a hollow."""
        # A function of the step at which the cache was made, so that a resumed run finds the same.
        made = self.iteration - self.iteration % self.period
        if self.cache is not None and made > HOLLOWS * self.iterations and len(self.free):
            self.free.look(self.cache, torch.Generator().manual_seed((self.seed + 11) * 1_000_003 + made))

    def step(self) -> dict[str, float]:
        """One step of Adam; returns the losses."""
        recipe, field = self.recipe, self.field
        if self.cache is None or self.iteration % self.period == 0:
            self.refresh()
        assert self.cache is not None
        beta = self.beta
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
        assert isinstance(recipe.size, FieldSize)
        width = level_step(recipe.size.levels, field.active)
        around = stencil(self.regularised(samples, rng), width)
        pick = torch.randint(max(1, len(self.points)), (min(256, len(self.points)),), generator=rng).to(self.device)
        # One query for all: each would otherwise fill a gradient buffer as large as the grids.
        empty, clearance = self.free.pick(512, rng)
        parts = [samples.points.view(-1, 3), around.view(-1, 3), self.points[pick], empty]
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
        if len(empty):
            losses["free"] = torch.relu(clearance - sdf[pinned:]).mean() * recipe.free
        return self.update(losses, rate_at(self.fraction))

    def update(self, losses: dict[str, Tensor], factor: float) -> dict[str, float]:
        """One step of Adam down the sum of the losses, at `factor` of the full rates; returns the losses."""
        self.optimizer.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        for group in self.optimizer.param_groups:
            group["lr"] = group["base"] * factor
        self.optimizer.step()
        self.iteration += 1
        return {name: float(value.detach()) for name, value in losses.items()}

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
        self.look()
        return True

    def parameters(self) -> list[torch.nn.Parameter]:
        """The optimiser's parameters in a fixed order."""
        return [p for group in self.optimizer.param_groups for p in group["params"]]
