from __future__ import annotations

import numpy as np

from model.engines.torch.places import Fed, Places


def test_tokens_go_to_the_first_free_places_behind_their_prompt() -> None:
    places = Places(3, 10)
    written = places.write([Fed(0, 0, 0, 2), Fed(1, 1, 0, 1), Fed(2, 0, 0, 1)], [4, 2])
    assert written.prompts.tolist() == [0, 0, 1, 0]
    assert written.places.tolist() == [4, 5, 2, 6]
    assert [np.flatnonzero(row).tolist() for row in written.seen] == [
        [0, 1, 2, 3, 4],
        [0, 1, 2, 3, 4, 5],
        [0, 1, 2],
        [0, 1, 2, 3, 6],
    ]


def test_what_was_fed_in_vain_is_written_over() -> None:
    places = Places(1, 10)
    places.write([Fed(0, 0, 0, 4)], [3])
    written = places.write([Fed(0, 0, 1, 2)], [3])
    assert written.places.tolist() == [4, 5]


def test_draws_that_part_share_what_they_have_in_common() -> None:
    places = Places(2, 10)
    places.write([Fed(0, 0, 0, 2)], [1])
    places.copy(0, 1)
    written = places.write([Fed(0, 0, 2, 1), Fed(1, 0, 2, 1)], [1])
    assert written.places.tolist() == [3, 4]
    assert [np.flatnonzero(row).tolist() for row in written.seen] == [[0, 1, 2, 3], [0, 1, 2, 4]]
    # The first row ends; the second moves to its place and keeps what it has written.
    places.copy(1, 0)
    written = places.write([Fed(0, 0, 3, 2)], [1])
    assert written.places.tolist() == [3, 5]
    assert np.flatnonzero(written.seen[1]).tolist() == [0, 1, 2, 3, 4, 5]


def test_rows_that_are_not_fed_keep_what_they_have() -> None:
    places = Places(3, 10)
    places.write([Fed(0, 0, 0, 2), Fed(1, 1, 0, 2), Fed(2, 1, 0, 1)], [4, 2])
    places.write([Fed(0, 0, 2, 3)], [4, 2])
    written = places.write([Fed(1, 1, 2, 1), Fed(2, 1, 1, 1)], [4, 2])
    assert [np.flatnonzero(row).tolist() for row in written.seen] == [[0, 1, 2, 3, 5], [0, 1, 4, 6]]
