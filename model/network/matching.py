"""How far those who stand somewhere in a picture moved since the picture before.

Whoever is spotted is looked for in the picture before: what the two pictures show is compared at every step
to the left and to the right (correlation, as in FlowNet, https://arxiv.org/abs/1504.06852, section 3), then
again more finely around the likeliest step. Convolutions over both pictures alone do not learn it from a few
thousand people.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

STEP_PX: Final = 4
"""From one step of the first search to the next."""
REACH: Final = 16
"""So many steps to each side."""
FINE_PX: Final = 2
"""The same of the second search."""
FINE_REACH: Final = 4
_CHANNELS: Final = (16, 24)
"""Of what is compared finely, and coarsely."""
_GROUPS: Final = 4
_BESIDE: Final = 1
"""So many steps around a place belong to whom stands there."""
_UP: Final = 3
"""And they are looked for so many steps higher and lower: coming nearer moves them in the picture."""
_SHARP: Final = 10.0


class Matched(NamedTuple):
    """Where those who stand at n places of k pictures were in the picture before.

    Attributes:
        coarse: [k, n, 2 x REACH + 1], logits of how many steps farther to the right.
        base_px: [k, n], the likeliest of these steps, in pixels.
        fine: [k, n, 2 x FINE_REACH + 1], logits of how many fine steps beyond.
    """

    coarse: Tensor
    base_px: Tensor
    fine: Tensor

    def came_px(self) -> tuple[Tensor, Tensor]:
        """How many pixels farther to the right, and how likely that is, [k, n] each."""
        step, sure = _best_step(self.fine)
        return self.base_px + FINE_PX * step, sure * _best_step(self.coarse)[1]


class Matching(nn.Module):
    """Looks for those who stand at places of one picture in the picture before."""

    def __init__(self) -> None:
        super().__init__()
        fine, coarse = _CHANNELS
        self.fine_layers = nn.Sequential(
            nn.Conv2d(3, fine, 5, FINE_PX, 2),
            nn.GroupNorm(_GROUPS, fine),
        )
        self.coarse_layers = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(fine, coarse, 3, STEP_PX // FINE_PX, 1),
            nn.GroupNorm(_GROUPS, coarse),
            nn.ReLU(inplace=True),
            nn.Conv2d(coarse, coarse, 3, 1, 1),
        )
        self.weigh_coarse, self.weigh_fine = _weighing(), _weighing()

    def forward(self, pictures: Tensor, column_px: Tensor, row_px: Tensor) -> Matched:
        """Where those at places [k, n] of the latest pictures were in the ones before.

        Args:
            pictures: [k, 2, 3, h, w], normalised, the one before and the latest.
            column_px, row_px: [k, n], where they are in the latest.
        """
        fine = self.fine_layers(pictures.flatten(0, 1))
        coarse = self.coarse_layers(fine)
        alike = _alike(coarse, STEP_PX, REACH, column_px, row_px, column_px, row_px)
        logits = self.weigh_coarse(_SHARP * alike.flatten(0, 1)).view(*column_px.shape, -1)
        best = logits.argmax(dim=-1)
        up = alike.gather(-1, best[..., None, None].expand(*alike.shape[:-1], 1)).squeeze(-1).argmax(dim=-1)
        base_px = STEP_PX * (best - REACH).to(column_px.dtype)
        down_px = STEP_PX * (up - _UP)
        nearby = _alike(fine, FINE_PX, FINE_REACH, column_px, row_px, column_px + base_px, row_px + down_px)
        finer = self.weigh_fine(_SHARP * nearby.flatten(0, 1)).view(*column_px.shape, -1)
        return Matched(logits, base_px, finer)


def _weighing() -> nn.Module:
    return nn.Sequential(
        nn.Conv1d(2 * _UP + 1, 16, 5, padding=2), nn.ReLU(inplace=True), nn.Conv1d(16, 1, 5, padding=2)
    )


def _alike(
    shown: Tensor,
    step_px: int,
    reach: int,
    column_px: Tensor,
    row_px: Tensor,
    column_before_px: Tensor,
    row_before_px: Tensor,
) -> Tensor:
    """How alike places of the latest pictures are to those around places of the ones before.

    Args:
        shown: [2 x k, channels, rows, columns], what is seen every ``step_px`` pixels, before and after.
        step_px: see there.
        reach: so many steps to each side are looked at.
        column_px, row_px: [k, n], places in the latest pictures.
        column_before_px, row_before_px: the same in the ones before.

    Returns:
        [k, n, 2 x _UP + 1, 2 x reach + 1], from -1 to 1.
    """
    wide, high = reach + _BESIDE, _UP + _BESIDE
    padded = F.pad(shown, (wide, wide, high, high))
    before, latest = padded.view(-1, 2, *padded.shape[1:]).unbind(1)
    rows, columns = shown.shape[2:]
    row, row_before = ((each / step_px).floor().long().clamp(0, rows - 1) for each in (row_px, row_before_px))
    column, column_before = (
        (each / step_px).floor().long().clamp(0, columns - 1) for each in (column_px, column_before_px)
    )
    # Padding moves what is at (row, column) to where a strip around it begins at (row, column).
    patch, up, across = 2 * _BESIDE + 1, 2 * _UP + 1, 2 * reach + 1
    strips = F.normalize(_cut(before, row_before, column_before, up + patch - 1, across + patch - 1), dim=2)
    patches = F.normalize(_cut(latest, row + _UP, column + reach, patch, patch), dim=2)
    # Each of the nine parts of a patch with all of its strip; then those that lie as in the patch are added.
    products = (patches.flatten(3).transpose(2, 3) @ strips.flatten(3)).view(
        *patches.shape[:2], patch, patch, *strips.shape[3:]
    )
    places = [(y, x) for y in range(patch) for x in range(patch)]
    matching = [products[:, :, y, x, y : y + up, x : x + across] for y, x in places]
    return torch.stack(matching).mean(dim=0)


def _best_step(logits: Tensor) -> tuple[Tensor, Tensor]:
    """The likeliest step of logits [..., steps], between two of them where both are likely, and how likely.

    Steps count from the middle. Those beside the likeliest count with it; what is likely elsewhere does not
    draw it there.
    """
    likely = F.pad(logits.softmax(-1), (_BESIDE, _BESIDE)).unfold(-1, 2 * _BESIDE + 1, 1)  # [..., steps, 3]
    best = likely.sum(-1).argmax(-1)
    around = likely.gather(-2, best[..., None, None].expand(*best.shape, 1, likely.shape[-1])).squeeze(-2)
    sure = around.sum(-1)
    off = (around * torch.arange(-_BESIDE, _BESIDE + 1, device=logits.device)).sum(-1) / sure
    return best - logits.shape[-1] // 2 + off, sure


def _cut(shown: Tensor, row: Tensor, column: Tensor, height: int, width: int) -> Tensor:
    """Parts [k, n, channels, height, width] of ``shown`` [k, channels, ...], each from a row and a column."""
    count, channels, _, columns = shown.shape
    down, right = (torch.arange(size, device=row.device) for size in (height, width))
    index = (row[..., None] + down)[..., None] * columns + (column[..., None] + right)[..., None, :]
    taken = shown.flatten(2).gather(2, index.flatten(1)[:, None].expand(-1, channels, -1))
    return taken.view(count, channels, row.shape[1], height, width).transpose(1, 2)
