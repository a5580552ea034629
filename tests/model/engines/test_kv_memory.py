from __future__ import annotations

import numpy as np
import pytest

from looktwice.model.engines.torch.kv_memory import Memory, Pool, RowInput


def memory(rows: int, kv_length: int = 20) -> Memory:
    """With entries for so many rows of up to ten tokens."""
    made = Memory(rows=rows, row_tokens=10, kv_rows=2, kv_length=kv_length)
    for _ in range(rows):
        made.entries.take()
    return made


def test_the_lowest_free_number_is_taken_first() -> None:
    pool = Pool(3)
    assert [pool.take() for _ in range(3)] == [0, 1, 2]
    pool.give_back(2)
    pool.give_back(0)
    assert pool.free == 2
    assert pool.take() == 0
    pool.take()
    with pytest.raises(IndexError):
        pool.take()


def test_tokens_go_to_the_first_free_slots_behind_their_prompt() -> None:
    mapping = memory(3).map([RowInput(0, 0, 4, 0, 2), RowInput(1, 1, 2, 0, 1), RowInput(2, 0, 4, 0, 1)])
    assert mapping.kv_rows.tolist() == [0, 0, 1, 0]
    assert mapping.slots.tolist() == [4, 5, 2, 6]
    assert [np.flatnonzero(row).tolist() for row in mapping.seen] == [
        [0, 1, 2, 3, 4],
        [0, 1, 2, 3, 4, 5],
        [0, 1, 2],
        [0, 1, 2, 3, 6],
    ]
    assert [path.tolist() for path in mapping.paths] == [[4, 5], [2], [6]]


def test_slots_of_rejected_guesses_are_written_over() -> None:
    table = memory(1)
    table.map([RowInput(0, 0, 3, 0, 4)])
    mapping = table.map([RowInput(0, 0, 3, 1, 2)])
    assert mapping.slots.tolist() == [4, 5]
    assert [path.tolist() for path in mapping.paths] == [[3, 4, 5]]


def test_rows_that_part_share_what_they_have_in_common() -> None:
    table = Memory(rows=2, row_tokens=10, kv_rows=1, kv_length=20)
    first = table.entries.take()
    table.map([RowInput(first, 0, 1, 0, 2)])
    second = table.fork(first)
    mapping = table.map([RowInput(first, 0, 1, 2, 1), RowInput(second, 0, 1, 2, 1)])
    assert mapping.slots.tolist() == [3, 4]
    assert [np.flatnonzero(row).tolist() for row in mapping.seen] == [[0, 1, 2, 3], [0, 1, 2, 4]]
    # The first row ends, and its slot is free again.
    mapping = table.map([RowInput(second, 0, 1, 3, 2)])
    assert mapping.slots.tolist() == [3, 5]
    assert np.flatnonzero(mapping.seen[1]).tolist() == [0, 1, 2, 3, 4, 5]


def test_rows_fit_while_there_are_slots_for_what_they_hold_and_bring() -> None:
    table = Memory(rows=3, row_tokens=10, kv_rows=1, kv_length=12)
    first = table.entries.take()
    table.map([RowInput(first, 0, 4, 0, 5)])
    second, third = table.fork(first), table.fork(first)
    # The prompt takes four of twelve slots, and what the rows have in common five.
    assert table.fitting([RowInput(row, 0, 4, 5, 1) for row in (first, second, third)]) == 3
    assert table.fitting([RowInput(first, 0, 4, 5, 1), RowInput(second, 0, 4, 5, 3)]) == 1
    assert table.fitting([RowInput(first, 0, 4, 5, 1), RowInput(second, 0, 4, 0, 2)]) == 2
    assert table.fitting([]) == 0
