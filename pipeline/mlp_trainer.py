"""Trains the MLP of the VolSDF paper as the paper does: error-bounded samples, learned beta, eikonal loss."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.error_bound import bounded_samples
from pipeline.field import BACKGROUND_SAMPLES, Field
from pipeline.mlp_field import MlpField, MlpSize
from pipeline.photo_file import BACKDROP
from pipeline.render import Samples, composite, sdf_cache, sphere_interval
from pipeline.trainer import CACHE, Trainer

BACKGROUND_RATE = 0.02  # of the background's grid


class MlpTrainer(Trainer):
    """One training run of the paper's field; arguments as of `Trainer`."""

    field: MlpField
    converged = 0.0  # share of the last step's rays whose opacity is bounded

    def fresh(self) -> tuple[Field, torch.optim.Adam]:
        """A field that is a sphere, and its optimiser."""
        recipe = self.recipe
        assert isinstance(recipe.size, MlpSize)
        field = MlpField(recipe.size, self.seed, recipe.start_radius).to(self.device)
        networks = [p for name, p in field.named_parameters() if name != "background"]
        groups = [
            {"params": networks, "lr": recipe.rate, "base": recipe.rate},
            {"params": [field.background], "lr": BACKGROUND_RATE, "base": BACKGROUND_RATE},
        ]
        return field, torch.optim.Adam(groups)

    @property
    def beta(self) -> float:
        """Learned scale of the density, normalised units."""
        return float(self.field.beta.detach())

    def refresh(self) -> None:
        """Brings the cached SDF up to date, which only pictures are made from."""
        self.cache = sdf_cache(self.field, CACHE)

    def show(self) -> None:
        """The same: training does not use the cached SDF."""
        self.refresh()

    def look(self) -> None:
        """The paper knows nothing of free space."""

    def sample(self, origins: Tensor, directions: Tensor, uniforms: Tensor) -> Samples:
        """Samples [R, S] that bound the error of the opacity, for as many uniforms [R, S]."""
        enter, leave = sphere_interval(origins, directions)

        def sdf_at(rays: Tensor, distance: Tensor) -> Tensor:
            points = origins[rays, None] + distance[..., None] * directions[rays, None]
            return torch.cat([self.field.sdf(part) for part in points.view(-1, 3).split(1 << 18)]).view(distance.shape)

        distance, converged = bounded_samples(sdf_at, enter, leave, self.field.beta, uniforms)
        self.converged = float(converged.float().mean())
        edge = torch.cat([enter[:, None], (distance[:, 1:] + distance[:, :-1]) / 2, leave[:, None]], 1)
        points = origins[:, None] + distance[..., None] * directions[:, None]
        near = torch.ones_like(distance, dtype=torch.bool)
        return Samples(distance, edge[:, 1:] - edge[:, :-1], points, directions, near)

    def step(self) -> dict[str, float]:
        """One step of Adam; returns the losses."""
        recipe, field = self.recipe, self.field
        rng = torch.Generator().manual_seed((self.seed + 7) * 1_000_003 + self.iteration)
        index = self.rays.batch(recipe.rays, self.seed, self.iteration)
        origins, directions = self.rays.at(index)
        truth = self.rays.rgb[index].float() / 255
        uniforms = torch.rand(recipe.rays, recipe.samples + BACKGROUND_SAMPLES, generator=rng).to(self.device)
        samples = self.sample(origins, directions, uniforms[:, : recipe.samples])
        behind = torch.full((3,), BACKDROP, device=self.device)
        if self.rays.mask is None:
            behind = field.background_along(origins, directions, uniforms[:, recipe.samples :])
        pick = torch.randint(max(1, len(self.points)), (min(256, len(self.points)),), generator=rng).to(self.device)
        parts = [samples.points.view(-1, 3), self.regularised(samples, rng), self.points[pick]]
        sdf, features, more = field.geometry_at(torch.cat(parts))
        rendered, regular = len(parts[0]), len(parts[0]) + len(parts[1])
        out = composite(field, samples, (sdf[:rendered], features[:rendered], more[:rendered]), field.beta, behind)
        losses = {"color": (out["rgb"] - truth).abs().mean()}
        if self.rays.mask is not None:
            wanted = self.rays.mask[index].float() / 255
            opacity = out["opacity"].clamp(1e-4, 1 - 1e-4)
            losses["mask"] = torch.nn.functional.binary_cross_entropy(opacity, wanted) * recipe.mask
        slope = more[rendered:regular, 3:].norm(dim=1)
        losses["eikonal"] = ((slope - 1) ** 2).mean() * recipe.eikonal
        if len(pick):
            pull = self.point_weights[pick] * sdf[regular:].abs().clamp_max(0.1)
            losses["sparse"] = pull.mean() * recipe.sparse
        return self.update(losses, 0.1**self.fraction)


def trainer_for(size: object) -> type[Trainer]:
    """The trainer of an encoding."""
    return MlpTrainer if isinstance(size, MlpSize) else Trainer
