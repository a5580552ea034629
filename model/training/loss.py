"""The weighted token loss, with soft targets where trajectory codes are predicted."""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

STAGE_WEIGHTS: Final = (2.0, 1.5, 1.0, 0.7, 0.5, 0.3)
"""Of the codes in the order they are written: the first ones decide metres, the last ones centimetres."""

LOSS_UNIT: Final = 60.0
"""What six tokens of the paper's heaviest weight, 10, weigh together."""


class ResponseLoss(NamedTuple):
    """What is minimised, and two means without weights and gradients to follow the learning by.

    Attributes:
        loss: scalar.
        code_loss: nats per trajectory code; a uniform guess has log(codebook size).
        code_error_m: how far off the first code is expected to leave the trajectory, in metres.
        word_loss: nats per other token, forced ones included.
    """

    loss: Tensor
    code_loss: Tensor
    code_error_m: Tensor
    word_loss: Tensor


def response_loss(
    logits: Tensor,
    labels: Tensor,
    weights: Tensor,
    first_code_id: int,
    code_shares: Tensor,
    code_errors_m: Tensor,
    responses: int,
    error_weight: float = 0.0,
) -> ResponseLoss:
    """Cross-entropy, each token with its weight, summed over a response and averaged over responses.

    Not averaged over tokens: most of a plan's tokens are forced and soon known by heart, and a code would
    teach tens of times less behind a plan than without one. Divided by `LOSS_UNIT`: a trajectory of weight 10
    adds the mean of its codes' losses, weighted by stage.

    A code is not compared with one winner but with a distribution over its stage's codebook. Cross-entropy
    alone spreads over all that may happen; ``error_weight`` also charges the error that a draw is expected to
    have, which draws it together where that costs metres.

    Args:
        logits: [tokens, vocabulary] at the positions that predict ``labels`` (already shifted); tokens of
            several responses one after the other.
        labels: int64 [tokens].
        weights: float [tokens]; 0 leaves a token out.
        first_code_id: the id of stage 0's code 0; codes of all stages lie behind it, stage by stage.
        code_shares: float [learned, stages, size], the distributions of each response whose codes are among
            ``labels``, in order; there may be none.
        code_errors_m: float, of the same shape, see `SoftTarget`.
        responses: how many the loss is averaged over.
        error_weight: nats that an expected metre counts.

    Raises:
        RuntimeError: other numbers of codes among ``labels`` and in ``code_shares``.
    """
    log_shares = F.log_softmax(logits.float(), dim=-1)
    losses = -log_shares.gather(1, labels[:, None])[:, 0]
    stages, size = code_shares.shape[1:]
    place = labels - first_code_id
    is_code = (place >= 0) & (place < stages * size)
    stage = place[is_code] // size
    ids = (first_code_id + stage * size)[:, None] + torch.arange(size, device=labels.device)
    of_codes = log_shares[is_code].gather(1, ids)
    soft = -(code_shares.flatten(0, 1) * of_codes).sum(dim=1)
    expected_m = (of_codes.exp() * code_errors_m.flatten(0, 1)).sum(dim=1)
    parts = losses.masked_scatter(is_code, soft).detach()
    losses = losses.masked_scatter(is_code, soft + error_weight * expected_m)
    first_errors_m = expected_m.detach()[stage == 0]
    first_error_m = first_errors_m.sum() / max(1, len(first_errors_m))
    is_word = ~is_code & (weights > 0)
    code_loss, word_loss = (parts[which].sum() / which.sum().clamp_min(1) for which in (is_code, is_word))
    by_stage = torch.tensor(STAGE_WEIGHTS, device=labels.device)[stage]
    weights = weights.float().masked_scatter(is_code, weights[is_code].float() * by_stage)
    return ResponseLoss(
        (losses * weights).sum() / (LOSS_UNIT * responses), code_loss, first_error_m, word_loss
    )
