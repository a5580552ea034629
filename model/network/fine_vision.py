"""Convolutions beside the vision tower: they find what is small.

The tower cuts pictures into patches of 14 pixels and learns from nothing what a patch shows. A person 30 m
away is four pixels wide in the wide camera. Convolutions look at every place in the same way, so they learn
small things from a hundredth of the examples (https://arxiv.org/abs/2106.14881). They look at the latest
picture of a clip, and at how it differs from the one before.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from looktwice.model.network.patches import PIXEL_MEAN, PIXEL_STD
from looktwice.model.network.vla_settings import SPOTTED, VlaSettings

STRIDE: Final = 16
"""Pixels from one place of `FineVision.features` to the next."""
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
TOLD: Final = ("likely", "logit", "away_log", "across", "down")
"""What the first numbers of a token tell: how likely somebody is there, the same as a logit, log(1 + metres)
to them, and where in the picture, from -1 to 1."""
_LOGITS: Final = 5.0
_NOBODY: Final = -20.0
_RARELY: Final = -4.0


def channels_of(hidden_size: int) -> int:
    """Numbers of a token that tell what is seen there."""
    return min(_CHANNELS, (hidden_size - len(TOLD)) // _GROUPS * _GROUPS)


class Found(NamedTuple):
    """What is found at every place of pictures.

    Attributes:
        logits: [k, kinds, rows, columns], whether one of each kind of `SPOTTED` stands there.
        away_log: [k, rows, columns], log(1 + metres) to whom stands there.
        shift: [k, rows, columns], how far beside the middle of the place they are, in places.
    """

    logits: Tensor
    away_log: Tensor
    shift: Tensor


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
        self.head = nn.Conv2d(before, len(SPOTTED) + 2, 1)

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

    def changing(self, pictures: Tensor) -> Tensor:
        """The latest picture and how it differs from the one before, [k, 6, h, w].

        Args:
            pictures: [k, 2, 3, h, w], normalised floats, or uint8 as they are.
        """
        if pictures.dtype == torch.uint8:
            mean, std = (
                torch.tensor(part, device=pictures.device).view(3, 1, 1) for part in (PIXEL_MEAN, PIXEL_STD)
            )
            pictures = (pictures / 255 - mean) / std
        before, latest = pictures.to(self.head.weight.dtype).unbind(1)
        return torch.cat([latest, latest - before], dim=1)

    def features(self, pictures: Tensor) -> Tensor:
        """What every place of pictures [k, 6, h, w] shows: [k, channels, h / 16, w / 16], rounded up."""
        found: Tensor = self.layers(pictures.contiguous(memory_format=torch.channels_last))
        return found

    def find(self, features: Tensor) -> Found:
        """Who stands at each place of `features`."""
        found = self.head(features)
        return Found(found[:, : len(SPOTTED)], found[:, -2], found[:, -1])

    def spotted(self, features: Tensor, found: Found) -> Tensor:
        """Tokens [k, `VlaSettings.fine_tokens`, hidden] of those that are likeliest to be there.

        Of each kind so many as `SPOTTED` says, the likeliest first; none beside a likelier one. A token tells
        `TOLD`, then what is seen there, the less the less likely anybody is; the rest is zero.
        """
        rows, columns = found.away_log.shape[-2:]
        logits = found.logits
        peaks = torch.where(F.max_pool2d(logits, 3, 1, 1) == logits, logits, _NOBODY).flatten(2)
        best = [peaks[:, kind].topk(count) for kind, count in enumerate(SPOTTED.values())]
        logit = torch.cat([each.values for each in best], dim=1)  # [k, n]
        place = torch.cat([each.indices for each in best], dim=1)
        away_log, shift = (part.flatten(1).gather(1, place) for part in (found.away_log, found.shift))
        across = 2 * (place % columns + 0.5 + shift) / columns - 1
        down = 2 * (place // columns + 0.5).to(across.dtype) / rows - 1
        likely = logit.sigmoid()
        told = torch.stack([likely, logit / _LOGITS, away_log, across, down], dim=-1)
        every = features.flatten(2).transpose(1, 2)
        there = every.gather(1, place[..., None].expand(-1, -1, every.shape[2])) * likely[..., None]
        tokens = torch.cat([told, there.to(told.dtype)], dim=-1)
        return F.pad(tokens, (0, self._hidden_size - tokens.shape[-1]))

    def forward(self, patches: Tensor) -> Tensor:
        """Tokens [clips, `VlaSettings.fine_tokens`, hidden] of patches as in `pictures`."""
        features = self.features(self.changing(self.pictures(patches)))
        return self.spotted(features, self.find(features))
