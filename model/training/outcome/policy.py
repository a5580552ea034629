"""Learning from rewards: draws of one scene are compared with each other (GRPO, https://arxiv.org/abs/2402.03300).

An answer that was not drawn, such as a refinement that a teacher's feedback led to, may be among them. It has
no old probability, so it counts with f(p) = p / (p + gamma) of each decision's probability p, as in
Critique-GRPO (https://arxiv.org/abs/2506.03106) and ELF-VLA (section 9.1: gamma 0.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class PolicyLoss(NamedTuple):
    """What `policy_loss` gives.

    Attributes:
        loss: scalar, with gradients.
        ratio: mean of new over old probability of the drawn decisions; 1 before the first update.
        clipped: share of the drawn decisions whose ratio the clip holds back.
    """

    loss: Tensor
    ratio: Tensor
    clipped: Tensor


_LEAST_DEVIATION = 1e-4


def advantages(rewards: Tensor, *, normalised: bool = False) -> Tensor:
    """By how much a draw is better than its scene's mean: [scenes, draws], as ``rewards``.

    Args:
        rewards: of draws.
        normalised: divided by the scene's deviation, as GRPO has it and VLA-World (equation 7). That makes
            much of scenes where nearly nothing differs (https://arxiv.org/abs/2503.20783).
    """
    found = rewards - rewards.mean(dim=1, keepdim=True)
    return found / (rewards.std(dim=1, keepdim=True) + _LEAST_DEVIATION) if normalised else found


def divergence(now: Sequence[Tensor], before: Sequence[Tensor]) -> Tensor:
    """How far a network has gone from another one: a scalar, its gradients those of ``now``.

    An estimate from draws of the divergence that GRPO holds small (its equation 4): 0 where both say the
    same, and nowhere negative.

    Args:
        now: log-probabilities [decisions] of each response.
        before: those that the other network gives.
    """
    apart = torch.cat(list(before)) - torch.cat(list(now))
    return (apart.exp() - apart - 1).mean()


def policy_loss(
    now: Sequence[Tensor],
    drawn: Sequence[Tensor | None],
    advantage: Tensor,
    *,
    clip: float = 0.2,
    gamma: float = 0.1,
) -> PolicyLoss:
    """The loss whose gradient makes better draws likelier, a mean over all decisions.

    Args:
        now: log-probabilities [decisions] of each response, with gradients.
        drawn: those that it was drawn with; None for a response that was not drawn but injected.
        advantage: [responses].
        clip: how far a decision's ratio may go from 1 before it counts no more.
        gamma: see the module.

    Raises:
        ValueError: no response has a decision.
    """
    count = sum(len(each) for each in now)
    if count == 0:
        raise ValueError("there is nothing to learn from: no response has a decision")
    gains, ratios, held = [], [], []
    for new, old, worth in zip(now, drawn, advantage, strict=True):
        if old is None:
            probability = new.exp()
            gains.append((probability / (probability + gamma) * worth).sum())
            continue
        ratio = (new - old).exp()
        bounded = ratio.clamp(1 - clip, 1 + clip)
        gains.append(torch.minimum(ratio * worth, bounded * worth).sum())
        ratios.append(ratio.detach())
        held.append((ratio * worth > bounded * worth).detach().float())
    nothing = advantage.new_ones(0)
    ratio, clipped = torch.cat([nothing, *ratios]), torch.cat([nothing, *held])
    return PolicyLoss(
        -torch.stack(gains).sum() / count,
        ratio.mean() if len(ratio) else advantage.new_ones(()),
        clipped.mean() if len(clipped) else advantage.new_zeros(()),
    )
