"""New weights for a network that is loaded, from a folder that is the same in all else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from looktwice.model.network.card import CheckpointError
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.network.model_card import ModelCard
from looktwice.model.network.visual_codes import VisualCodes
from looktwice.model.network.vla_settings import CONFIG_KEY

_NO_SIZES: Final = {CONFIG_KEY, "_name_or_path", "dtype", "transformers_version"}
"""Entries of a configuration that say nothing of the network's sizes and operations."""


def load_weights(loaded: Loaded, folder: Path) -> ModelCard:
    """Write the weights of another checkpoint into a network, in place.

    Args:
        loaded: whose network it is; it stays as it is where anything is raised.
        folder: of the other checkpoint, in whatever type it is stored.

    Returns:
        The other checkpoint's card.

    Raises:
        CheckpointError: the folder is no usable checkpoint, or differs in more than its weights.
    """
    other = load(folder, loaded.model.dtype, str(loaded.model.device))
    _check_same_but_weights(loaded, other, folder)
    loaded.model.load_state_dict(other.model.state_dict())
    return other.card


def _check_same_but_weights(mine: Loaded, other: Loaded, folder: Path) -> None:
    """Raise `CheckpointError` where the checkpoint of ``folder`` differs in more than its weights."""
    same = {
        "settings": replace(mine.settings, name="") == replace(other.settings, name=""),
        "tokenizer": mine.vocabulary.tokenizer.get_vocab() == other.vocabulary.tokenizer.get_vocab(),
        "trajectory codec": all(
            np.array_equal(value, getattr(other.codec, name)) for name, value in vars(mine.codec).items()
        ),
        "codes of pictures": _same_codes(mine.visual_codes, other.visual_codes),
        "network": sizes_of(mine.model.config.to_dict()) == sizes_of(other.model.config.to_dict()),
    }
    refuse_differing(same, folder)


def refuse_differing(same: Mapping[str, bool], folder: Path) -> None:
    """Raise `CheckpointError` where a part of the checkpoint in ``folder`` is not the same, by its name."""
    if differing := [name for name, is_same in same.items() if not is_same]:
        raise CheckpointError(
            f"{folder} differs from the checkpoint that runs in its {', '.join(differing)}: "
            "its weights cannot take their place, start an engine over it"
        )


def _same_codes(mine: VisualCodes | None, other: VisualCodes | None) -> bool:
    if mine is None or other is None:
        return mine is other
    weights = other.state_dict()
    return mine.width == other.width and all(
        torch.equal(value, weights[name]) for name, value in mine.state_dict().items()
    )


def sizes_of(config: Any) -> Any:
    """A configuration without `_NO_SIZES`, at any depth."""
    if not isinstance(config, dict):
        return config
    return {name: sizes_of(value) for name, value in config.items() if name not in _NO_SIZES}
