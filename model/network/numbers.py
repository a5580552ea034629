"""Numbers as tokens: which alphabets a checkpoint's formats need, and how their tokens begin.

The codes of pictures are such numbers too.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from looktwice.model.families.picture_codes import PICTURE, levels_of
from looktwice.model.families.registry import families_of
from looktwice.model.formats.contents import number_alphabets
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.network.vocabulary import Vocabulary

_WAVES: Final = 4
"""Of a number's place, the longest over the whole alphabet and each half as long as the one before: tokens
that are near begin alike, and those a sixteenth of the alphabet apart do not."""
_OWN: Final = 0.3
"""Share of a direction of its own for each token: those of neighbours must be told apart."""


def needed_numbers(settings: VlaSettings) -> dict[str, int]:
    """The alphabets of numbers that a checkpoint's formats are written in, and their sizes."""
    families = families_of(settings.formats, settings.reflection).values()
    return {name: size for family in families for name, size in number_alphabets(family.format.body).items()}


@torch.no_grad()
def write_number_embeddings(model: nn.Module, vocabulary: Vocabulary, names: set[str]) -> None:
    """Set the embeddings of alphabets of numbers, so that near numbers begin near.

    Codes of pictures are near where their levels are, as these are what a picture is painted of.
    Draws from torch's global random state, and only where there are any.
    """
    network: Any = model
    for layer in (network.get_input_embeddings(), network.get_output_embeddings()):
        weight = layer.weight
        spread = float(weight[: vocabulary.code_ids(0).start].float().std())
        for name in sorted(names):
            [ids] = vocabulary.alphabets[name]
            features = _levels(len(ids)) if name == PICTURE else _features(len(ids))
            projected = features @ torch.randn(features.shape[1], weight.shape[1])
            own = torch.randn(len(ids), weight.shape[1])
            rows = projected / projected.std() + torch.randn(weight.shape[1]) + _OWN * own
            weight[ids.start : ids.stop] = (spread * rows / rows.std()).to(weight.dtype)


def _features(size: int) -> Tensor:
    """Of all numbers of an alphabet, float32 [size, k]: where they lie, and waves over that."""
    place = np.linspace(-1.0, 1.0, size)
    waves = np.pi * 2.0 ** np.arange(_WAVES) * place[:, None]
    features = np.concatenate([place[:, None], np.sin(waves), np.cos(waves)], axis=1)
    return torch.from_numpy(features.astype(np.float32))


def _levels(size: int) -> Tensor:
    """Of the codes of pictures, float32 [size, 4]: how far their levels are from the mean ones."""
    levels = levels_of(np.arange(size)).astype(np.float32)
    return torch.from_numpy((levels - levels.mean(axis=0)) / levels.std(axis=0))
