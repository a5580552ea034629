"""Whoever moved between two pictures is found in the one before."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from looktwice.model.network.matching import FINE_PX, FINE_REACH, REACH, STEP_PX, Matched, Matching

HEIGHT, WIDTH = 56, 224


def moved(seed: int, count: int = 16) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Two pictures in which a patch moved over a background that moved otherwise; where, and how far."""
    draw = torch.Generator().manual_seed(seed)
    ground = F.avg_pool2d(torch.randn(count, 3, HEIGHT, WIDTH + 64, generator=draw), 3, 1, 1)
    patch = 2 * F.avg_pool2d(torch.randn(count, 3, 12, 12, generator=draw), 3, 1, 1)
    moved_px = torch.randint(STEP_PX * (2 - REACH), STEP_PX * (REACH - 2), (count,), generator=draw)
    column = (
        torch.randint(4 * REACH + 8, WIDTH - 4 * REACH - 20, (count,), generator=draw) // STEP_PX * STEP_PX
    )
    row = torch.randint(8, HEIGHT - 20, (count,), generator=draw) // STEP_PX * STEP_PX
    pictures = torch.stack([ground[..., 20 : 20 + WIDTH], ground[..., :WIDTH]], dim=1).clone()
    for place in range(count):
        for time, left in ((0, column[place] + moved_px[place]), (1, column[place])):
            pictures[place, time, :, row[place] : row[place] + 12, left : left + 12] = patch[place]
    return pictures, column[:, None] + 6.0, row[:, None] + 6.0, moved_px


def test_who_moved_is_found_after_some_learning() -> None:
    torch.manual_seed(0)
    matching = Matching()
    optimizer = torch.optim.AdamW(matching.parameters(), 3e-3)
    for seed in range(40):
        pictures, column, row, moved_px = moved(seed)
        found = matching(pictures, column, row)
        fine = ((moved_px - found.base_px[:, 0]) / FINE_PX).round().clamp(-FINE_REACH, FINE_REACH)
        loss = F.cross_entropy(found.coarse[:, 0], (moved_px / STEP_PX).round().long() + REACH)
        loss = loss + F.cross_entropy(found.fine[:, 0], fine.long() + FINE_REACH)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    pictures, column, row, moved_px = moved(1000, 64)
    with torch.inference_mode():
        came_px, sure = matching(pictures, column, row).came_px()
    assert came_px.shape == sure.shape == (64, 1)
    right = (came_px[:, 0] - moved_px).abs() <= FINE_PX
    assert right.float().mean() > 0.9


@pytest.mark.parametrize(("column", "row"), [(0.0, 0.0), (-9.0, 80.0), (223.9, 55.9), (900.0, -3.0)])
def test_places_at_and_beyond_the_borders_are_looked_at(column: float, row: float) -> None:
    matching = Matching().eval()
    at = torch.tensor([[column, 100.0]]), torch.tensor([[row, 30.0]])
    found = matching(torch.randn(1, 2, 3, HEIGHT, WIDTH), *at)
    assert all(torch.isfinite(each).all() for each in found)


def test_the_likeliest_step_lies_between_neighbours_and_is_not_drawn_elsewhere() -> None:
    steps = 2 * FINE_REACH + 1
    fine = torch.full((1, 3, steps), -30.0)
    fine[0, 0, FINE_REACH - 3] = 0.0
    fine[0, 1, [FINE_REACH + 2, FINE_REACH + 3]] = 0.0
    fine[0, 2, [FINE_REACH + 2, FINE_REACH + 3, 0]] = torch.tensor([0.0, 0.0, 0.5])
    coarse = torch.full((1, 3, 2 * REACH + 1), -30.0)
    coarse[..., REACH] = 0.0
    base_px = torch.tensor([[0.0, 8.0, -4.0]])
    came_px, sure = Matched(coarse, base_px, fine).came_px()
    assert came_px.tolist()[0] == pytest.approx([-6.0, 13.0, 1.0], abs=1e-3)
    assert sure[0, :2].tolist() == pytest.approx([1.0, 1.0], abs=1e-4)
    assert sure[0, 2] == pytest.approx(2 / (2 + math.exp(0.5)), abs=1e-4)
