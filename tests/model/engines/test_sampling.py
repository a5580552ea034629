from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.engines.sampling import choose, probabilities, uniform

LOGITS = np.array([0.0, 1.0, 2.0, -1.0])


def test_numbers_are_uniform_and_independent_of_neighbours() -> None:
    numbers = np.array([[uniform(7, draw, position) for position in range(200)] for draw in range(50)])
    assert numbers.min() >= 0
    assert numbers.max() < 1
    counts, _ = np.histogram(numbers, bins=20, range=(0, 1))
    assert np.abs(counts - 500).max() < 120  # five standard deviations
    assert abs(np.corrcoef(numbers[:-1].ravel(), numbers[1:].ravel())[0, 1]) < 0.05
    assert abs(np.corrcoef(numbers[:, :-1].ravel(), numbers[:, 1:].ravel())[0, 1]) < 0.05


def test_numbers_depend_on_nothing_else() -> None:
    assert uniform(1, 2, 3) == uniform(1, 2, 3)
    assert len({uniform(1, 2, 3), uniform(1, 3, 2), uniform(2, 1, 3), uniform(3, 2, 1)}) == 4


def test_temperature_zero_takes_the_likeliest() -> None:
    assert choose(LOGITS, 0.0, 1.0, np.array([0.999, 0.1])).tolist() == [2, 2]


@pytest.mark.parametrize("temperature", [0.5, 1.0, 1.5])
def test_choices_follow_the_distribution(temperature: float) -> None:
    picks = choose(LOGITS, temperature, 1.0, (np.arange(10_000) + 0.5) / 10_000)
    shares = np.bincount(picks, minlength=4) / 10_000
    assert np.abs(shares - probabilities(LOGITS, temperature)).max() < 2e-4


def test_top_p_keeps_the_likeliest_mass() -> None:
    picks = set(choose(LOGITS, 1.0, 0.8, (np.arange(1000) + 0.5) / 1000).tolist())
    assert picks == {1, 2}  # 0.64 + 0.24 reach 0.8
    assert choose(LOGITS, 1.0, 1e-9, np.array([0.3])).tolist() == [2]


@given(
    st.lists(st.floats(-50, 50), min_size=1, max_size=20),
    st.floats(0.01, 2),
    st.floats(0.01, 1),
    st.floats(0, 1, exclude_max=True),
)
def test_a_choice_always_has_mass(
    logits: list[float], temperature: float, top_p: float, number: float
) -> None:
    position = choose(np.array(logits), temperature, top_p, np.array([number]))[0]
    assert probabilities(np.array(logits), temperature)[position] > 0
