"""Convolutions beside the vision tower: they find what is small.

The tower cuts pictures into patches of 14 pixels and learns from nothing what a patch shows. A person 30 m
away is four pixels wide in the wide camera. Convolutions look at every place in the same way, so they learn
small things from a hundredth of the examples (https://arxiv.org/abs/2106.14881). They look at the latest
picture of a clip, and at how it differs from the one before.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from looktwice.model.network.matching import Matched, Matching
from looktwice.model.network.patches import PIXEL_MEAN, PIXEL_STD
from looktwice.model.network.vla_settings import SPOTTED, VlaSettings

STRIDE: Final = 16
"""Pixels from one place of `Found.features` to the next."""
_CHANNELS: Final = 96
_LAYERS: Final = (
    (16, 2, 5),
    (32, 2, 3),
    (32, 1, 3),
    (64, 2, 3),
    (64, 1, 3),
    (_CHANNELS, 2, 3),
    (_CHANNELS, 1, 3),
)
"""Channels, stride and size of each convolution."""
_GROUPS: Final = 8
TOLD: Final = (
    *("likely", "logit", "away_log", "across", "down", "came", "sure"),
    *("nearer_log", "grown_log", "grown_sure"),
)
"""What the first numbers of a token tell: how likely somebody is there, the same as a logit, log(1 + metres)
to them, where in the picture, from -1 to 1, how much farther to the right they were in the picture before, on
the same scale, and how likely that is; the logarithm of how much farther away they were, and the same from
how much narrower they were found, and how likely that is."""
_LOGITS: Final = 5.0
_NARROWEST: Final = 2 / STRIDE
_WIDEST: Final = 10.0
_NEARER: Final = 2.0
"""Nobody comes nearer or goes farther away by this between two pictures."""
_NOBODY: Final = -20.0
_RARELY: Final = -4.0


def channels_of(hidden_size: int) -> int:
    """Numbers of a token that tell what is seen there."""
    return min(_CHANNELS, (hidden_size - len(TOLD)) // _GROUPS * _GROUPS)


class Found(NamedTuple):
    """What is found in k clips, and the n that are likeliest to be there.

    Attributes:
        logits: [k, kinds, rows, columns], whether one of each kind of `SPOTTED` stands at each place.
        away_log: [k, rows, columns], log(1 + metres) to whom stands there.
        shift: [k, rows, columns], how far to the right of the middle of the place they are, in places.
        half_log: [k, rows, columns], log of half their width, in places.
        nearer_log: [k, rows, columns], log of how much farther away they were in the picture before.
        features: [k, channels, rows, columns], what is seen there.
        spotted: int64 [k, n], the places of the likeliest.
        spotted_logits: [k, n], of their kind.
        matched: [k, 3 x n], of the left side, the middle and the right side of each.
    """

    logits: Tensor
    away_log: Tensor
    shift: Tensor
    half_log: Tensor
    nearer_log: Tensor
    features: Tensor
    spotted: Tensor
    spotted_logits: Tensor
    matched: Matched


class FineVision(nn.Module):
    """Tokens of whom the latest picture of each clip shows, beside those of the tower.

    Args:
        hidden_size: of the tokens.
        settings: how pictures are cut into patches.
    """

    def __init__(self, hidden_size: int, settings: VlaSettings) -> None:
        super().__init__()
        self._settings = settings
        self._hidden_size = hidden_size
        layers, before = list[nn.Module](), 6
        for widest, stride, size in _LAYERS:
            channels = min(widest, channels_of(hidden_size))
            layers += [
                nn.Conv2d(before, channels, size, stride, size // 2, bias=False),
                nn.GroupNorm(_GROUPS, channels),
                nn.ReLU(inplace=True),
            ]
            before = channels
        self.layers = nn.Sequential(*layers)
        self.head = nn.Conv2d(before, len(SPOTTED) + 4, 1)
        self.matching = Matching()

    @torch.no_grad()
    def expect_nobody(self) -> None:
        """Begin with nobody at any place, which is true nearly everywhere."""
        assert self.head.bias is not None
        self.head.bias[: len(SPOTTED)] = _RARELY

    def pictures(self, patches: Tensor) -> Tensor:
        """The last two pictures of each clip, [clips, 2, 3, h, w].

        Args:
            patches: [p, 3 x temporal x patch x patch] of whole clips, see
                `looktwice.model.network.patches.patchify`.
        """
        settings = self._settings
        time, patch, merge = settings.temporal_patch_size, settings.patch_size, settings.spatial_merge_size
        _, rows, columns = settings.grid
        # [clip, row, column, merge, merge, channel, time, y, x]
        whole = patches.view(-1, rows // merge, columns // merge, merge, merge, 3, time, patch, patch)
        shown = whole[..., -2:, :, :].permute(0, 6, 5, 1, 3, 7, 2, 4, 8)
        return shown.reshape(len(whole), 2, 3, rows * patch, columns * patch)

    def find(self, pictures: Tensor) -> Found:
        """Who stands where in pictures [k, 2, 3, h, w], normalised floats, or uint8 as they are.

        Of each kind so many are spotted as `SPOTTED` says, the likeliest first; none beside a likelier one.
        """
        if pictures.dtype == torch.uint8:
            mean, std = (
                torch.tensor(part, device=pictures.device).view(3, 1, 1) for part in (PIXEL_MEAN, PIXEL_STD)
            )
            pictures = (pictures / 255 - mean) / std
        pictures = pictures.to(self.head.weight.dtype)
        before, latest = pictures.unbind(1)
        changing = torch.cat([latest, latest - before], dim=1)
        features = self.layers(changing.contiguous(memory_format=torch.channels_last))
        found = self.head(features)
        logits = found[:, : len(SPOTTED)]
        away_log, shift, half_log, nearer_log = found[:, len(SPOTTED) :].unbind(1)
        peaks = torch.where(F.max_pool2d(logits, 3, 1, 1) == logits, logits, _NOBODY).flatten(2)
        best = [peaks[:, kind].topk(count) for kind, count in enumerate(SPOTTED.values())]
        place = torch.cat([each.indices for each in best], dim=1)
        column, row = _middle(place, shift)
        half = _half_of(half_log.flatten(1).gather(1, place))
        columns = torch.stack([column - half, column, column + half], dim=-1).detach()
        rows = row[..., None].expand(columns.shape)
        return Found(
            logits,
            away_log,
            shift,
            half_log,
            nearer_log,
            features,
            place,
            torch.cat([each.values for each in best], dim=1),
            self.matching(pictures, STRIDE * columns.flatten(1), STRIDE * rows.flatten(1)),
        )

    def tokens(self, found: Found) -> Tensor:
        """Tokens [k, `VlaSettings.fine_tokens`, hidden] of those that are spotted.

        A token tells `TOLD`, then what is seen there, the less the less likely anybody is; the rest is zero.
        """
        rows, columns = found.away_log.shape[-2:]
        column, row = _middle(found.spotted, found.shift)
        away_log, half_log, nearer_log = (
            part.flatten(1).gather(1, found.spotted)
            for part in (found.away_log, found.half_log, found.nearer_log)
        )
        likely = found.spotted_logits.sigmoid()
        came_px, sure = (part.view(*likely.shape, 3) for part in found.matched.came_px())
        came, half = came_px / STRIDE, _half_of(half_log)
        # Who was narrower in the picture before was farther away.
        half_before = (half + (came[..., 2] - came[..., 0]) / 2).clamp(half / _NEARER, half * _NEARER)
        told = torch.stack(
            [
                likely,
                found.spotted_logits / _LOGITS,
                away_log,
                2 * column / columns - 1,
                2 * row / rows - 1,
                2 * came[..., 1] / columns,
                sure[..., 1],
                nearer_log,
                (half / half_before).log(),
                sure[..., 0] * sure[..., 2],
            ],
            dim=-1,
        )
        every = found.features.flatten(2).transpose(1, 2)
        there = every.gather(1, found.spotted[..., None].expand(-1, -1, every.shape[2]))
        tokens = torch.cat([told, there * likely[..., None]], dim=-1)
        return F.pad(tokens, (0, self._hidden_size - tokens.shape[-1]))

    def forward(self, patches: Tensor) -> Tensor:
        """Tokens [clips, `VlaSettings.fine_tokens`, hidden] of patches as in `pictures`."""
        return self.tokens(self.find(self.pictures(patches)))


def _half_of(half_log: Tensor) -> Tensor:
    """Half a width, in places, of its logarithm."""
    return half_log.clamp(math.log(_NARROWEST), math.log(_WIDEST)).exp()


def _middle(place: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Column and row [k, n] of those at places [k, n], counted in places."""
    columns = shift.shape[-1]
    beside = shift.flatten(1).gather(1, place)
    return place % columns + 0.5 + beside, (place // columns + 0.5).to(beside.dtype)
