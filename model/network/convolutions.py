"""The block that networks of convolutions are made of."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn


class ConvBlock(nn.Module):
    """Looks around in each channel, then mixes the channels of each place; added to what came in."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.around = nn.Conv2d(width, width, 5, padding=2, groups=width)
        self.norm = nn.LayerNorm(width)
        self.wide = nn.Linear(width, 2 * width)
        self.narrow = nn.Linear(2 * width, width)

    def forward(self, grid: Tensor) -> Tensor:
        """[b, width, h, w] to the same."""
        seen = self.norm(self.around(grid).movedim(1, -1))
        mixed: Tensor = self.narrow(F.gelu(self.wide(seen), approximate="tanh"))
        return grid + mixed.movedim(-1, 1)
