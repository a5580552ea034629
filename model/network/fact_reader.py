"""The facts that decide a plan, read from the gathered tokens of a scene (`looktwice.model.driving.facts`).

What pictures show is brought down to numbers with a meaning before anything is planned from them: they are
taught densely and read alike in scenes that were never seen, where a vector without a meaning is learned by
heart. The same numbers tell people what the model sees.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from looktwice.model.driving.facts import FACT_GROUPS, IS_YES_OR_NO, PRESENCE, TELLS_OF_OBJECT

_OUTLIER = 6.0


class FactReader(nn.Module):
    """One linear reading for each group of facts, from a query of its own; the other queries are free.

    Args:
        hidden_size: width of the gathered tokens.
    """

    def __init__(self, hidden_size: int) -> None:
        super().__init__()
        self.groups = nn.ModuleList(nn.Linear(hidden_size, len(fields)) for fields in FACT_GROUPS)

    def forward(self, gathered: Tensor) -> Tensor:
        """Facts [b, len(FACTS)] of gathered tokens [b, queries, hidden]; logits for what is or is not so."""
        read = [group(gathered[:, place]) for place, group in enumerate(self.groups)]
        return torch.cat(read, dim=1).float()


def likely(read: Tensor) -> Tensor:
    """What was read, [..., len(FACTS)], with probabilities in place of logits."""
    yes_or_no = torch.from_numpy(IS_YES_OR_NO).to(read.device)
    return torch.where(yes_or_no, read.sigmoid(), read.clamp(-_OUTLIER, _OUTLIER))


def weighed(facts: Tensor) -> Tensor:
    """Facts [..., len(FACTS)] to plan by: each counts as much as its object is present, and none is NaN."""
    known = facts.nan_to_num()
    tells = torch.from_numpy(TELLS_OF_OBJECT).to(facts.device)
    presence = torch.from_numpy(PRESENCE).to(facts.device)
    return torch.where(tells, known * known[..., presence], known)
