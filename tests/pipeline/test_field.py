"""Fields: formulas against closed forms, free space that photos prove, and training as a whole: determinism, held-out
photos, budgets and resuming, and hollows that photos see into."""

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn import functional

from pipeline.cameras import PosedPhotos, Sparse, View
from pipeline.field import supervision, training
from pipeline.field.exposure import Exposure
from pipeline.field.grid_field import (
    BACKGROUND_SAMPLES,
    Background,
    FieldSize,
    differences,
    sample_weights,
    stencil,
)
from pipeline.field.rendering import sdf_cache
from pipeline.field.supervision import (
    GAP,
    NOISES,
    DepthPoints,
    supervision_of,
)
from pipeline.field.training import (
    BACKGROUND_RATE,
    FEWEST_STEPS,
    HELD_OUT,
    PRESETS,
    Trainer,
    camera_rays,
    compare,
    load_field,
    load_rays,
    score,
    train,
)
from pipeline.grids.interpolation import WHOLE, by_rows, interpolate, interpolate_bricks, near_bricks, places_of
from pipeline.inputs.photos import save_photos
from pipeline.report import notes
from pipeline.stereo.fusion import Fused
from sdfsim.base.errors import SdfsimError
from tests.helpers import surfaces
from tests.helpers.balls import Distance, crate, cup, ring, shoot
from tests.helpers.fields import SMALL, assert_resumes, posed_noise, toy_rays
from tests.helpers.photos import photo
from tests.helpers.sparse import NOTHING


def laplace(distance: float, beta: float) -> float:
    """The transmittance at a signed distance from a surface: the Laplace distribution function."""
    return 1 - 0.5 * np.exp(-distance / beta) if distance > 0 else 0.5 * np.exp(distance / beta)


@pytest.mark.parametrize("beta", [0.1, 0.004])
@pytest.mark.parametrize("nearest", [0.02, 0.004, 0.0, -0.004, -0.02])
def test_half_of_a_ray_is_hidden_where_it_touches_a_surface(nearest: float, beta: float):
    # Past a ball, up to `nearest` outside of its surface: it is hidden as by a wall as far away, however long it stays.
    t, radius = torch.linspace(-1, 1, 4001, dtype=torch.float64), 0.3
    sdf = torch.sqrt(t**2 + (radius + nearest) ** 2) - radius
    weights, left = sample_weights(sdf[None], beta)
    first = laplace(sdf[0].item(), beta)
    assert first > 0.99
    assert left.item() == pytest.approx(laplace(nearest, beta), rel=1e-9)
    assert weights.sum().item() + left.item() == pytest.approx(1.0, rel=1e-12)


def test_a_wall_shows_where_it_is():
    # At any slope half of the light ends before the surface and half behind it.
    for slope in (1.0, 0.2):
        t = torch.linspace(0, 1, 4001, dtype=torch.float64)
        weights, left = sample_weights((slope * (0.7 - t))[None], 0.004)
        assert weights[0, t < 0.7].sum().item() == pytest.approx(0.5, abs=0.02)
        assert left.item() == pytest.approx(0.0, abs=1e-6)


def test_differences_on_a_quadratic():
    p = torch.randn(20, 3, dtype=torch.float64)
    values = (stencil(p, 0.01) ** 2).sum(-1)
    gradient, laplacian = differences(values, 0.01)
    assert torch.allclose(gradient, 2 * p) and torch.allclose(laplacian, torch.full_like(laplacian, 6.0), atol=1e-8)


def test_camera_rays_match_the_slow_twin_and_projection():
    rng = np.random.default_rng(0)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    view = View("a", "a", 100, 80, 90.0, 51.0, 39.0, 0.05, q, rng.normal(size=3))
    uv = rng.uniform([0, 0], [100, 80], (50, 2))
    slow = view.rays(uv[:, 0], uv[:, 1])
    tables = [torch.tensor(np.repeat(np.asarray(a)[None], 50, 0), dtype=torch.float64)
              for a in ([view.focal, view.cx, view.cy, view.k], view.rotation, view.center)]  # fmt: skip
    _, fast = camera_rays(*tables, torch.tensor(uv))
    np.testing.assert_allclose(fast.numpy(), slow, atol=1e-7)
    back, depth = view.project(view.center + 2.5 * slow)
    np.testing.assert_allclose(back, uv, atol=1e-4)
    assert (depth > 0).all()


def trainer() -> Trainer:
    settings = replace(PRESETS["quick"], size=SMALL, rays=64, iterations=20, surface_points=32)
    return Trainer(settings, toy_rays(), supervision_of(NOTHING, SMALL.finest), 0)


