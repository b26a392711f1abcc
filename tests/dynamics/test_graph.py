"""When contacts are first seen: against a loop over inner steps."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sdfsim.dynamics.graph import REST_SPEED, SUBSTEPS, TOUCH, ContactGraph, edge_frames


def falling(gaps: list[float], speeds: list[float], radius: float = 0.5, substeps: int = SUBSTEPS) -> ContactGraph:
    """Balls of one mass above a floor (the last body), each with one edge: gap m, downward speed m/s."""
    count = len(gaps)
    fall = torch.tensor([0.0, 0.0, -0.2])
    velocity = torch.zeros(count + 1, 3)
    velocity[:count, 2] = -torch.tensor(speeds)
    moves = torch.tensor([1.0] * count + [0.0])
    index = torch.arange(count)
    down = torch.tensor([0.0, 0.0, -radius]).expand(count, 3)
    zeros = torch.zeros(count + 1, 3)
    return ContactGraph(
        inverse_mass=moves,
        inverse_inertia=torch.eye(3) * moves[:, None, None],
        velocity=velocity,
        angular=zeros,
        free_velocity=velocity + fall * moves[:, None],
        free_angular=zeros,
        mean_velocity=velocity + 0.5 * fall * moves[:, None],
        mean_angular=zeros,
        first=index,
        second=torch.full((count,), count),
        pair=index,
        pairs=count,
        normal=torch.tensor([0.0, 0.0, 1.0]).expand(count, 3),
        arm_first=down,
        arm_second=down,
        gap=torch.tensor(gaps),
        substeps=torch.full((count,), float(substeps)),
        friction=torch.zeros(count),
        restitution=torch.zeros(count),
        dt=0.02,
    )


def seen_at(gap: float, speed: float, substeps: int) -> tuple[int, float]:
    """The inner step at which an engine finds the ball touching, and its distance then (else at the last)."""
    inner, velocity = 0.02 / substeps, -speed
    for k in range(substeps):
        if gap <= TOUCH:
            return k, gap
        last = gap
        velocity -= 10.0 * inner
        gap += velocity * inner
    return substeps, last


@pytest.mark.parametrize("substeps", [4, 5])
@pytest.mark.parametrize("speed", [0.0, 0.5, 2.0, 7.0])
def test_a_contact_is_seen_when_an_engine_sees_it(speed: float, substeps: int) -> None:
    gaps = [0.001, 0.011, 0.02, 0.045, 0.09, 0.2, -0.01]
    graph = falling(gaps, [speed] * len(gaps), substeps=substeps)
    features = edge_frames(graph).start[:, -7:]
    scale = (speed**2 + REST_SPEED**2) ** 0.5
    inner = 0.02 / substeps
    for row, gap in zip(features, gaps, strict=True):
        step, distance = seen_at(gap, speed, substeps)
        assert float(row[0]) * substeps == pytest.approx(step, abs=1e-5)
        assert row[1] == row[0] == row[2]
        assert float(row[3]) == 1.0  # the floor meets nobody
        assert float(row[4].sinh()) * inner * scale == pytest.approx(distance, abs=1e-5)
        assert float(row[5]) == (step < substeps)
        arrival = -speed - 10.0 * inner * (min(step, substeps - 1) + 1)
        assert float(row[6]) * scale == pytest.approx(arrival, abs=1e-4)


def test_the_first_edge_of_a_pair_sets_the_time_for_all() -> None:
    graph = falling([0.2, 0.03], [5.0, 5.0])
    one = torch.zeros(2, dtype=torch.int64)
    graph = replace(graph, first=one, pair=one, pairs=1)
    features = edge_frames(graph).start[:, -7:]
    assert features[0, 0] == 1.0 and features[1, 0] == pytest.approx(2 / SUBSTEPS)
    assert (features[:, 1:3] == features[1, 0]).all()
    assert features[0, 5] == 0.0 and features[1, 5] == 1.0


def test_features_turn_with_the_scene() -> None:
    graph = falling([0.03, 0.2, 0.001], [5.0, 1.0, 0.3])
    turned = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    turned = turned * torch.linalg.det(turned)
    vectors = ("velocity", "angular", "free_velocity", "free_angular", "mean_velocity", "mean_angular", "normal")
    vectors += ("arm_first", "arm_second")
    other = replace(graph, **{name: getattr(graph, name) @ turned.T for name in vectors})
    torch.testing.assert_close(edge_frames(other).start, edge_frames(graph).start, atol=2e-5, rtol=1e-4)
