from __future__ import annotations

from pathlib import Path

import pytest

from looktwice.model.engines.engine_requests import leads_to_reflection
from looktwice.model.engines.sampling import uniform
from looktwice.model.engines.torch.drafter import _CONTEXTS, Drafter, _Ngrams, _Responses
from looktwice.model.engines.torch.rows import Row
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.format import BRANCH
from looktwice.model.network.checkpoint import Loaded, load
from tests.model.engines.decoding import beginning


@pytest.fixture(scope="module")
def loaded(untrained_checkpoint: Path) -> Loaded:
    return load(untrained_checkpoint)


def _reflects(row: Row, token: int) -> bool:
    assert CF_VLA.branch is not None
    return leads_to_reflection(CF_VLA.branch, row.cursor, token)


def whole(loaded: Loaded) -> Row:
    """A row that has written a response of its last choices."""
    row = beginning(loaded, seed=1)
    while not row.cursor.done:
        row.write(int(row.cursor.allowed().ids[-1]), loaded.vocabulary)
    return row


def test_without_guesses_a_row_feeds_what_is_pending(loaded: Loaded) -> None:
    row = beginning(loaded)
    tokens, decisions = Drafter().propose(row, rows=0)
    assert tokens == row.pending
    assert [place for place, _ in decisions] == [len(tokens) - 1]


def test_a_guess_is_what_the_draws_own_number_selects(loaded: Loaded) -> None:
    """Half of the others chose the first, half the last: which is guessed is in the seed."""
    guessed = set()
    for seed in range(12):
        row, drafter = beginning(loaded, seed=seed), Drafter()
        ids = row.cursor.allowed().ids
        drafter.observe(row, len(ids), [(int(ids[0]), (0, 1, 2)), (int(ids[-1]), (3, 4, 5))])
        tokens, decisions = drafter.propose(row, rows=1)
        guess = tokens[len(row.pending)]
        assert guess == int(ids[0 if uniform(seed, 0, len(row.tokens)) < 0.5 else -1])
        assert len(decisions) == 2, "the decision guessed, and the next one, which is not"
        guessed.add(guess)
    assert len(guessed) == 2


def test_guesses_that_are_not_sure_are_made_while_few_rows_share_a_pass(loaded: Loaded) -> None:
    row, drafter = beginning(loaded), Drafter()
    ids = row.cursor.allowed().ids
    drafter.observe(row, len(ids), [(int(token), (0,)) for token in ids[:8]])
    assert len(drafter.propose(row, rows=4)[0]) > len(row.pending)
    assert drafter.propose(row, rows=40)[0] == row.pending
    drafter.observe(row, len(ids), [(int(ids[0]), tuple(range(56))), (int(ids[-1]), tuple(range(56)))])
    assert len(drafter.propose(row, rows=40)[0]) > len(row.pending)


def test_a_revised_plan_is_fed_as_the_first_went_on_while_it_repeats_it(loaded: Loaded) -> None:
    row = beginning(loaded, thinking="always")
    while row.cursor.section != "revised_plan":
        ids, stop_id = row.cursor.allowed().ids, row.cursor.stop_id
        if row.cursor.allowed().choice == BRANCH:
            ids = ids[[_reflects(row, int(id)) for id in ids]]
        row.write(int(ids[0]) if stop_id is None or stop_id not in ids else stop_id, loaded.vocabulary)
    first = [token.id for token in row.tokens if token.section == "plan"]
    already = sum(token.section == "revised_plan" for token in row.tokens)
    tokens, decisions = Drafter().propose(row, rows=1)
    assert tokens[len(row.pending) :][: len(first) - already] == first[already:]
    assert len(decisions) > 3, "all decisions of the plan are checked in one pass"
    other = next(int(id) for id in row.cursor.allowed().ids if int(id) != first[already])
    row.write(other, loaded.vocabulary)
    assert Drafter().propose(row, rows=1)[0] == row.pending


def test_the_more_rows_the_less_of_the_last_answer_is_fed(loaded: Loaded) -> None:
    drafter, first = Drafter(), whole(loaded)
    drafter.finished(first)
    row = beginning(loaded, seed=1)
    few, many = (len(drafter.propose(row, rows=rows)[0]) - len(row.pending) for rows in (6, 96))
    assert few > many > 0


