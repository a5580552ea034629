"""Weights between two checkpoints: what a stage taught, without all that it made forgotten.

A network that is trained further on fewer scenes than before learns them by heart, too. The weights between
those before and those after keep much of both (WiSE-FT, https://arxiv.org/abs/2109.01903).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from looktwice.model.network.card import CheckpointError
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.vla import is_planner, is_tower, is_vision, with_own_head


def blend(before: Loaded, after: Loaded, share: float) -> Loaded:
    """``after`` with the weights of its decoder moved back towards those of ``before``.

    So is what reads facts from the vision tower's tokens, where both have the same tower; where they have
    not, there is no reading between theirs, and all that sees stays as it is in ``after``. The small planners
    stay in any case: they learn from enough scenes not to know them by heart, and what lies between two of
    them plans worse than the second.

    Args:
        before, after: checkpoints of one architecture, the second trained from the first.
        share: of ``after``; 1 is ``after`` itself.

    Raises:
        CheckpointError: they differ in more than weights.
        ValueError: a share beyond 0 to 1.
    """
    if not 0 <= share <= 1:
        raise ValueError(f"share is {share}, not between 0 and 1")
    old, new = before.model.state_dict(), after.model.state_dict()
    if before.settings != after.settings or {name: value.shape for name, value in old.items()} != {
        name: value.shape for name, value in new.items()
    }:
        raise CheckpointError(f"{before.card.name} and {after.card.name} differ in more than their weights")
    other_tower = any(not torch.equal(old[name], new[name]) for name in new if is_tower(name))
    stays = {name for name in new if is_planner(name) or (other_tower and is_vision(name))}
    if not before.model.config.tie_word_embeddings:
        # Between one head and another's embeddings lies a head of its own.
        with_own_head(after.model)
    with torch.no_grad():
        after.model.load_state_dict(
            {
                name: value if name in stays else _between(old[name], value, share)
                for name, value in new.items()
            }
        )
    stages = [
        *after.card.details.get("stages", []),
        {"name": "blend", "share": share, "with": before.card.revision},
    ]
    return replace(after, card=replace(after.card, details={**after.card.details, "stages": stages}))


def _between(old: Tensor, new: Tensor, share: float) -> Tensor:
    return torch.lerp(old.float(), new.float(), share).to(new.dtype) if new.is_floating_point() else new
