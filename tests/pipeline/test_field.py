"""The field's formulas against closed forms, and the trainer's determinism."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn import functional

from pipeline.cameras import View
from pipeline.field.grid_field import (
    BACKGROUND_SAMPLES,
    Background,
    FieldSize,
    differences,
    sample_weights,
    stencil,
)
from pipeline.field.supervision import supervision_of
from pipeline.field.training import (
    BACKGROUND_RATE,
    PRESETS,
    Trainer,
    camera_rays,
    load_rays,
    train,
)
from pipeline.grids.interpolation import WHOLE, by_rows, interpolate, interpolate_bricks, near_bricks, places_of
from pipeline.stereo.fusion import Fused
from sdfsim.base.errors import SdfsimError
from tests.helpers.fields import SMALL, assert_resumes, posed_noise, toy_rays
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
    for supervision in (nothing, replace(nothing, depth=ball)):
        run = Trainer(settings, grey, supervision, 0)
        for _ in range(60):
            run.step()
        with torch.no_grad():
            off.append(float(run.field.sdf(torch.tensor(ball, dtype=torch.float32)).abs().mean()))
    assert off[1] < 0.03 and off[1] < 0.3 * off[0]


def test_train_writes_and_reads_back(tmp_path):
    from pipeline.field.training import load_field

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
