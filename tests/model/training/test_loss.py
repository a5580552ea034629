from __future__ import annotations

import math

import pytest
import torch

from looktwice.model.training.loss import LOSS_UNIT, STAGE_WEIGHTS, response_loss

VOCABULARY, FIRST_CODE, SIZE = 30, 10, 3


NO_CODES = torch.zeros(1, 0, SIZE)


def slow_loss(
    logits: torch.Tensor,
    labels: list[int],
    weights: list[float],
    shares: list[list[list[float]]],
    errors_m: list[list[list[float]]],
    error_weight: float,
) -> float:
    total = 0.0
    codes_seen = 0
    for row, label, weight in zip(logits.tolist(), labels, weights, strict=True):
        norm = math.log(sum(math.exp(value) for value in row))
        if FIRST_CODE <= label < FIRST_CODE + 6 * SIZE:
            stage = (label - FIRST_CODE) // SIZE
            assert stage == codes_seen % 6
            wanted, apart = shares[codes_seen // 6][stage], errors_m[codes_seen // 6][stage]
            codes_seen += 1
            of_codes = [row[FIRST_CODE + stage * SIZE + code] - norm for code in range(SIZE)]
            loss = -sum(share * each for share, each in zip(wanted, of_codes, strict=True))
            loss += error_weight * sum(
                math.exp(each) * metres for each, metres in zip(of_codes, apart, strict=True)
            )
            weight *= STAGE_WEIGHTS[stage]
        else:
            loss = norm - row[label]
        total += weight * loss
    return total / LOSS_UNIT / len(shares)


@pytest.mark.parametrize("error_weight", [0.0, 0.7])
def test_loss_equals_the_obvious_sum(error_weight: float) -> None:
    torch.manual_seed(0)
    codes = [FIRST_CODE + stage * SIZE + stage % SIZE for stage in range(6)]
    labels = [1, 2, *codes, 3, 4, *codes, 5]
    weights = [float(1 + k % 4) for k in range(len(labels))]
    logits = torch.randn(len(labels), VOCABULARY)
    shares = torch.softmax(torch.randn(2, 6, SIZE), dim=-1)
    errors_m = torch.rand(2, 6, SIZE)
    told = response_loss(
        logits, torch.tensor(labels), torch.tensor(weights), FIRST_CODE, shares, errors_m, 2, error_weight
    )
    obvious = slow_loss(logits, labels, weights, shares.tolist(), errors_m.tolist(), error_weight)
    assert float(told.loss) == pytest.approx(obvious, rel=1e-5)
    likely = torch.softmax(logits, dim=-1)[[2, 10], FIRST_CODE : FIRST_CODE + SIZE]
    expected = (likely * errors_m[:, 0]).sum(dim=1).mean()
    assert float(told.code_error_m) == pytest.approx(float(expected), rel=1e-5)


def test_tokens_of_weight_zero_teach_nothing() -> None:
    logits = torch.randn(2, VOCABULARY, requires_grad=True)
    labels, weights = torch.tensor([1, 2]), torch.tensor([0.0, 1.0])
    loss = response_loss(logits, labels, weights, FIRST_CODE, NO_CODES, NO_CODES, 1).loss
    (gradient,) = torch.autograd.grad(loss, logits)
    assert gradient[0].abs().max() == 0
    assert gradient[1].abs().max() > 0


def test_no_weight_at_all_is_a_loss_of_zero() -> None:
    logits = torch.randn(1, VOCABULARY)
    loss = response_loss(
        logits, torch.tensor([1]), torch.tensor([0.0]), FIRST_CODE, NO_CODES, NO_CODES, 1
    ).loss
    assert float(loss) == 0.0


def test_forced_text_before_a_code_does_not_dilute_it() -> None:
    """A code teaches the same with and without a plan's known-by-heart tokens before it."""
    shares = torch.full((1, 6, SIZE), 1.0 / SIZE)
    code_logits = torch.randn(1, VOCABULARY)
    known = torch.full((50, VOCABULARY), -50.0)
    known[:, 1] = 50.0
    gradients = []
    for before in (known[:0], known):
        logits = torch.cat([before, code_logits]).requires_grad_()
        labels = torch.tensor([1] * len(before) + [FIRST_CODE])
        loss = response_loss(
            logits, labels, torch.full((len(labels),), 10.0), FIRST_CODE, shares[:, :1], shares[:, :1], 1
        ).loss
        gradients.append(torch.autograd.grad(loss, logits)[0][-1])
    torch.testing.assert_close(gradients[0], gradients[1])
