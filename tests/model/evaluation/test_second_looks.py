"""What second looks bring, told from outcomes alone."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.outcome import FailureName, Outcome
from looktwice.model.evaluation.perception import auc
from looktwice.model.evaluation.second_looks import FollowedDraw, outcome_table


def outcome(*fails: FailureName) -> Outcome:
    return Outcome(fails, None, None, None, None, None, None, 50.0, 60.0)


HOLDS, LATE, CRASH = outcome(), outcome("behind"), outcome("collision", "behind")


def draw(
    first: Outcome, last: Outcome | None = None, probability: float = 0.5, episode: str = "a"
) -> FollowedDraw:
    return FollowedDraw(episode, probability, first, last is not None, first if last is None else last)


def test_outcomes_are_ranked_by_what_hurts() -> None:
    assert (CRASH.rank, LATE.rank, HOLDS.rank) == (0, 1, 2)
    assert outcome("comfort").rank == 1
    assert {outcome(name).rank for name in ("off_road", "off_route", "collision")} == {0}


def test_looks_are_better_worse_or_neither() -> None:
    draws = [
        draw(LATE, HOLDS),
        draw(CRASH, LATE),
        draw(HOLDS, LATE),
        draw(CRASH, CRASH),
        draw(HOLDS, HOLDS),
        draw(HOLDS),
        draw(CRASH),
        draw(LATE),
    ]
    table = outcome_table(draws, scenes=4, expert_fails=1, unpaired=2)
    assert (table.revised_better.value, table.revised_worse.value) == (2 / 5, 1 / 5)
    assert table.think_rate.value == 5 / 8
    assert table.rates["never"]["collision"].value == 3 / 8
    assert table.rates["adaptive"]["collision"].value == 2 / 8
    assert table.rates["never"]["behind"].value == 5 / 8
    told = json.loads(json.dumps(table.to_json()))
    assert told["revised_better_by_outcome"] == 2 / 5
    assert told["revised_worse_by_outcome"] == 1 / 5
    assert told["revised_better_by_outcome_count"] == 5
    assert (told["scenes"], told["expert_fails"], told["unpaired"]) == (4, 1, 2)
    assert told["outcomes"]["adaptive"]["holds"]["value"] == 3 / 8
    assert "better by outcome: 0.400" in str(table)


def test_nothing_is_told_of_nothing() -> None:
    table = outcome_table([draw(HOLDS)], scenes=1)
    assert table.think_outcome_auc.value is None
    assert table.revised_better.value is None
    assert outcome_table([], scenes=0).think_rate.value is None
    assert str(table)


@given(
    st.lists(
        st.tuples(st.booleans(), st.sampled_from([0.1, 0.2, 0.5, 0.9]), st.sampled_from("abc")),
        min_size=2,
        max_size=30,
    )
)
def test_the_area_is_that_of_all_pairs(told: Sequence[tuple[bool, float, str]]) -> None:
    draws = [
        draw(LATE if fails else HOLDS, probability=probability, episode=episode)
        for fails, probability, episode in told
    ]
    figure = outcome_table(draws, scenes=len(draws)).think_outcome_auc
    expected = auc(
        np.array([probability for _, probability, _ in told]), np.array([fails for fails, _, _ in told])
    )
    assert figure.value == (None if expected is None else pytest.approx(expected))
    if figure.interval is not None:
        assert 0.0 <= figure.interval[0] <= figure.interval[1] <= 1.0


def test_an_interval_is_over_episodes() -> None:
    """Many draws of one episode are no more certain than the episode is."""
    random = np.random.default_rng(3)
    draws = [
        draw(
            LATE if fails else HOLDS, probability=float(random.random() * (0.5 + fails)), episode=str(k % 12)
        )
        for k, fails in enumerate(random.random(240) < 0.4)
    ]
    once = outcome_table(draws, scenes=60).think_outcome_auc
    twice = outcome_table([*draws, *draws], scenes=60).think_outcome_auc
    assert once.interval is not None
    assert once.value is not None
    assert once.interval[0] < once.value < once.interval[1]
    assert twice.interval == pytest.approx(once.interval)
