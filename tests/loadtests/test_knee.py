from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.loadtests.scenarios.sweep import KneeSearch, knee_rps


def searched(search: KneeSearch, capacity_rps: float) -> dict[float, bool]:
    tried: dict[float, bool] = {}
    while (rate := search.next_rps(tried)) is not None:
        assert rate not in tried
        tried[rate] = rate <= capacity_rps
    return tried


@given(st.floats(0.2, 500), st.floats(0.2, 50))
def test_it_ends_with_the_knee_between_two_rates_close_to_each_other(capacity: float, first: float) -> None:
    tried = searched(KneeSearch(first, most_points=40), capacity)
    knee = knee_rps(tried)
    assert knee is not None
    too_high = min(rate for rate, held in tried.items() if not held)
    assert knee <= capacity < too_high
    assert too_high / knee <= 1.1 + 1e-9
    assert len(tried) <= 20


def test_it_gives_up_where_nothing_is_sustained() -> None:
    tried = searched(KneeSearch(1.0), capacity_rps=0)
    assert knee_rps(tried) is None
    assert min(tried) == 0.2


def test_it_stops_at_the_limit_of_points() -> None:
    assert len(searched(KneeSearch(1.0, most_points=5), capacity_rps=1e9)) == 5


def test_a_lucky_rate_above_one_that_failed_is_no_knee() -> None:
    assert knee_rps({1: True, 2: True, 4: False, 8: True}) == 2


@pytest.mark.parametrize(
    "wrong", [{"first_rps": 0}, {"first_rps": 1, "growth": 1}, {"first_rps": 1, "precision": 0}]
)
def test_a_search_that_cannot_end_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="search begins"):
        KneeSearch(**wrong)  # type: ignore[arg-type]