def test_at_temperature_zero_the_most_frequent_is_guessed(loaded: Loaded) -> None:
    row, drafter = beginning(loaded, temperature=0.0), Drafter()
    ids = row.cursor.allowed().ids
    drafter.observe(row, len(ids), [(int(ids[0]), (0,)), (int(ids[1]), (1, 2))])
    tokens, _ = drafter.propose(row, rows=1)
    assert tokens[len(row.pending)] == int(ids[1])


def test_texts_are_guessed_though_any_word_may_follow(loaded: Loaded) -> None:
    row, drafter = beginning(loaded), Drafter()
    while row.cursor.stop_id is None:
        allowed = row.cursor.allowed()
        token = int(allowed.ids[-1])
        if allowed.choice == BRANCH:
            token = next(int(id) for id in allowed.ids if _reflects(row, int(id)))
        row.write(token, loaded.vocabulary)
    ids = row.cursor.allowed().ids
    assert len(ids) > 64
    drafter.observe(row, len(ids), [(int(ids[5]), (0,))])
    tokens, _ = drafter.propose(row, rows=1)
    assert tokens[len(row.pending) :] == [int(ids[5])]


def test_the_last_answer_to_the_same_pictures_is_repeated(loaded: Loaded) -> None:
    drafter, first = Drafter(), whole(loaded)
    drafter.finished(first)
    row = beginning(loaded, seed=1)
    tokens, decisions = drafter.propose(row, rows=1)
    repeated = [token.id for token in first.tokens]
    assert tokens[1:] == repeated[: len(tokens) - 1]
    assert len(tokens) > len(row.pending) + 10
    assert len(decisions) > 3


def test_a_response_that_goes_another_way_than_the_last_one_is_guessed_from_what_followed(
    loaded: Loaded,
) -> None:
    drafter, first = Drafter(), whole(loaded)
    drafter.finished(first)
    row = beginning(loaded, seed=1)
    row.write(int(row.cursor.allowed().ids[0]), loaded.vocabulary)
    assert drafter.propose(row, rows=1)[0] == row.pending
    ids = row.cursor.allowed().ids
    drafter.observe(row, len(ids), [(int(ids[1]), (0,))])
    tokens, _ = drafter.propose(row, rows=1)
    assert tokens[len(row.pending)] == int(ids[1])


def test_a_random_number_selects_by_how_often_tokens_followed() -> None:
    ngrams = _Ngrams()
    assert ngrams.likely([1, 2], 0.5) is None
    ngrams.count([1, 2], 9, 3)
    ngrams.count([1, 2], 4, 1)
    for number, token in ((0.0, 4), (0.24, 4), (0.26, 9), (0.99, 9), (None, 9)):
        assert ngrams.likely([1, 2], number) == (token, {4: 1, 9: 3}[token] / 5)
    assert ngrams.likely([2, 1], 0.5) is None


def test_the_longest_context_that_is_known_counts() -> None:
    ngrams = _Ngrams()
    end = list(range(min(_CONTEXTS)))
    ngrams.count([98, *end], 7, 1)
    ngrams.count([99, *end], 8, 1)
    assert ngrams.likely([98, *end], 0.9) == (7, 1 / 2)
    assert ngrams.likely([97, *end], 0.9) == (8, 1 / 3), (
        "of the last tokens, which are known, both came as often"
    )


def test_it_forgets_what_was_longest_unused() -> None:
    ngrams = _Ngrams()
    for number in range(50_001):
        ngrams.count([number], 5, 2)
    assert ngrams.likely([0], None) is None
    assert ngrams.likely([1], None) == (5, 2 / 3)


def test_every_draw_has_its_own_last_response() -> None:
    responses = _Responses()
    responses.keep(b"scene", (0, 2), [1, 2, 3])
    responses.keep(b"scene", (1,), [1, 5])
    responses.keep(b"scene", (2,), [9])
    assert [responses.last(b"scene", draw) for draw in range(4)] == [(1, 2, 3), (1, 5), (9,), ()]
    assert responses.last(b"other", 0) == ()


def test_the_oldest_scenes_are_forgotten() -> None:
    responses = _Responses()
    for number in range(257):
        responses.keep(str(number).encode(), (0,), [number])
    assert responses.last(b"0", 0) == ()
    assert responses.last(b"256", 0) == (256,)