@pytest.mark.parametrize("damage", ["no checkpoint", "cut short", "another field"])
def test_a_checkpoint_that_cannot_be_read_is_reported_and_leaves_nothing_behind(tmp_path, damage, one_thread):
    path, before, run, untouched = tmp_path / "c.safetensors", trainer(), trainer(), trainer()
    before.step()
    before.save(path)
    whole = path.read_bytes()
    other = whole.replace(b"levels", b"heights", 1).replace(b" ", b"", 1)  # of the same length
    path.write_bytes({"no checkpoint": b"not a checkpoint", "cut short": whole[:-100], "another field": other}[damage])
    with pytest.raises(SdfsimError, match="cannot be read") as caught:
        run.load(path)
    assert "\n" not in caught.value.message
    assert run.iteration == 0 and run.seconds == 0 and not run.optimizer.state
    untouched.step()
    run.step()
    for a, b in zip(untouched.field.parameters(), run.field.parameters(), strict=True):
        assert torch.equal(a, b)


def test_masks_make_what_they_exclude_transparent():
    rays = toy_rays()
    masked = replace(rays, mask=((rays.rgb[:, 0] == 200) * 255).to(torch.uint8))
    settings = replace(PRESETS["quick"], size=SMALL, rays=128, iterations=40, surface_points=32)
    run = Trainer(settings, masked, supervision_of(NOTHING, SMALL.finest), 0)
    losses = [run.step()["mask"] for _ in range(40)]
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])


def test_depth_draws_the_surface_to_where_a_sensor_saw_it():
    """Colours say nothing here (all grey): with the points of a ball of another size the surface goes there. It starts
    nearer than 0.1, from where these points pull."""
    rays = toy_rays()
    grey = replace(rays, rgb=torch.full_like(rays.rgb, 128))
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    ball = 0.33 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    nothing = supervision_of(NOTHING, SMALL.finest)
    settings = replace(PRESETS["quick"], size=SMALL, rays=64, iterations=120, surface_points=64)
    off = []
    for given in (nothing, replace(nothing, depth=ball)):
        run = Trainer(settings, grey, given, 0)
        for _ in range(60):
            run.step()
        with torch.no_grad():
            off.append(float(run.field.sdf(torch.tensor(ball, dtype=torch.float32)).abs().mean()))
    assert off[1] < 0.03 and off[1] < 0.3 * off[0]


def test_train_writes_and_reads_back(tmp_path):
    poses = posed_noise(tmp_path)
    settings = replace(PRESETS["quick"], size=SMALL, rays=32, iterations=6, surface_points=16)
    trained = train(poses, tmp_path, tmp_path, settings=settings, threads=1)
    again = load_field(tmp_path)
    p = torch.randn(10, 3) * 0.4
    with torch.no_grad():
        assert torch.equal(trained.field.sdf(p), again.field.sdf(p))
    assert not (tmp_path / "checkpoint.safetensors").exists()
    assert len(load_rays(poses.moved(trained.to_unit).views, tmp_path, 40, masks=False)) > 0


def twin(grid: Tensor, points: Tensor) -> Tensor:
    """The same by `grid_sample`."""
    found = functional.grid_sample(
        grid.permute(3, 0, 1, 2)[None], points.view(1, 1, 1, -1, 3), padding_mode="border", align_corners=True
    )
    return found.view(grid.shape[3], -1).t()


def assert_alike(found: Tensor, wanted: Tensor, numbers: Tensor, rng: torch.Generator) -> None:
    """Two results, and their gradients by the `numbers` that they come from, are the same."""
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)
    weights = torch.randn(found.shape, generator=rng, dtype=torch.float64)
    one, two = (torch.autograd.grad((result * weights).sum(), numbers)[0] for result in (found, wanted))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("side", "channels"), [(2, 1), (5, 4), (33, 2)])
@pytest.mark.parametrize("way", [interpolate_bricks, by_rows])
def test_values_and_gradient_are_those_of_the_general_sampler(side, channels, way):
    rng = torch.Generator().manual_seed(side)
    grid = torch.randn(side, side, side, channels, generator=rng, dtype=torch.float64, requires_grad=True)
    inside = torch.rand(500, 3, generator=rng, dtype=torch.float64) * 2.4 - 1.2  # some of them outside
    knots = torch.linspace(-1, 1, side, dtype=torch.float64)
    points = torch.cat([inside, torch.cartesian_prod(knots, knots, knots)])
    found, wanted = way(grid.reshape(-1, channels), WHOLE, side, points), twin(grid, points)
    assert_alike(found, wanted, grid, rng)


