"""Trains a field on posed photos: presets, rays, the losses of a step, checkpoints, and the trained field."""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from PIL import Image
from safetensors import SafetensorError, safe_open
from torch import Tensor

from pipeline.cameras import PosedPhotos, Similarity, View
from pipeline.field.exposure import Exposure, color_error, matched
from pipeline.field.grid_field import FieldSize, GridField, differences, stencil
from pipeline.field.rendering import BACKGROUND_SAMPLES, Samples, choose_samples, composite, render, sdf_cache
from pipeline.field.supervision import (
    FreeSpace,
    Supervision,
    depth_points,
    depth_scale,
    stereo_points,
    supervision_of,
    unit_sphere_of,
)
from pipeline.inputs.images import BACKDROP
from pipeline.inputs.photos import load_photos, open_mask, open_photo
from pipeline.stereo.depth import only, outside_mask, stereo, stereo_summary
from pipeline.stereo.fusion import Fused, fuse, save_far, surrounding_distance
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_bytes, write_json
from sdfsim.base.parallel import Progress, choose_threads, share_of, silent

# Steps between updates of the cached SDF, fewer at first; a multiple, so that both fall on the same steps.
EARLY, EARLY_PERIOD, PERIOD = 288, 16, 48
REFINED = 0.4  # of the training after which bricks are added where the surface is
# From a sphere: share of the training until all levels are active, and until the search for filled free space begins.
# From fused depth both start at once, because coarse levels alone would fill existing hollows.
ALL_LEVELS, HOLLOWS = 0.45, 0.25
# First scale of the density for training from fused depth, in cells of the last dense level: small, because the surface
# is known.
FUSED_BETA = 1.5
EXPOSURE_RATE = 0.004  # Adam's rate for the photos' gains and offsets, at the start
# Standard deviation of the gains above which held-out photos are compared at their own exposure; in rendered sets with
# one exposure it was below 0.01.
VARIED = 0.03
# Adam's rate for the background, at the start: its values count ten times, and more made it noisy.
BACKGROUND_RATE = 0.002
FEWEST_STEPS = 100  # for any budget
PACE = 25  # steps between checks of the clock
# One in this many pixels along each side of a held-out photo is rendered, if that leaves this many on the long side.
SCORED, LEAST_SCORED = 3, 100
STEREO = 0.2  # share of the displayed progress
HELD_OUT = "held_out"  # folder of the renders of held-out photos
EMPTY = 0.9  # grey of pixels whose ray misses the trained sphere


@dataclass(frozen=True)
class Settings:
    """Settings of the training of a field. Lengths are in normalised units (the scene is the unit sphere)."""

    size: FieldSize = FieldSize()  # noqa: RUF009  frozen
    start_radius: float = 0.25  # of the ball at the start; small, because shadowed parts are hardly removed
    iterations: int = 900  # steps of Adam
    rays: int = 512  # per step
    samples: int = 32  # along a ray inside the sphere
    long_side: int = 480  # of the photos used, px
    stereo: int = 640  # px of the longer side for depth from stereo
    beta: tuple[float, float] = (0.1, 0.004)  # density scale at the start and at the end
    rate: float = 0.02  # Adam's rate for the grids at the start (the networks use a quarter of it)
    eikonal: float = 0.1  # weight of (|grad| - 1)^2
    curvature: float = 0.01  # weight of |Laplacian| at the start, in units of the finest active cell
    sparse: float = 0.3  # weight of |sdf| at the points of structure-from-motion
    depth: float = 0.3  # weight of |sdf| at the points of a depth sensor, at the start
    free: float = 0.3  # weight of solid matter between a camera and a point that it sees
    mask: float = 0.3  # weight of the opacity loss if photos have masks
    exposure: float = 0.02  # weight of the penalty on differences of exposure
    surface_points: int = 512  # points of the eikonal loss


PRESETS = {
    "quick": Settings(),
    "standard": Settings(iterations=3000, rays=768, samples=40, long_side=800, stereo=800, beta=(0.1, 0.0025)),
}


