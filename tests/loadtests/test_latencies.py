from __future__ import annotations

import numpy as np
import pytest
from hdrh.histogram import HdrHistogram
from hypothesis import given, settings
from hypothesis import strategies as st

from looktwice.loadtests.accounting import PERCENTILES, Latencies


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(1e-5, 3000), min_size=1, max_size=300))
def test_percentiles_are_those_of_the_times_to_three_digits(seconds: list[float]) -> None:
    latencies = Latencies(seconds)
    ordered = np.sort(seconds)
    for name, percent in PERCENTILES.items():
        # The smallest time that so many percent do not exceed; one to each side, as counts are rounded.
        place = round(percent / 100 * len(ordered))
        near = ordered[max(0, place - 2) : place + 1]
        found = latencies.percentile_s(name)
        assert found is not None
        assert near[0] * 0.998 - 2e-6 <= found <= near[-1] * 1.002 + 2e-6


def test_buckets_hold_every_time_once() -> None:
    latencies = Latencies([0.1, 0.1, 0.2, 5.0])
    assert [count for _, count in latencies.buckets()] == [2, 1, 1]
    assert latencies.buckets()[-1][0] == pytest.approx(5, rel=2e-3)


def test_the_histogram_can_be_read_and_added_up_by_others() -> None:
    told = Latencies([0.1] * 99 + [1.0]).to_json()
    other = HdrHistogram.decode(told["hdr"])
    other.add(HdrHistogram.decode(told["hdr"]))
    assert other.get_total_count() == 200
    assert other.get_value_at_percentile(50) == pytest.approx(100_000, rel=2e-3)


def test_figures_say_how_much_they_rest_on() -> None:
    told = Latencies([0.1] * 2000).to_json()
    assert told["count"] == 2000
    assert told["beyond"] == {"p50": 1000, "p90": 200, "p95": 100, "p99": 20, "p999": 2}


def test_without_times_there_are_no_figures() -> None:
    told = Latencies().to_json()
    assert (told["p50"], told["p999"], told["max"], told["hdr"]) == (None, None, None, None)


def test_whatever_takes_hours_counts_as_an_hour() -> None:
    assert Latencies([10_000]).percentile_s("p50") == pytest.approx(3600, rel=2e-3)