@pytest.mark.parametrize(("side", "channels"), [(5, 1), (13, 3), (32, 2)])
@pytest.mark.parametrize("way", [interpolate_bricks, by_rows])
def test_a_grid_in_bricks_is_one_that_is_0_where_there_are_none(side, channels, way):
    rng = torch.Generator().manual_seed(side)
    count = -(-side // 4)
    there = torch.rand(count, count, count, generator=rng) < 0.5
    there[0, 0, 0] = True
    numbers = torch.full((count,) * 3, -1, dtype=torch.int32)
    numbers[there] = torch.arange(int(there.sum()), dtype=torch.int32)
    table = torch.randn(64 * int(there.sum()), channels, generator=rng, dtype=torch.float64, requires_grad=True)
    place = torch.from_numpy(places_of(torch.nonzero(there).numpy()))
    inside = (place < side).all(1)
    grid = torch.zeros(side, side, side, channels, dtype=torch.float64)
    grid = grid.index_put(tuple(place[inside].t()), table[inside])
    points = torch.rand(800, 3, generator=rng, dtype=torch.float64) * 2.2 - 1.1
    found, wanted = way(table, numbers, side, points), twin(grid, points)
    assert_alike(found, wanted, table, rng)


def ball_fused(side: int = 24) -> Fused:
    """A ball of radius 0.5, coarsely, and what it has more in bricks near its surface."""
    line = np.linspace(-1, 1, side)
    coarse = (np.linalg.norm(np.stack(np.meshgrid(line, line, line, indexing="ij"), -1), axis=-1) - 0.5) * 1.0
    bricks = near_bricks(coarse, 2 * side - 1)
    place = places_of(bricks)
    true = np.linalg.norm(place * 2 / (2 * side - 2) - 1, axis=1) - 0.5
    rest = true - map_coordinates(coarse, place.T / 2, order=1, mode="nearest")
    color = np.broadcast_to(np.float32([0.8, 0.5, 0.2]), (len(place), 3))
    return Fused(coarse.astype(np.float32), 2 * side - 1, bricks, rest.astype(np.float32), color)


@pytest.mark.parametrize("killed", [10, 18])
def test_a_run_that_goes_on_has_the_bricks_of_an_undisturbed_one(tmp_path, one_thread, killed):
    """They are added at two fifths of training, which the cache of step 16 of 20 finds passed."""

    def started() -> Trainer:
        settings = replace(PRESETS["quick"], size=FieldSize((8, 24), (2, 2), 16, 8, (2,), (2,)), rays=64,
                           iterations=20, surface_points=32)  # fmt: skip
        return Trainer(settings, toy_rays(), supervision_of(NOTHING, SMALL.finest), 0, fused=ball_fused())

    run = assert_resumes(started, killed, tmp_path / "c.safetensors", 20 - killed)
    assert run.refined and run.field.bricks[0].started
    assert run.exposure is not None and run.exposure.change.any()


def test_threads_change_nothing():
    rng, found, before = torch.Generator().manual_seed(3), {}, torch.get_num_threads()
    grid = torch.randn(17, 17, 17, 4, generator=rng, requires_grad=True)
    points = torch.rand(3000, 3, generator=rng) * 2 - 1
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            values = interpolate(grid, points)
            (slope,) = torch.autograd.grad((values**2).sum(), grid)
            found[count] = values.detach(), slope
    finally:
        torch.set_num_threads(before)
    for one, two in zip(found[1], found[2], strict=True):
        assert torch.equal(one, two)


def looks_into_a_room(count: int, cameras: Tensor, rng: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Rays from cameras at angles [V] of a ring through the unit sphere, and the colours that they meet behind it: the
    inside of a box, 8 wide and 4 high."""
    angle = cameras[torch.randint(len(cameras), (count,), generator=rng)]
    origin = torch.stack([2 * angle.cos(), 2 * angle.sin(), torch.full_like(angle, 0.7)], 1)
    aim = functional.normalize(torch.randn(count, 3, generator=rng))
    along = functional.normalize(0.9 * torch.rand(count, 1, generator=rng) * aim - origin)
    far = ((torch.tensor([4.0, 4.0, 2.0]) * along.sign() - origin) / along).amin(1)
    color = 0.5 + 0.3 * torch.sin(1.5 * (origin + far[:, None] * along) + torch.tensor([0.0, 1.0, 2.0]))
    return origin, along, color


def test_a_background_is_right_between_the_photos_and_not_only_in_them(one_thread):
    """A single grid of the finest level, or a rate ten times as high, is off by twice as much: it fits each photo with
    noise of its own."""
    rng, ring, steps = torch.Generator().manual_seed(0), torch.arange(12) * (np.pi / 6), 300
    background = Background(48)
    adam = torch.optim.Adam(background.parameters(), betas=(0.9, 0.99), eps=1e-12)
    origins, along, color = looks_into_a_room(20_000, ring, rng)
    color = color + 0.03 * torch.randn(color.shape, generator=rng)
    for step in range(steps):
        some = torch.randint(len(color), (256,), generator=rng)
        found = background.along(origins[some], along[some], torch.rand(256, BACKGROUND_SAMPLES, generator=rng))
        adam.param_groups[0]["lr"] = BACKGROUND_RATE * (0.5 + 0.5 * np.cos(np.pi * step / steps))
        adam.zero_grad()
        (found - color[some]).abs().mean().backward()
        adam.step()
    origins, along, color = looks_into_a_room(5_000, ring + np.pi / 12, rng)
    with torch.no_grad():
        found = background.along(origins, along, torch.full((5_000, BACKGROUND_SAMPLES), 0.5))
    assert float((found - color).square().mean().sqrt()) < 0.03


RED, SIDE = (200, 30, 30), 40


def views(count: int) -> tuple[View, ...]:
    """Cameras on a ring of radius 3 that look at the origin."""
    found = ring(count, 3.0, 0, SIDE, SIDE, 50.0)
    return tuple(replace(view, name=f"{k}.jpg", source=f"IMG_{k}.JPG") for k, view in enumerate(found))


def away(view: View) -> View:
    """A camera in the same place that looks the other way."""
    back = np.diag([-1.0, 1, -1])
    return replace(view, rotation=back @ view.rotation, translation=back @ view.translation)


def photos(folder: Path, count: int, *, masks: bool = False) -> None:
    (folder / "images").mkdir()
    save_photos([replace(photo(k, SIDE, SIDE), name=f"{k}.jpg", mask=masks) for k in range(count)], folder)
    for k in range(count):
        Image.new("RGB", (SIDE, SIDE), RED).save(folder / "images" / f"{k}.jpg", quality=98)
        if masks:
            (folder / "masks").mkdir(exist_ok=True)
            row, column = np.mgrid[0:SIDE, 0:SIDE] + 0.5 - SIDE / 2
            # A ball of radius 0.5 at distance 3 is a disc of radius 50 * 0.5 / sqrt(9 - 0.25).
            disc = np.hypot(row, column) < 50 * 0.5 / np.sqrt(8.75)
            Image.fromarray((255 * disc).astype(np.uint8)).save(folder / "masks" / f"{k}.jpg.png")


def cloud() -> Sparse:
    points = np.random.default_rng(0).normal(size=(60, 3)) * 0.4
    point_of, view_of = np.repeat(np.arange(60), 4), np.tile(np.arange(4), 60)
    return Sparse(points, np.zeros((60, 3), np.uint8), np.full(60, 0.5), point_of, view_of)


class Ball:
    """A trainer whose field is a red ball of radius 0.5, opaque within a thousandth."""

    settings = SimpleNamespace(long_side=120, samples=48)
    device, beta = "cpu", 0.001

    def __init__(self) -> None:
        self.field = SimpleNamespace(
            device=torch.device("cpu"), sdf=lambda p: p.norm(dim=1) - 0.5,
            geometry_at=lambda p: (p.norm(dim=1) - 0.5, p, p),
            color_of=lambda geometry, features, directions: torch.tensor(RED).expand(len(geometry), 3) / 255,
        )  # fmt: skip
        self.cache = sdf_cache(self.field, 2 / 128)  # type: ignore[arg-type]


def test_a_field_that_is_right_scores_as_such(tmp_path):
    """Pixels of the ball are those of the photo."""
    photos(tmp_path, 2, masks=True)
    psnr, picture = compare(load_rays(views(2), tmp_path, 100, masks=False), 0, Ball(), torch.full((3,), 0.5))  # type: ignore[arg-type]
    assert np.abs(picture[SIDE // 2, SIDE // 2].astype(int) - RED).max() <= 2
    # Outside the ball the photo is red and the render is the backdrop: the error of that share of pixels.
    inside = np.hypot(*(np.mgrid[0:SIDE, 0:SIDE] + 0.5 - SIDE / 2)) < 50 / np.sqrt(8)  # of the unit sphere
    ball = np.hypot(*(np.mgrid[0:SIDE, 0:SIDE] + 0.5 - SIDE / 2)) < 50 * 0.5 / np.sqrt(8.75)
    wrong = ((np.array(RED) / 255 - 0.5) ** 2).mean() * (inside & ~ball).sum() / inside.sum()
    assert psnr == pytest.approx(-10 * np.log10(wrong), abs=0.5)


def test_held_out_photos_that_show_nothing_of_the_sphere_are_passed_over(tmp_path):
    photos(tmp_path, 16)
    settings = replace(PRESETS["quick"], size=SMALL, rays=32, samples=12, iterations=40, surface_points=16)
    some = list(views(16))
    some[4] = away(some[4])
    report = train(PosedPhotos(tuple(some), cloud()), tmp_path, tmp_path, settings=settings, threads=1).report
    assert report["held_out_photos"] == ["IMG_12.JPG"] and len(report["psnr_each"]) == 1
    with Image.open(tmp_path / HELD_OUT / "12.jpg") as render:
        assert report["psnr_px"] == max(render.size)
    assert np.isfinite(report["psnr"]) and [p.name for p in (tmp_path / HELD_OUT).iterdir()] == ["12.jpg"]
    assert score([away(view) for view in views(2)], tmp_path, Ball(), tmp_path, masked=False) == {}  # type: ignore[arg-type]


def test_masks_count_only_where_every_photo_has_one_posed_or_not(tmp_path):
    photos(tmp_path, 4, masks=True)
    settings = replace(PRESETS["quick"], size=SMALL, rays=16, samples=12, iterations=2, surface_points=16)
    assert train(PosedPhotos(views(4), cloud()), tmp_path, tmp_path, settings=settings, threads=1).report["masked"]
    known = [replace(photo(k, SIDE, SIDE), name=f"{k}.jpg", mask=k < 4) for k in range(5)]
    save_photos(known, tmp_path)
    assert not train(PosedPhotos(views(4), cloud()), tmp_path, tmp_path, settings=settings, threads=1).report["masked"]


def test_a_budget_that_is_far_too_small_still_ends_with_a_field(tmp_path):
    photos(tmp_path, 4)
    settings = replace(PRESETS["quick"], size=SMALL, rays=16, samples=12, surface_points=16)
    report = train(PosedPhotos(views(4), cloud()), tmp_path, tmp_path, settings=settings, threads=1, budget=1e-3).report
    assert report["iterations"] <= FEWEST_STEPS and (tmp_path / "field.safetensors").exists()


SETTINGS = replace(PRESETS["quick"], size=SMALL, rays=16, iterations=1000, surface_points=8)


@pytest.fixture
def clock(monkeypatch) -> SimpleNamespace:
    """Every step of training takes one second, and learns nothing."""
    clock = SimpleNamespace(now=0.0)

    def timed(trainer: Trainer) -> dict[str, float]:
        clock.now += 1.0
        trainer.iteration += 1
        return {"color": 0.1}

    monkeypatch.setattr(training, "time", SimpleNamespace(monotonic=lambda: clock.now))
    monkeypatch.setattr(Trainer, "step", timed)
    monkeypatch.setattr(training, "calibrate", lambda probe, threads: 1.0)
    return clock


def test_a_run_that_goes_on_has_what_is_left_of_its_budget(tmp_path, clock):
    poses = posed_noise(tmp_path)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    report = train(poses, tmp_path, whole, settings=SETTINGS, budget=150.0).report
    assert report["train_seconds"] == 150.0 and report["iterations"] == 150
    ended = clock.now

    def kill(fraction: float, message: str) -> None:
        if clock.now - ended >= 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(poses, tmp_path, killed, settings=SETTINGS, budget=150.0, checkpoint_every=0.0, on_progress=kill)
    report = train(poses, tmp_path, killed, settings=SETTINGS, budget=150.0).report
    assert report["resumed"] and report["seconds_before"] == 100.0
    assert report["train_seconds"] == pytest.approx(150.0, abs=training.PACE)
    assert report["train_seconds"] <= 150.0 and report["iterations"] == report["train_seconds"]


def test_what_a_killed_run_had_trained_is_not_lost_in_silence(tmp_path, clock):
    poses = posed_noise(tmp_path)
    (tmp_path / "checkpoint.safetensors").write_bytes(b"half")
    told: list[str] = []
    report = train(poses, tmp_path, tmp_path, settings=replace(SETTINGS, iterations=20),
                   on_progress=lambda fraction, message: told.append(message)).report  # fmt: skip
    assert not report["resumed"] and report["iterations"] == 20
    lost = [message for message in told if "a killed run" in message]
    assert "what a killed run had trained is lost: checkpoint.safetensors cannot be read" in lost[0]
    assert notes({"distill": report}) == report["notes"] == lost[:1]


def painted_ball(view: View, gain: np.ndarray) -> np.ndarray:
    """A photo [H, W, 3] uint8 of a ball of radius 0.5 whose colour changes from place to place, in front of grey."""
    column, row = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    rays = view.rays(column.ravel(), row.ravel())
    along = -(rays @ view.center)
    inside = along**2 - (view.center @ view.center) + 0.25
    at = view.center + (along - np.sqrt(np.maximum(inside, 0)))[:, None] * rays
    color = np.where(inside[:, None] > 0, 0.4 + 0.2 * np.sin(9 * at + [0, 1, 2]), 0.35)
    return (255 * np.clip(gain * color, 0, 1) + 0.5).astype(np.uint8).reshape(SIDE, SIDE, 3)


def test_photos_of_other_exposure_and_white_balance_train_as_those_of_one(tmp_path, one_thread, monkeypatch):
    """Gains of up to one stop more or less, in photos that are coded with a gamma of 2.2, and tints."""
    rng = np.random.default_rng(1)
    cameras = [replace(view, name=f"{k}.png") for k, view in enumerate(views(12))]
    varied = 2 ** (rng.uniform(-1, 1, (12, 1)) / 2.2) * rng.uniform(0.9, 1.1, (12, 3))
    (tmp_path / "images").mkdir()
    nothing = supervision.Supervision(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 6)))
    around = np.stack([np.cos(np.linspace(0, 6, 50)), np.sin(np.linspace(0, 6, 50)), 0 * np.linspace(0, 6, 50)], 1)
    surface = torch.tensor(0.5 * around, dtype=torch.float32)

    def trained(gains: np.ndarray) -> tuple[Trainer, float, float]:
        """The trainer, its last colour errors' mean, and how far the surface lies off in the median."""
        for view, gain in zip(cameras, gains, strict=True):
            Image.fromarray(painted_ball(view, gain)).save(tmp_path / "images" / view.name)
        rays = load_rays(cameras, tmp_path, SIDE, masks=False)
        settings = replace(PRESETS["quick"], size=SMALL, rays=256, samples=24, iterations=400, surface_points=64)
        run = Trainer(settings, rays, nothing, 0)
        errors = [run.step()["color"] for _ in range(settings.iterations)]
        with torch.no_grad():
            return run, float(np.mean(errors[-50:])), float(run.field.sdf(surface).abs().median())

    plain, error, off = trained(np.ones((12, 3)))
    run, error_varied, off_varied = trained(varied)
    monkeypatch.setattr(training, "EXPOSURE_RATE", 0.0)
    _, error_without, _ = trained(varied)
    assert plain.exposure.spread() < training.VARIED / 2
    assert error < 0.0016 and error_varied < 0.0035 and error_varied < 0.4 * error_without
    assert off_varied < off + 0.01
    # Of the colours that there are, as a gain and an offset can stand in for each other.
    gain, offset = (values.detach().numpy() for values in run.exposure.of_photos())
    ratio = (gain * 0.38 + offset) / 0.38 / varied
    assert np.abs(ratio / ratio.mean(0) - 1).max() < 0.08


def test_a_backdrop_that_masks_put_there_keeps_its_colour():
    exposure = Exposure(2)
    exposure.change.data = torch.tensor([[[0.5] * 3, [0.1] * 3], [[-0.5] * 3, [-0.1] * 3]])
    rgb, opacity = torch.tensor([[0.5] * 3, [0.3] * 3]), torch.tensor([0.0, 1.0])
    seen = exposure(rgb, opacity, 0.5, torch.tensor([0, 1]))
    torch.testing.assert_close(seen, torch.tensor([[0.5] * 3, [0.5 * 0.3 - 0.1] * 3]))


def test_a_hollow_that_is_there_from_fused_depth_is_kept_open_from_the_first_step_on():
    """Lines of sight cross what fused depth has filled. All levels may empty it at once, where training from a ball has
    no room for a hollow yet: coarse levels alone would fill what is open."""
    line = np.linspace(-1, 1, 16)
    z, y, x = np.meshgrid(line, line, line, indexing="ij")
    rod = np.maximum(np.hypot(x, y) - 0.4, np.abs(z) - 0.6).astype(np.float32)
    none = np.zeros((0, 3), np.float32)
    start = Fused(rod, 31, none.astype(np.int16), none[:, 0], none)
    sight = np.array([[0.1 * i, 0.1 * j, 0.9, 0.1 * i, 0.1 * j, -0.3] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    down = supervision.Supervision(none, none[:, 0], sight)
    settings = replace(PRESETS["quick"], size=SMALL, rays=16, samples=12, iterations=300, surface_points=16)
    fused, ball = Trainer(settings, toy_rays(64), down, 0, fused=start), Trainer(settings, toy_rays(64), down, 0)
    at = torch.tensor(sight[:, :3] + 0.5 * (sight[:, 3:] - sight[:, :3]), dtype=torch.float32)
    before = float(fused.field.sdf(at).max())
    for trainer in (fused, ball):
        trainer.step()
    assert fused.field.active == len(SMALL.steps) > ball.field.active
    assert len(fused.free.filled) > 0 and not len(ball.free.filled)
    for _ in range(60):
        fused.step()
    assert before < -0.1 and float(fused.field.sdf(at).median()) > 0


SIZE = FieldSize((8, 16, 32, 56), (2, 2, 2, 2), 32, 16, finer_channels=(2,))


@dataclass(frozen=True)
class Hollow:
    """A hollow thing that stands on the ground, about the z axis."""

    distance: Distance
    wide: float  # m, from the axis to its farthest outside
    inside: float  # m, from the axis, where its floor is looked at
    height: float  # m, of its rim
    depth: float  # m, halfway up its wall from its rim down: where the wall is looked at


HOLLOWS = {
    "cup": Hollow(cup(0.3, 0.07, 0.38, 0.5), 0.3, 0.1, 0.5, 0.19),
    "crate": Hollow(crate((0.7, 0.5), 0.08, 0.3, 0.4), 0.44, 0.12, 0.4, 0.15),
}


@dataclass(frozen=True)
class Made:
    """A hollow thing, and the field that its photos gave."""

    of: Hollow
    found: training.Trained

    def distance(self, points: np.ndarray) -> np.ndarray:
        """The field's [...] at points [..., 3] m, in normalised units."""
        local = self.found.to_unit.points(points.reshape(-1, 3))
        with torch.no_grad():
            return self.found.field.sdf(torch.tensor(local, dtype=torch.float32)).numpy().reshape(points.shape[:-1])


@pytest.fixture(scope="module", params=["cup", pytest.param("crate", marks=pytest.mark.slow)])
def made(request, tmp_path_factory) -> Made:
    hollow = HOLLOWS[request.param]
    folder: Path = tmp_path_factory.mktemp(request.param)
    rings = [(8, 25), (8, 45), (8, 68)]
    middle = (0.0, 0.0, hollow.height / 2)
    views = [view for k, (count, up) in enumerate(rings)
             for view in ring(count, 2.2, up, 200, 150, 260.0, middle, start=k * 8 + k)]  # fmt: skip
    views = [replace(view, name=f"{n:03d}.png") for n, view in enumerate(views)]
    poses = shoot(views, hollow.distance, folder)
    save_photos([replace(photo(k, 200, 150), name=view.name) for k, view in enumerate(views)], folder)
    settings = replace(
        PRESETS["quick"], size=SIZE, rays=256, samples=24, iterations=150, surface_points=128, long_side=200, stereo=200
    )
    return Made(hollow, train(poses, folder, folder, settings=settings, threads=1))


def around(count: int, start: float = 0.0) -> np.ndarray:
    """Directions [count, 2] about the z axis."""
    turn = start + np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([np.cos(turn), np.sin(turn)], 1)


def tops(distance: Distance, at: np.ndarray, height: float) -> np.ndarray:
    """Height [P] m at which a line straight down from above meets the surface at places [P, 2]."""
    heights = np.linspace(height + 0.1, -0.1, 400)
    points = np.concatenate([np.repeat(at, len(heights), 0), np.tile(heights, len(at))[:, None]], 1)
    return heights[(distance(points).reshape(len(at), -1) < 0).argmax(1)]


def thickness(distance: Distance, hollow: Hollow) -> np.ndarray:
    """Widths [12] m of its wall along level lines from its axis."""
    away = np.linspace(0, hollow.wide + 0.1, 400)
    flat = (around(12, 0.1)[:, None] * away[:, None]).reshape(-1, 2)
    points = np.concatenate([flat, np.full((len(flat), 1), hollow.height - hollow.depth)], 1)
    return (distance(points).reshape(12, -1) < 0).sum(1) * (away[1] - away[0])


def test_a_hollow_is_as_deep_as_photos_see(made):
    """Within a tenth of its depth; the ground beside it is where it should be too."""
    assert made.found.report["stereo"]["fused"]
    hollow, places = made.of, np.concatenate([0.4 * made.of.inside * around(8), made.of.inside * around(8)])
    deep, wanted = (hollow.height - tops(one, places, hollow.height) for one in (made.distance, hollow.distance))
    assert np.median(np.abs(deep / wanted - 1)) < 0.1
    assert np.abs(tops(made.distance, (hollow.wide + 0.15) * around(8), hollow.height)).max() < 0.02


def test_a_rim_is_as_high_as_it_is(made):
    hollow = made.of
    away = np.linspace(0, hollow.wide, 100)
    places = (around(12, 0.1)[:, None] * away[:, None]).reshape(-1, 2)
    found, wanted = (tops(one, places, hollow.height) for one in (made.distance, hollow.distance))
    assert np.median(found[wanted > hollow.height - 0.01]) == pytest.approx(hollow.height, abs=0.02)


def test_walls_are_as_thick_as_they_are(made):
    """Halfway down, where photos see both sides."""
    found, wanted = (thickness(one, made.of) for one in (made.distance, made.of.distance))
    assert np.median(np.abs(found / wanted - 1)) < 0.3


CELL = 2 / 127  # of the preset quick


def test_lines_of_sight_of_a_sensor_end_before_its_noise():
    views = surfaces.ring(4)
    rng = np.random.default_rng(1)
    xyz = np.concatenate([rng.uniform(-0.3, 0.3, (50, 3)), [[0.0, 0.0, 1.5]]])  # The last one is beyond the sphere.
    depth = DepthPoints(xyz, np.zeros((51, 2)), rng.integers(0, 4, 51))
    found = supervision_of(PosedPhotos(tuple(views), NOTHING.sparse), CELL, depth, noise=0.01)
    assert {tuple(point) for point in found.depth} == {tuple(point) for point in xyz[:50]}
    centers = np.array([view.center for view in views])
    assert (np.linalg.norm(found.sight.reshape(-1, 3), axis=1) < 1 + 1e-9).all()
    # Every point has a line from its own camera, which ends 5 noises and the usual gap before it.
    sight = xyz[:50] - centers[depth.view[:50]]
    away = np.linalg.norm(sight, axis=1)
    ends = xyz[:50] - ((GAP * CELL + NOISES * 0.01 * away) / away)[:, None] * sight
    assert np.linalg.norm(ends[:, None] - found.sight[:, 3:], axis=2).min(1).max() < 1e-9


def test_lines_of_sight_through_a_fused_solid_are_left_out():
    """A ball in the middle of four cameras: points before it keep their lines, those behind it lose theirs. The lines
    of sparse points stay."""
    views, radius = surfaces.ring(4), 0.2
    centers = np.array([view.center for view in views])
    towards = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    depth = DepthPoints(np.concatenate([-0.4 * towards, 0.4 * towards]), np.zeros((8, 2)), np.tile(np.arange(4), 2))
    sparse = Sparse(0.4 * towards[:1], np.zeros((1, 3), np.uint8), np.full(1, 0.5), np.zeros(3, int), np.arange(3))
    poses = PosedPhotos(tuple(views), sparse)
    found, every = (supervision_of(poses, CELL, depth, 0.0, ball) for ball in (lambda p: p.norm(dim=1) - radius, None))
    assert len(every.sight) == 11 and len(found.sight) == 7
    np.testing.assert_array_equal(found.sight[:3], every.sight[:3])
    passed = np.linalg.norm(found.sight[3:, 3:], axis=1)
    np.testing.assert_allclose(passed, 0.4 + GAP * CELL, atol=1e-9)
    np.testing.assert_array_equal(found.depth, every.depth)


@pytest.mark.parametrize("slope", [0.5, 1.0, 1.35])
@pytest.mark.parametrize("radius", [0.012, 0.04])
def test_the_cache_misses_no_speck_of_the_unit_sphere(slope, radius):
    """Balls smaller than the distance of coarse samples, anywhere and right at the sphere; flat and steep fields."""
    rng = np.random.default_rng(3)
    place = rng.normal(size=(12, 3))
    place *= np.append(rng.uniform(0.2, 0.9, 8), 4 * [0.99 - radius])[:, None] / np.linalg.norm(place, axis=1)[:, None]
    middles = torch.tensor(place, dtype=torch.float32)
    asked: list[int] = []

    def distance(points: torch.Tensor) -> torch.Tensor:
        asked.append(len(points))
        return slope * (torch.cdist(points, middles).amin(1) - radius)

    balls = SimpleNamespace(device=torch.device("cpu"), sdf=distance)
    cache = sdf_cache(balls, 2 / 128)[..., 0]  # type: ignore[arg-type]
    assert sum(asked) < 0.2 * cache.numel()
    line = torch.linspace(-1, 1, len(cache))
    points = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).flip(-1).reshape(-1, 3)
    wanted = balls.sdf(points).view(cache.shape)
    inside = (points.norm(dim=1) <= 1).view(cache.shape)
    assert (wanted[inside] < 0).any() and ((cache < 0) == (wanted < 0))[inside].all()
    near = inside & (wanted.abs() < 0.02 * slope)
    torch.testing.assert_close(cache[near], wanted[near], rtol=0, atol=1e-6)
