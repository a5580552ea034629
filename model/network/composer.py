"""A picture of half a second later: what codes say of it, and what was seen until now, moved as the ego.

What stands still is better copied than painted from 98 codes. What moves shows where two earlier pictures
differ, and what enters is in the codes alone. For each pixel the composer says where to look in the latest
picture, how much of that to take, and what to paint instead. Decoders that are told of earlier frames come
from video models; see iVideoGPT (https://arxiv.org/abs/2405.15223, section 3.1).
"""

from __future__ import annotations

from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from looktwice.model.network.convolutions import ConvBlock

SEEN_PICTURES: Final = 2
"""Earlier pictures that a composer is shown, half a second apart, the last one of now."""
_FINE: Final = 4
"""Pixels across a place of the finest grid."""
_REACH: Final = 0.1
"""How far to look elsewhere where the network writes a 1, as a share of half the picture."""


class Composer(nn.Module):
    """Composes pictures; see the module.

    Args:
        levels: numbers of a code.
        fine, coarse: channels at a quarter of the resolution, and below.

    Shapes: b pictures of h x w pixels, and their codes on a grid of h/16 x w/16 patches.
    """

    def __init__(self, levels: int, fine: int = 48, coarse: int = 88) -> None:
        super().__init__()
        self.entry = nn.Sequential(
            nn.PixelUnshuffle(_FINE),
            nn.Conv2d(3 * (1 + SEEN_PICTURES) * _FINE**2, fine, 1),
            ConvBlock(fine),
        )
        self.to_half = nn.Sequential(nn.Conv2d(fine, coarse, 2, stride=2), ConvBlock(coarse))
        self.to_patches = nn.Conv2d(coarse, coarse, 2, stride=2)
        self.changed = nn.Conv2d(2 * levels, coarse, 1)
        self.at_patches = nn.Sequential(ConvBlock(coarse), ConvBlock(coarse))
        self.from_patches = nn.Sequential(nn.Conv2d(coarse, 4 * coarse, 1), nn.PixelShuffle(2))
        self.at_half = ConvBlock(coarse)
        self.from_half = nn.Sequential(nn.Conv2d(coarse, 4 * fine, 1), nn.PixelShuffle(2))
        self.at_fine = nn.Sequential(ConvBlock(fine), ConvBlock(fine))
        self.look = nn.Conv2d(fine, 2, 3, padding=1)
        self.finish = nn.Sequential(nn.Conv2d(fine, 4 * _FINE**2, 3, padding=1), nn.PixelShuffle(_FINE))
        nn.init.zeros_(self.look.weight)
        assert self.look.bias is not None
        nn.init.zeros_(self.look.bias)

    def forward(self, painted: Tensor, moved: Tensor, levels: Tensor, moved_levels: Tensor) -> Tensor:
        """The pictures [b, 3, h, w], about 0..1.

        Args:
            painted: [b, 3, h, w] of the codes alone.
            moved: [b, seen, 3, h, w] in 0..1, what was seen, moved as the ego; the last one is of now.
            levels, moved_levels: [b, levels, h/16, w/16] of the codes and of the last moved one's, in -1..1.
        """
        fine = self.entry(torch.cat((painted, moved.flatten(1, 2)), 1) - 0.5)
        half = self.to_half(fine)
        patches = self.to_patches(half) + self.changed(torch.cat((levels, moved_levels), 1))
        half = self.at_half(half + self.from_patches(self.at_patches(patches)))
        fine = self.at_fine(fine + self.from_half(half))
        elsewhere = F.interpolate(self.look(fine), scale_factor=_FINE, mode="bilinear", align_corners=False)
        found = _looked_up(moved[:, -1], elsewhere * _REACH)
        mixed = self.finish(fine)
        share = mixed[:, :1].sigmoid()
        composed: Tensor = share * found + (1 - share) * (painted + mixed[:, 1:])
        return composed


def _looked_up(pictures: Tensor, elsewhere: Tensor) -> Tensor:
    """Pictures [b, 3, h, w] as seen at other places: [b, 2, h, w] to the right and down, in half pictures."""
    b, _, height, width = pictures.shape
    still = torch.eye(2, 3, device=pictures.device, dtype=pictures.dtype).expand(b, 2, 3)
    grid = F.affine_grid(still, [b, 1, height, width], align_corners=False)
    return F.grid_sample(
        pictures, grid + elsewhere.movedim(1, -1), padding_mode="border", align_corners=False
    )
