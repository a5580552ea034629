from __future__ import annotations

import pytest
import torch
from torch import Tensor

from looktwice.model.training.outcome.policy import advantages, divergence, policy_loss


def test_draws_are_compared_with_their_own_scene() -> None:
    worth = advantages(torch.tensor([[1.0, 0.0], [5.0, 5.0]]))
    torch.testing.assert_close(worth, torch.tensor([[0.5, -0.5], [0.0, 0.0]]))


def test_they_may_be_compared_by_their_deviation() -> None:
    worth = advantages(torch.tensor([[1.0, 0.0, -1.0], [0.3, 0.2, 0.1], [5.0, 5.0, 5.0]]), normalised=True)
    expected = torch.tensor([[1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(worth, expected, atol=2e-3, rtol=0)


def test_divergence_is_that_of_two_distributions() -> None:
    """Over all draws of one decision, weighed by how often they are drawn, it is exact."""
    now, before = (torch.tensor(each).softmax(-1).log() for each in ([1.0, 0.0, -1.0], [0.5, 0.5, -2.0]))
    shares = now.exp()
    estimates = torch.stack([divergence([now[k : k + 1]], [before[k : k + 1]]) for k in range(3)])
    assert bool((estimates > 0).all())
    torch.testing.assert_close((shares * estimates).sum(), (shares * (now - before)).sum())
    assert divergence([now], [now]) == 0


def test_before_the_first_update_the_gradient_is_that_of_the_policy() -> None:
    logits = torch.tensor([[0.3, -0.2, 0.1]], requires_grad=True)
    now = torch.log_softmax(logits, -1)[0, :1]
    found = policy_loss([now], [now.detach()], torch.tensor([2.0]))
    assert found.ratio == 1
    assert found.clipped == 0
    (mine,) = torch.autograd.grad(found.loss, logits, retain_graph=True)
    (plain,) = torch.autograd.grad(-2.0 * now.sum(), logits)
    torch.testing.assert_close(mine, plain)


@pytest.mark.parametrize(("worth", "moves"), [(1.0, False), (-1.0, True)])
def test_a_decision_that_went_far_counts_no_more(worth: float, moves: bool) -> None:
    """Twice as likely as when it was drawn: enough for a good one, too much for a bad one."""
    now = torch.tensor([-1.0], requires_grad=True)
    found = policy_loss([now], [torch.tensor([-1.0 - 0.7])], torch.tensor([worth]), clip=0.2)
    (gradient,) = torch.autograd.grad(found.loss, now)
    assert bool(gradient.any()) is moves
    assert bool(found.clipped) is not moves


@pytest.mark.parametrize("probability", [0.01, 0.1, 0.5, 1.0])
def test_the_weight_of_an_injected_decision_by_finite_differences(probability: float) -> None:
    gamma, step = 0.1, 1e-6

    def gain(logprob: Tensor) -> Tensor:
        return -policy_loss([logprob[None]], [None], torch.ones(1, dtype=torch.float64), gamma=gamma).loss

    at = torch.tensor(probability, dtype=torch.float64).log().requires_grad_()
    (gradient,) = torch.autograd.grad(gain(at), at)
    difference = (gain(at + step) - gain(at - step)) / (2 * step)
    assert gradient.item() == pytest.approx(difference.item(), rel=1e-5)
    # Most where the probability is gamma: there it is a quarter.
    assert gradient.item() == pytest.approx(gamma * probability / (probability + gamma) ** 2)
    assert gradient.item() <= 0.25 + 1e-12


def test_an_answer_that_is_never_drawn_is_learned_when_it_is_injected() -> None:
    """Of two arms the good one has a chance of one in twenty thousand."""

    def learned(*, injected: bool) -> float:
        torch.manual_seed(0)
        logits = torch.tensor([10.0, 0.0], requires_grad=True)
        optimiser = torch.optim.SGD([logits], lr=20.0)
        for _ in range(2000):
            arms = torch.multinomial(torch.softmax(logits, -1), 8, replacement=True).tolist()
            now = torch.log_softmax(logits, -1)
            drawn: list[Tensor | None] = [now[arm : arm + 1].detach() for arm in arms]
            rewards = [float(arm) for arm in arms]
            if injected:
                arms, drawn, rewards = [*arms, 1], [*drawn, None], [*rewards, 1.0]
            worth = advantages(torch.tensor([rewards]))[0]
            loss = policy_loss([now[arm : arm + 1] for arm in arms], drawn, worth).loss
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            optimiser.step()
        return torch.softmax(logits, -1)[1].item()

    assert learned(injected=False) < 0.01
    assert learned(injected=True) > 0.9


def test_without_a_decision_there_is_nothing_to_learn() -> None:
    with pytest.raises(ValueError, match="no response has a decision"):
        policy_loss([torch.zeros(0)], [torch.zeros(0)], torch.ones(1))
