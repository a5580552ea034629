from __future__ import annotations

from model.engines.torch.habits import CONTEXTS, Habits


def test_a_random_number_selects_by_how_often_tokens_followed() -> None:
    habits = Habits()
    assert habits.likely([1, 2], 0.5) is None
    habits.saw([1, 2], 9, 3)
    habits.saw([1, 2], 4, 1)
    for number, token in ((0.0, 4), (0.24, 4), (0.26, 9), (0.99, 9), (None, 9)):
        assert habits.likely([1, 2], number) == (token, {4: 1, 9: 3}[token] / 5)
    assert habits.likely([2, 1], 0.5) is None


def test_the_longest_context_that_is_known_counts() -> None:
    habits = Habits()
    end = list(range(min(CONTEXTS)))
    habits.saw([98, *end], 7, 1)
    habits.saw([99, *end], 8, 1)
    assert habits.likely([98, *end], 0.9) == (7, 1 / 2)
    assert habits.likely([97, *end], 0.9) == (8, 1 / 3), (
        "of the last tokens, which are known, both came as often"
    )


def test_it_forgets_what_was_longest_unused() -> None:
    habits = Habits()
    for number in range(50_001):
        habits.saw([number], 5, 2)
    assert habits.likely([0], None) is None
    assert habits.likely([1], None) == (5, 2 / 3)
