"""A probe beside the response: what the network must have seen by the time it begins to write.

Six codes tell little about why a trajectory is right, and most of that the history tells already: a small
network that learns from them alone hardly looks at its pictures. Half-way up the decoder, at the last token
of the prompt, a linear head must therefore name the scene's facts and the expert's future. Whatever it
reads there, the response's tokens can read in the upper half. The head is thrown away after training.
"""

from __future__ import annotations

from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.driving.facts import FACTS
from model.training.grounding import fact_loss

_NEAR: Final = 0.1
"""Errors below count by their square, above by their size."""


class SceneProbe(nn.Module):
    """A linear head on one hidden state per scene.

    Args:
        hidden: width of the decoder.
        dimensions: of the futures' vectors.
    """

    def __init__(self, hidden: int, dimensions: int) -> None:
        super().__init__()
        self.norm = nn.RMSNorm(hidden)
        self.head = nn.Linear(hidden, len(FACTS) + dimensions)
        # A head that begins at random would first of all bend the decoder to its whims.
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, states: Tensor, facts: Tensor, futures: Tensor) -> dict[str, Tensor]:
        """The probe's loss and its parts without gradients.

        Args:
            states: [batch, hidden].
            facts: [batch, facts] of `scene_facts`; NaN where one does not apply.
            futures: [batch, dimensions]; the expert's future in the codec's space, of mean square 1.
        """
        named, drawn = self.head(self.norm(states)).split([facts.shape[1], futures.shape[1]], dim=1)
        of_facts = fact_loss(named.float(), facts, torch.ones(facts.shape[1], device=facts.device))
        of_futures = F.smooth_l1_loss(drawn.float(), futures, reduction="none", beta=_NEAR).sum(1).mean()
        return {
            "loss": of_facts + of_futures,
            "probe_fact_loss": of_facts.detach(),
            "probe_future_loss": of_futures.detach(),
        }
