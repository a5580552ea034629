"""The weighted token loss, with soft targets where trajectory codes are predicted."""

from __future__ import annotations

from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor

STAGE_WEIGHTS: Final = (2.0, 1.5, 1.0, 0.7, 0.5, 0.3)
"""Of the codes in the order they are written: the first ones decide metres, the last ones centimetres."""


def response_loss(
    logits: Tensor, labels: Tensor, weights: Tensor, first_code_id: int, code_shares: Tensor
) -> Tensor:
    """Cross-entropy, each token with its weight, divided by the sum of weights.

    A code is not compared with one winner but with a distribution over its stage's codebook.

    Args:
        logits: [tokens, vocabulary] at the positions that predict ``labels`` (already shifted); tokens of
            several responses one after the other.
        labels: int64 [tokens].
        weights: float [tokens]; 0 leaves a token out.
        first_code_id: the id of stage 0's code 0; codes of all stages lie behind it, stage by stage.
        code_shares: float [responses, stages, size], each response's distributions, in order.

    Returns:
        A scalar; 0 when all weights are 0.
    """
    log_shares = F.log_softmax(logits.float(), dim=-1)
    losses = -log_shares.gather(1, labels[:, None])[:, 0]
    stages, size = code_shares.shape[1:]
    place = labels - first_code_id
    is_code = (place >= 0) & (place < stages * size)
    stage = place[is_code] // size
    ids = (first_code_id + stage * size)[:, None] + torch.arange(size, device=labels.device)
    soft = -(code_shares.flatten(0, 1) * log_shares[is_code].gather(1, ids)).sum(dim=1)
    losses = losses.masked_scatter(is_code, soft)
    by_stage = torch.tensor(STAGE_WEIGHTS, device=labels.device)[stage]
    weights = weights.float().masked_scatter(is_code, weights[is_code].float() * by_stage)
    return (losses * weights).sum() / weights.sum().clamp_min(torch.finfo(losses.dtype).tiny)
