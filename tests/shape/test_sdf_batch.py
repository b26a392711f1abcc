from __future__ import annotations

import numpy as np
import pytest
import torch

from sdfsim.shape import sdf as sdf_module
from sdfsim.shape.mesh import Frame
from sdfsim.shape.primitives import box
from sdfsim.shape.sdf import BoxSdf, GridSdf, GridStack, MeshSdf, PlaneSdf, Sdf, SphereSdf, sample_grid
from sdfsim.shape.sdf_batch import SdfBank
from tests.shape.test_mlp_sdf import network


def voxels(seed: int, resolution: int) -> GridSdf:
    """Samples of nothing in particular, in a frame of its own."""
    values = torch.randn(resolution, resolution, resolution, generator=torch.Generator().manual_seed(seed))
    frame = Frame(np.array([0.3, 0.1 * seed, -0.1]), 0.4 + 0.2 * seed)
    return GridSdf(values, frame, frame.outward(np.array([[-0.5, -0.4, -0.3], [0.5, 0.4, 0.3]])))


@pytest.fixture
def mixed() -> list[Sdf]:
    return [
        network(1, "wave"),
        SphereSdf(0.3),
        network(2, "relu"),
        PlaneSdf(),
        network(3, "wave"),
        BoxSdf((0.2, 0.3, 0.4)),
        SphereSdf(0.7),
        network(4, "wave"),
        network(5, "wave", width=16),
        BoxSdf((1.0, 0.1, 0.4)),
        voxels(1, 9),
        voxels(2, 12),
        voxels(3, 9),
        MeshSdf(box((0.4, 0.5, 0.6))),
    ]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 7, 500, 5000])
def test_the_bank_is_each_one_alone(mixed: list[Sdf], count: int, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(count)
    # Uneven shares, and some shapes not asked at all.
    index = (torch.rand(count, generator=generator) ** 2 * (len(mixed) - 1)).long()
    points = (torch.rand(count, 3, generator=generator, dtype=dtype) - 0.5) * 3
    distance, gradient = SdfBank(mixed)(index, points)
    assert distance.dtype == gradient.dtype == dtype
    assert gradient.shape == (count, 3)
    for number, sdf in enumerate(mixed):
        alone = sdf(points[index == number])
        torch.testing.assert_close(distance[index == number], alone[0], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(gradient[index == number], alone[1], rtol=1e-3, atol=1e-4)


def test_each_kind_takes_whatever_makes_an_array(mixed: list[Sdf]) -> None:
    rows = [[0, 0, 1], [2, -1, 0]]
    for sdf in mixed:
        expected = sdf(np.array(rows, dtype=np.float64))
        for points in (rows, tuple(map(tuple, rows)), np.array(rows), [np.array(row) for row in rows]):
            for found, wanted in zip(sdf(points), expected, strict=True):
                assert isinstance(found, np.ndarray) and found.dtype == np.float64
                np.testing.assert_array_equal(found, wanted)
        with pytest.raises(ValueError, match=r"\[P, 3\]"):
            sdf([0.0, 0.0, 1.0])


def test_the_bank_takes_strangers_and_devices(mixed: list[Sdf]) -> None:
    class Slab:
        bounds = np.array([[-1.0] * 3, [1.0] * 3])

        def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return points[:, 0] - 1, torch.tensor([1.0, 0, 0]).expand_as(points)

    bank = SdfBank([*mixed, Slab()], "cpu")
    points = torch.rand(20, 3)
    distance, _ = bank(torch.full((20,), len(mixed)), points)
    torch.testing.assert_close(distance, points[:, 0] - 1)
    # "meta" stands in for a GPU: every index the bank looks up must have moved.
    assert SdfBank([SphereSdf(0.3), PlaneSdf()], "meta")._slot_of.device.type == "meta"


def test_order_of_questions_does_not_matter() -> None:
    bank = SdfBank([network(seed, "wave") for seed in range(1, 6)])
    index, points = torch.randint(5, (3000,)), torch.rand(3000, 3)
    turn = torch.randperm(3000)
    straight, turned = bank(index, points), bank(index[turn], points[turn])
    torch.testing.assert_close(straight[0][turn], turned[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("chunk", [1, 37, 1000, 5000])
def test_grids_of_one_resolution_share_a_gather_of_bounded_size(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    seen: list[int] = []
    inner = sdf_module.trilinear

    def counted(values: torch.Tensor, slot: torch.Tensor | None, points: torch.Tensor):
        assert values.shape == (4, 8, 8, 8)
        seen.append(len(points))
        return inner(values, slot, points)

    monkeypatch.setattr("sdfsim.shape.sdf.trilinear", counted)
    monkeypatch.setattr(sdf_module, "CHUNK", chunk)
    sdfs = [voxels(seed, 8) for seed in range(4)]
    index = torch.randint(4, (1000,))
    local = torch.rand(1000, 3, dtype=torch.float64) * 1.38 - 0.69
    frames = [sdfs[i].frame for i in index]
    points = torch.stack([torch.from_numpy(f.outward(x[None].numpy())[0]) for f, x in zip(frames, local, strict=True)])
    distance, gradient = SdfBank(sdfs)(index, points)
    monkeypatch.undo()
    assert max(seen) <= chunk and sum(seen) == 1000 and len(seen) == -(-1000 // chunk)
    for number, sdf in enumerate(sdfs):
        alone = sdf(points[index == number])
        torch.testing.assert_close(distance[index == number], alone[0], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(gradient[index == number], alone[1], rtol=1e-4, atol=1e-5)


def test_a_grid_alone_is_not_copied() -> None:
    sdf = sample_grid(SphereSdf(0.5), SphereSdf(0.5).bounds, 8)
    bank = SdfBank([sdf])
    assert not bank._groups  # nothing is loaded before it is asked for
    bank(torch.zeros(1, dtype=torch.int64), torch.zeros(1, 3))
    (group,) = bank._groups.values()
    assert isinstance(group, GridStack)
    assert group._values.data_ptr() == sdf.values.data_ptr()


@pytest.mark.gpu
def test_cuda_gives_what_the_cpu_gives(mixed: list[Sdf]) -> None:
    index, points = torch.randint(len(mixed), (5000,)), torch.rand(5000, 3)
    here = SdfBank(mixed)(index, points)
    there = SdfBank(mixed, "cuda")(index.cuda(), points.cuda())
    torch.testing.assert_close(here[0], there[0].cpu(), rtol=1e-3, atol=1e-3)


@pytest.mark.gpu
@pytest.mark.parametrize(
    "sdfs", [[SphereSdf(0.3)], [PlaneSdf(), SphereSdf(0.3), BoxSdf((0.2, 0.3, 0.4))]], ids=["one", "several"]
)
def test_a_bank_without_networks_goes_to_cuda_too(sdfs: list[Sdf]) -> None:
    index, points = torch.randint(len(sdfs), (5000,)), torch.rand(5000, 3)
    here = SdfBank(sdfs)(index, points)
    bank = SdfBank(sdfs, "cuda")
    assert bank.device.type == "cuda"
    there = bank(index.cuda(), points.cuda())
    assert there[0].is_cuda and there[1].is_cuda
    torch.testing.assert_close(here[0], there[0].cpu(), rtol=1e-5, atol=1e-5)