@dataclass(frozen=True)
class Rays:
    """All pixels of some views whose ray meets the unit sphere."""

    rgb: Tensor  # [N, 3] uint8
    mask: Tensor | None  # [N] uint8 (255 = object), or None
    view: Tensor  # [N] int16 index into the camera tables
    pixel: Tensor  # [N, 2] int16 column and row
    intrinsics: Tensor  # [V, 4] focal, cx, cy, k of the downscaled photos
    rotation: Tensor  # [V, 3, 3] world to camera
    center: Tensor  # [V, 3] camera centres
    sizes: Tensor  # [V, 2] width and height of the downscaled photos

    def __len__(self) -> int:
        return len(self.rgb)

    def to(self, device: str) -> "Rays":
        """The same rays on another device."""
        moved: dict[str, Any] = {name: None if part is None else part.to(device) for name, part in vars(self).items()}
        return Rays(**moved)

    def at(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and unit directions [R, 3] of the rays with these indices [R]."""
        view = self.view[index].long()
        return camera_rays(
            self.intrinsics[view], self.rotation[view], self.center[view], self.pixel[index].float() + 0.5
        )

    def batch(self, count: int, seed: int, iteration: int) -> Tensor:
        """Indices [count] of a random batch; it depends only on its arguments, so a resumed run draws the same."""
        rng = torch.Generator().manual_seed(seed * 1_000_003 + iteration)
        return torch.randint(len(self), (count,), generator=rng).to(self.rgb.device)


def camera_rays(intrinsics: Tensor, rotation: Tensor, center: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Rays through pixels (a fast version of `View.rays`): intrinsics [R, 4], rotation [R, 3, 3], uv [R, 2]."""
    distorted = (uv - intrinsics[:, 1:3]) / intrinsics[:, :1]
    xy = distorted
    for _ in range(8):
        xy = distorted / (1 + intrinsics[:, 3:] * (xy * xy).sum(1, keepdim=True).clamp_max(4))
    local = torch.cat([xy, torch.ones_like(xy[:, :1])], 1)
    direction = (local[:, None] @ rotation)[:, 0]
    return center, direction / direction.norm(dim=1, keepdim=True)


def load_rays(views: Sequence[View], photos_folder: Path, long_side: int, *, masks: bool) -> Rays:
    """Reads the photos of `views` (in normalised space), downscaled to `long_side` px, and their masks. Raises
    SdfsimError if a photo or a mask is missing."""
    rgb, mask, view_of, pixel, intrinsics, sizes = [], [], [], [], [], []
    for index, view in enumerate(views):
        pixels = np.asarray(open_photo(photos_folder, view, long_side=long_side))
        size = pixels.shape[1::-1]
        sx, sy = size[0] / view.width, size[1] / view.height
        intrinsics.append([view.focal * (sx + sy) / 2, view.cx * sx, view.cy * sy, view.k])
        sizes.append(size)
        column, row = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        column, row = column.ravel(), row.ravel()
        direction = view.rays((column + 0.5) / sx, (row + 0.5) / sy)
        along = -(direction @ view.center)
        # Rays that miss the sphere carry no information about its inside.
        meets = ((view.center**2).sum() - along**2 < 0.998) & (along > 0)
        rgb.append(pixels.reshape(-1, 3)[meets])
        if masks:
            mask.append(open_mask(photos_folder, view, size).reshape(-1)[meets])
        view_of.append(np.full(meets.sum(), index, np.int16))
        pixel.append(np.stack([column[meets], row[meets]], 1).astype(np.int16))
    return Rays(
        rgb=torch.from_numpy(np.concatenate(rgb)),
        mask=torch.from_numpy(np.concatenate(mask)) if masks else None,
        view=torch.from_numpy(np.concatenate(view_of)),
        pixel=torch.from_numpy(np.concatenate(pixel)),
        intrinsics=torch.tensor(intrinsics, dtype=torch.float32),
        rotation=torch.tensor(np.array([v.rotation for v in views]), dtype=torch.float32),
        center=torch.tensor(np.array([v.center for v in views]), dtype=torch.float32),
        sizes=torch.tensor(sizes),
    )


def held_out(count: int) -> list[int]:
    """Indices of the held-out views: every 8th, or none if there are too few photos."""
    return list(range(4, count, 8)) if count >= 16 else []


class Trainer:
    """One training run of the grids. Rays, sparse points, lines of sight, and fused depth, from which it starts if
    available, are in the space of the unit sphere."""

    def __init__(self, settings: Settings, rays: Rays, supervision: Supervision, seed: int, device: str = "cpu",
                 fused: Fused | None = None):  # fmt: skip
        self.settings, self.rays, self.seed, self.device = settings, rays.to(device), seed, device
        self.fused, self.refined = fused, False
        self.points, self.point_weights = (
            torch.tensor(values, dtype=torch.float32, device=device)
            for values in (supervision.points, supervision.weights)
        )
        self.depth = torch.tensor(supervision.depth, dtype=torch.float32, device=device)
        self.free = FreeSpace(supervision.sight, settings.size.finest, device)
        self.begin()
        self.cache: Tensor | None = None

    def begin(self) -> None:
        """Sets everything to the state before the first step."""
        settings = self.settings
        self.field = GridField(settings.size, self.seed, settings.start_radius, self.fused).to(self.device)
        self.exposure = Exposure(len(self.rays.center)).to(self.device)
        self.optimizer = self.new_optimizer()
        self.iteration, self.iterations, self.seconds, self.refined = 0, self.settings.iterations, 0.0, False

    def new_optimizer(self) -> torch.optim.Adam:
        """The optimiser of the field, in its initial state."""
        field = self.field
        networks = [p for name, p in field.named_parameters() if not name.startswith(("grids", "bricks", "background"))]
        features = [*field.grids, *(level.values for level in field.bricks)]
        groups = (
            (features, self.settings.rate), (networks, self.settings.rate / 4),
            ([*field.background.parameters()], BACKGROUND_RATE), ([*self.exposure.parameters()], EXPOSURE_RATE),
        )  # fmt: skip
        parameters = [{"params": some, "lr": rate, "base": rate} for some, rate in groups]  # "base" is the full rate
        return torch.optim.Adam(parameters, betas=(0.9, 0.99), eps=1e-12, fused=True)

    @property
    def fraction(self) -> float:
        """Finished share of the training."""
        return self.iteration / self.iterations

    @property
    def beta(self) -> float:
        """Scale of the density, normalised units: falls geometrically over the first 85 % of training, then stays."""
        start, end = self.settings.beta
        if self.fused is not None:
            start = max(end, min(start, FUSED_BETA * self.settings.size.sampling))
        return start * (end / start) ** min(1.0, self.fraction / 0.85)

    def rate_factor(self) -> float:
        """Factor of the learning rates: short warm-up, then cosine down to 3 %."""
        warm = min(1.0, self.fraction / 0.02)
        return max(0.05, warm) * (0.03 + 0.97 * 0.5 * (1 + math.cos(math.pi * self.fraction)))

    @property
    def period(self) -> int:
        """Steps between updates of the cache; depends only on the iteration, so that a resumed run does the same."""
        return EARLY_PERIOD if self.iteration < EARLY else PERIOD

    def refresh(self) -> None:
        """Updates the cached SDF and the active levels."""
        # Two levels at first, then the others one by one.
        levels = len(self.settings.size.steps)
        used = 1.0 if self.fused is not None else self.fraction / ALL_LEVELS
        self.field.active = min(levels, 2 + int((levels - 2) * used + 0.4))
        # At first colour does not depend on direction, because otherwise it could hide a wrong surface.
        self.field.view_dependence = min(1.0, max(0.0, (self.fraction - 0.4) / 0.3))
        self.cache = sdf_cache(self.field, self.settings.size.sampling)
        if self.fraction >= REFINED and not self.refined:
            self.refine()
        self.find_filled()

    def refine(self) -> None:
        """Adds bricks where the surface is now; the optimiser keeps its state for existing features."""
        assert self.cache is not None
        self.refined = True
        for before, level in zip(self.field.refine(self.cache), self.field.bricks, strict=True):
            now = level.values
            assert isinstance(now, torch.nn.Parameter)
            for group in self.optimizer.param_groups:
                group["params"] = [now if p is before else p for p in group["params"]]
            state = self.optimizer.state.pop(before, {})
            for key, value in state.items():
                if value.shape == before.shape:
                    state[key] = torch.cat([value, value.new_zeros(len(now) - len(before), now.shape[1])])
            if state:
                self.optimizer.state[now] = state

    def find_filled(self) -> None:
        """Finds free space that the cached SDF fills, as soon as the field is fine enough for a hollow."""
        # Depends only on the step at which the cache was made, so that a resumed run finds the same.
        made = self.iteration - self.iteration % self.period
        early = self.fused is None and made <= HOLLOWS * self.iterations
        if self.cache is not None and not early and len(self.free):
            self.free.look(self.cache, torch.Generator().manual_seed((self.seed + 11) * 1_000_003 + made))

    def sample(self, origins: Tensor, directions: Tensor, uniforms: Tensor) -> Samples:
        """Samples [R, S] along rays [R, 3], one for each of the uniforms [R, S]."""
        if self.cache is None or self.iteration % self.period == 0:
            self.refresh()
        assert self.cache is not None
        return choose_samples(self.cache, origins, directions, self.beta, uniforms)

    def slope_losses(self, sdf: Tensor, width: float) -> dict[str, Tensor]:
        """Losses of gradient and curvature from the field's values on stencils of a width."""
        gradient, laplacian = differences(sdf.view(-1, 7), width)
        fade = self.settings.curvature * max(0.03, 1 - self.fraction / 0.7)
        return {
            "eikonal": ((gradient.norm(dim=1) - 1) ** 2).mean() * self.settings.eikonal,
            "curvature": (laplacian.abs() * width).clamp_max(10).mean() * fade,
        }

    def step(self) -> dict[str, float]:
        """One step of Adam; returns the losses."""
        settings, field = self.settings, self.field
        rng = torch.Generator().manual_seed((self.seed + 7) * 1_000_003 + self.iteration)
        index = self.rays.batch(settings.rays, self.seed, self.iteration)
        origins, directions = self.rays.at(index)
        truth = self.rays.rgb[index].float() / 255
        uniforms = torch.rand(settings.rays, settings.samples + BACKGROUND_SAMPLES, generator=rng).to(self.device)
        samples = self.sample(origins, directions, uniforms[:, : settings.samples])
        behind = torch.full((3,), BACKDROP, device=self.device)
        if self.rays.mask is None:
            behind = field.background.along(origins, directions, uniforms[:, settings.samples :])
        cell = settings.size.steps[field.active - 1]
        slopes = stencil(self.regularised(samples, rng), cell).view(-1, 3)
        pick = torch.randint(max(1, len(self.points)), (min(256, len(self.points)),), generator=rng).to(self.device)
        empty, clearance = self.free.pick(512, rng)
        measured = torch.randint(max(1, len(self.depth)), (min(512, len(self.depth)),), generator=rng).to(self.device)
        # One query for all, because each query fills a gradient buffer as large as the grids.
        parts = [samples.points.view(-1, 3), slopes, self.points[pick], empty, self.depth[measured]]
        sdf, geometry, more = (
            values.split([len(part) for part in parts]) for values in field.geometry_at(torch.cat(parts))
        )
        out = composite(field, samples, (sdf[0], geometry[0], more[0]), self.beta, behind)
        opacity = None if self.rays.mask is None else out["opacity"]
        rgb = self.exposure(out["rgb"], opacity, BACKDROP, self.rays.view[index].long())
        losses = {"color": color_error(rgb, truth), "exposure": self.exposure.penalty() * settings.exposure}
        if self.rays.mask is not None:
            wanted = self.rays.mask[index].float() / 255
            opacity = out["opacity"].clamp(1e-4, 1 - 1e-4)
            losses["mask"] = torch.nn.functional.binary_cross_entropy(opacity, wanted) * settings.mask
        losses |= self.slope_losses(sdf[1], cell)
        if len(pick):
            # Robust, so that a wrong point does not create a surface.
            pull = self.point_weights[pick] * sdf[2].abs().clamp_max(0.1)
            losses["sparse"] = pull.mean() * settings.sparse
        if len(empty):
            losses["free"] = torch.relu(clearance - sdf[3]).mean() * settings.free
        if len(measured):
            # It gives the shape early on. Later, colours resolve finer detail than the sensor's noise, though not finer
            # than stereo.
            fade = max(0.03, 1 - self.fraction / 0.5) if self.fused is None else 1.0
            losses["depth"] = sdf[4].abs().clamp_max(0.1).mean() * settings.depth * fade
        self.optimizer.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        for group in self.optimizer.param_groups:
            group["lr"] = group["base"] * self.rate_factor()
        self.optimizer.step()
        self.iteration += 1
        return {name: float(value.detach()) for name, value in losses.items()}

    def regularised(self, samples: Samples, rng: torch.Generator) -> Tensor:
        """Points [P, 3] of the sphere for the eikonal and curvature losses, half of them near the surface."""
        count = self.settings.surface_points // 2
        free = torch.randn(count, 3, generator=rng)
        radius = torch.rand(count, 1, generator=rng) ** (1 / 3)
        free = (free / free.norm(dim=1, keepdim=True) * radius).to(self.device)
        near = samples.points[samples.near_surface]
        return torch.cat([free, near[torch.randint(len(near), (count,), generator=rng).to(self.device)]])

    def save(self, path: Path) -> None:
        """Writes everything needed to resume, atomically."""
        tensors = {f"field.{k}": v.detach().contiguous() for k, v in self.field.state_dict().items()}
        for number, parameter in enumerate(self._parameters()):
            for key, value in self.optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{number}.{key}"] = torch.as_tensor(value).detach().contiguous()
        if self.cache is not None:
            tensors["cache"] = self.cache
        tensors["exposure"] = self.exposure.change.detach().contiguous()
        about = {
            "iteration": self.iteration, "iterations": self.iterations, "seconds": self.seconds,
            "active": self.field.active, "view_dependence": self.field.view_dependence, "refined": self.refined,
            "size": str(self.settings.size),
        }  # fmt: skip
        # As bytes, because safetensors' own writer does not raise OSError if the disk is full.
        write_bytes(path, safetensors.torch.save(tensors, metadata={"about": json.dumps(about)}))

    def load(self, path: Path) -> bool:
        """Resumes from a checkpoint; False if there is none. Raises SdfsimError if a checkpoint cannot be read or
        belongs to another field; the training is then in the state before its first step."""
        if not path.exists():
            return False
        try:
            with safe_open(str(path), "pt") as file:
                about = json.loads(file.metadata()["about"])
                if about["size"] != str(self.settings.size):
                    raise ValueError("it is of another field")
                tensors = {key: file.get_tensor(key).to(self.device) for key in file.keys()}
            self.field.load_state_dict({k[6:]: v for k, v in tensors.items() if k.startswith("field.")})
            self.exposure.load_state_dict({"change": tensors["exposure"]})
            self.optimizer = self.new_optimizer()
            for number, parameter in enumerate(self._parameters()):
                names = [k for k in tensors if k.startswith(f"adam.{number}.")]
                if names:
                    self.optimizer.state[parameter] = {k.split(".")[2]: tensors[k] for k in names}
            self.iteration, self.iterations = int(about["iteration"]), int(about["iterations"])
            self.seconds, self.field.active = float(about["seconds"]), int(about["active"])
            self.field.view_dependence, self.refined = float(about["view_dependence"]), bool(about["refined"])
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
            self.begin()
            raise SdfsimError(f"{path.name} cannot be read ({' '.join(str(error).split())[:80]})") from error
        self.cache = tensors.get("cache")
        self.find_filled()
        return True

    def _parameters(self) -> list[torch.nn.Parameter]:
        """The optimiser's parameters in a fixed order."""
        return [p for group in self.optimizer.param_groups for p in group["params"]]


@dataclass
class Trained:
    """A trained field, its density scale, the transform from the world of the poses to its unit sphere, and its
    report."""

    field: GridField
    beta: float
    to_unit: Similarity
    report: dict


def train(
    poses: PosedPhotos, photos_folder: Path, out: Path, *, settings: Settings,
    budget: float | None = None, seed: int = 0, device: str = "cpu", threads: int | None = None,
    checkpoint_every: float = 60.0, on_progress: Progress = silent,
) -> Trained:  # fmt: skip
    """Trains a field and writes `field.safetensors` and `field.json` to `out`; resumes from `checkpoint.safetensors`.

    The poses are those of structure-from-motion. The budget, s, includes training before a kill: the number of steps is
    reduced to fit. Without `threads` the CPU uses the number that is fastest now. If the checkpoint of a killed run
    cannot be read, training begins again, and a note in the report says so. Raises SdfsimError if the loss is no longer
    finite.
    """
    photos = load_photos(photos_folder)
    masked = all(photo.mask for photo in photos)
    to_unit = unit_sphere_of(poses, masked=masked)
    local = poses.moved(to_unit)
    test = held_out(len(local.views))
    training = [view for number, view in enumerate(local.views) if number not in test]
    rays = load_rays(training, photos_folder, settings.long_side, masks=masked)
    depth, agreed, noise = None, {}, 0.0
    start: Callable[[Tensor], Tensor] | None = None
    if any(photo.depth for photo in photos):
        agreed = depth_scale(poses, depth_points(poses.views, photos, photos_folder))
        depth, noise = depth_points(poses.views, photos, photos_folder, scale=agreed["scale"]), agreed["spread"]
    begun = time.monotonic()
    seen = only(local, [number for number in range(len(local.views)) if number not in test])
    maps = stereo(seen, photos_folder, settings.stereo, on_progress=share_of(on_progress, 0.0, STEREO))
    carved = [outside_mask(one, photos_folder) for one in maps] if masked else maps
    fused = fuse(carved, settings.size.levels[-1], photos_folder) if maps else None
    around = None if masked else surrounding_distance(maps)
    if around is not None:
        save_far(around, out)
    spent = time.monotonic() - begun
    paired = {"seconds": round(spent, 1), "fused": fused is not None, **stereo_summary(maps, seen)}
    budget = None if budget is None else budget - spent
    if fused is not None and depth is None:
        depth, noise = stereo_points(maps, local), paired["spread"]
        untrained = GridField(settings.size, seed, settings.start_radius, fused)
        start = lambda points: untrained.start_of(points)[0]  # noqa: E731
    supervision = supervision_of(local, settings.size.finest, depth, noise, start)
    trainer = Trainer(settings, rays, supervision, seed, device, fused)
    checkpoint = out / "checkpoint.safetensors"
    resumed, notes = False, []
    try:
        resumed = trainer.load(checkpoint)
    except SdfsimError as error:  # The rest of the killed run is of no use.
        notes = [f"what a killed run had trained is lost: {error.message}; training began again"]
        on_progress(0.0, notes[0])
    per_step = calibrate(Trainer(settings, trainer.rays, supervision, seed, device, fused), threads)
    if budget is not None and not resumed:
        trainer.iterations = min(settings.iterations, max(FEWEST_STEPS, int(budget / per_step)))
    left = None if budget is None else budget - trainer.seconds
    saved = started = time.monotonic()
    first, before = trainer.iteration, trainer.seconds
    smooth: dict[str, float] = {}
    while trainer.iteration < trainer.iterations:
        losses = trainer.step()
        smooth = {k: 0.95 * smooth.get(k, v) + 0.05 * v for k, v in losses.items()}
        if not all(math.isfinite(v) for v in losses.values()):
            raise SdfsimError("distill: the loss is no longer finite", "look at the poses: `sdfsim poses`")
        now = time.monotonic()
        trainer.seconds = before + now - started
        if left is not None and trainer.iteration % PACE == 0:
            trainer.iterations = paced(trainer, settings, left, now - started, trainer.iteration - first)
        if now - saved > checkpoint_every:
            trainer.save(checkpoint)
            saved = now
        if trainer.iteration % 10 == 0:
            done = STEREO + (0.92 - STEREO) * trainer.fraction
            on_progress(done, f"step {trainer.iteration} of {trainer.iterations}, "
                        f"colour error {smooth['color']:.4f}")  # fmt: skip
    trainer.save(checkpoint)
    trainer.refresh()
    scores = {}
    if test:
        held, report = [local.views[i] for i in test], share_of(on_progress, 0.92, 0.08)
        scores = score(held, photos_folder, trainer, out, masked=masked, on_progress=report)
    report = {
        "iterations": trainer.iterations, "rays": len(rays), "train_seconds": round(trainer.seconds, 1),
        "seconds_before": round(before, 1), "resumed": resumed, "masked": masked, "beta": trainer.beta,
        "threads": torch.get_num_threads(), "losses": {k: round(v, 5) for k, v in smooth.items()}, **scores,
        "depth": agreed, "stereo": paired, "notes": notes,
        "exposure_spread": round(trainer.exposure.spread(), 4),
    }  # fmt: skip
    trained = Trained(trainer.field.cpu(), trainer.beta, to_unit, report)
    save_field(trained, out)
    checkpoint.unlink(missing_ok=True)
    return trained


def score(views: list[View], photos_folder: Path, trainer: Trainer, out: Path, *, masked: bool,
          on_progress: Progress = silent) -> dict:  # fmt: skip
    """PSNR of held-out views, in normalised space, for the report, at the training resolution (`psnr_px` on the long
    side); empty if none shows any part of the unit sphere. For large photos one in `SCORED` pixels along each side is
    rendered; writes these pictures to `out`/held_out."""
    rays = load_rays(views, photos_folder, trainer.settings.long_side, masks=False).to(trainer.device)
    shown: list[int] = rays.view.unique().tolist()
    if not shown:
        return {}
    backdrop = torch.full((3,), BACKDROP, device=trainer.device) if masked else None
    (out / HELD_OUT).mkdir(exist_ok=True)
    psnr = []
    for count, number in enumerate(shown, 1):
        decibels, picture = compare(rays, number, trainer, backdrop)
        psnr.append(decibels)
        Image.fromarray(picture).save(out / HELD_OUT / views[number].name, quality=92)
        on_progress(count / len(shown), f"held-out view {count} of {len(shown)}")
    return {
        "held_out_photos": [views[number].source for number in shown],
        "psnr": round(float(np.mean(psnr)), 2), "psnr_each": [round(value, 2) for value in psnr],
        "psnr_px": int(rays.sizes.max()),
    }  # fmt: skip


@torch.no_grad()
def compare(rays: Rays, number: int, trainer: Trainer, backdrop: Tensor | None) -> tuple[float, np.ndarray]:
    """PSNR, dB, and render [H, W, 3] uint8 of one view, over pixels whose ray meets the unit sphere; for large photos
    one in `SCORED` pixels along each side."""
    assert trainer.cache is not None
    every = SCORED if rays.sizes.max() >= SCORED * LEAST_SCORED else 1
    index = torch.nonzero((rays.view == number) & (rays.pixel % every == every // 2).all(1))[:, 0]
    parts = []
    for part in index.split(4096):
        origins, directions = rays.at(part)
        parts.append(
            render(trainer.field, trainer.cache, origins, directions, trainer.beta,
                   samples=trainer.settings.samples, backdrop=backdrop)["rgb"]
        )  # fmt: skip
    rgb, truth = torch.cat(parts), rays.rgb[index].float() / 255
    if backdrop is None and trainer.exposure.spread() > VARIED:
        rgb = matched(rgb, truth)
    error = float(((rgb - truth) ** 2).mean())
    width, height = (-(-(int(side) - every // 2) // every) for side in rays.sizes[number])
    picture = np.full((height, width, 3), EMPTY)
    column, row = rays.pixel[index].cpu().numpy().T // every
    picture[row, column] = rgb.cpu().numpy()
    return -10 * math.log10(max(error, 1e-10)), (255 * picture.clip(0, 1) + 0.5).astype(np.uint8)


def calibrate(probe: Trainer, threads: int | None) -> float:
    """Seconds per step, late in training; sets the number of threads to `threads`, or to the fastest."""
    probe.iteration, probe.iterations = 9701, 10_000  # Late in training all levels are active.
    probe.refresh()
    return choose_threads(probe.step, threads if probe.device == "cpu" else torch.get_num_threads())


def paced(trainer: Trainer, settings: Settings, budget: float, elapsed: float, done: int) -> int:
    """Steps that fit into the budget (s) after `done` steps in `elapsed` s, because the pace changes with other
    work."""
    left = int((budget - elapsed) / (elapsed / done))
    wanted = trainer.iteration + left
    if left > 0:  # Schedules follow the finished share, which must not jump.
        wanted = min(max(wanted, int(0.9 * trainer.iterations)), int(1.1 * trainer.iterations))
    return max(trainer.iteration, min(FEWEST_STEPS, settings.iterations), min(wanted, settings.iterations))


def save_field(trained: Trained, folder: Path) -> None:
    """Writes `field.safetensors`, then `field.json`."""
    field = trained.field
    tensors = {k: v.detach().cpu().contiguous() for k, v in field.state_dict().items()}
    write_bytes(folder / "field.safetensors", safetensors.torch.save(tensors))
    about = {
        "version": 1, "size": asdict(field.size), "start_radius": field.start_radius, "beta": trained.beta,
        "to_unit": trained.to_unit.to_dict(), "report": trained.report,
    }  # fmt: skip
    write_json(folder / "field.json", about)


def load_field(folder: Path) -> Trained:
    """Reads the output of `train`. Raises SdfsimError if `folder` has no readable field."""
    try:
        about = json.loads((folder / "field.json").read_text(encoding="utf-8"))
        size, radius = about["size"], float(about["start_radius"])
        lists = {key: tuple(size[key]) for key in ("levels", "channels")}
        field = GridField(FieldSize(**{**size, **lists}), start_radius=radius)
        with safe_open(str(folder / "field.safetensors"), "pt") as file:
            field.load_state_dict({key: file.get_tensor(key) for key in file.keys()})
        return Trained(field, float(about["beta"]), Similarity.from_dict(about["to_unit"]), about["report"])
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise SdfsimError(f"{folder}: no trained field", "run the distill stage first") from error
