from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.loadtests.loads import LoadPhase, poisson_arrivals, windows

PHASES = st.lists(
    st.builds(LoadPhase, st.just("any"), st.floats(0, 20), st.floats(0, 50)), min_size=1, max_size=4
)


@given(PHASES, st.integers(0, 2**32))
def test_arrivals_are_ascending_seeded_and_within_the_run(phases: list[LoadPhase], seed: int) -> None:
    due_s = poisson_arrivals(phases, seed)
    assert (np.diff(due_s) >= 0).all()
    assert ((due_s >= 0) & (due_s <= windows(phases)[-1].end_s)).all()
    np.testing.assert_array_equal(due_s, poisson_arrivals(phases, seed))


def test_gaps_are_exponential_and_rates_those_of_the_phases() -> None:
    calm, burst = LoadPhase("calm", 2000, 5), LoadPhase("burst", 200, 50)
    due_s = poisson_arrivals([calm, burst], 3)
    before, after = due_s[due_s < 2000], due_s[due_s >= 2000]
    assert len(before) == pytest.approx(10_000, rel=0.05)
    assert len(after) == pytest.approx(10_000, rel=0.05)
    gaps = np.diff(before)
    assert gaps.mean() == pytest.approx(0.2, rel=0.05)
    assert gaps.std() == pytest.approx(0.2, rel=0.1), "as spread as they are long on average"


def test_other_seeds_give_other_arrivals() -> None:
    phases = [LoadPhase("one", 10, 10)]
    assert poisson_arrivals(phases, 1).tolist() != poisson_arrivals(phases, 2).tolist()


def test_nothing_is_offered_at_no_rate_and_time_does_not_run_backwards() -> None:
    assert len(poisson_arrivals([LoadPhase("still", 10, 0)], 0)) == 0
    with pytest.raises(ValueError, match="negative"):
        LoadPhase("back", -1, 1)
