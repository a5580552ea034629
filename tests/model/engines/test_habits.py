from __future__ import annotations

from model.engines.torch.habits import CONTEXT, Habits


def test_what_came_more_often_than_not_is_usual() -> None:
    habits = Habits()
    habits.saw([1, 2], 3, 1)
    assert habits.usual([1, 2]) is None, "once is no habit"
    habits.saw([1, 2], 3, 1)
    assert habits.usual([1, 2]) == 3
    habits.saw([1, 2], 4, 2)
    assert habits.usual([1, 2]) is None, "half is not more often than not"
    assert habits.usual([2, 1]) is None


def test_only_the_latest_tokens_matter() -> None:
    habits = Habits()
    end = list(range(CONTEXT))
    habits.saw([98, *end], 7, 2)
    assert habits.usual([99, *end]) == 7


def test_it_forgets_what_was_longest_unused() -> None:
    habits = Habits()
    for number in range(20_001):
        habits.saw([number], 5, 2)
    assert habits.usual([0]) is None
    assert habits.usual([1]) == 5
