"""The weighted token loss."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def weighted_token_loss(logits: Tensor, labels: Tensor, weights: Tensor) -> Tensor:
    """Cross-entropy over a batch, each token with its weight, divided by the sum of weights.

    Args:
        logits: [batch, tokens, vocabulary] at the positions that predict ``labels`` (already shifted).
        labels: int64 [batch, tokens].
        weights: float [batch, tokens]; 0 leaves a token out (prompt, padding, masked sections).

    Returns:
        A scalar; 0 when all weights are 0.
    """
    losses = F.cross_entropy(logits.flatten(0, 1).float(), labels.flatten(), reduction="none")
    flat = weights.flatten().to(losses.dtype)
    return (losses * flat).sum() / flat.sum().clamp_min(torch.finfo(losses.dtype).tiny)
