from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from looktwice.loadtests.accounting import Summary, faults, summarise
from looktwice.loadtests.exchange import MISSED, Branch, Exchange, Outcome, Verdict
from looktwice.loadtests.loads import Window
from looktwice.loadtests.mix import RequestKind

WINDOW = Window("measured", 10, 20)


def answered(
    due_s: float, latency_s: float, branch: Branch = "direct", kind: RequestKind = RequestKind()
) -> Exchange:
    return Exchange(kind, due_s, due_s, due_s + latency_s, Verdict("answered", branch=branch))


def refused(due_s: float, outcome: Outcome, problem: str) -> Exchange:
    return Exchange(RequestKind(), due_s, due_s, due_s + 0.01, Verdict(outcome, problem))


def summary(*exchanges: Exchange, goal_s: float = 1.0) -> Summary:
    return summarise(exchanges, WINDOW, goal_s)


def test_a_request_belongs_to_the_window_it_was_due_in() -> None:
    told = summary(answered(9.9, 0.5), answered(10, 0.5), answered(19.9, 0.5), answered(20, 0.5))
    assert len(told.exchanges) == 2
    assert told.offered_rps == pytest.approx(0.2)


def test_latency_counts_from_when_a_request_was_due() -> None:
    late = Exchange(RequestKind(), 10, 12, 12.5, Verdict("answered", branch="direct"))
    assert summary(late).latencies().percentile_s("p50") == pytest.approx(2.5, rel=2e-3)
    assert summary(late).lags().percentile_s("p50") == pytest.approx(2, rel=2e-3)


def test_rejections_and_failures_are_told_apart_and_none_is_good() -> None:
    told = summary(
        answered(11, 0.1),
        refused(12, "rejected", "queue-full"),
        refused(13, "failed", "timeout"),
        refused(14, "failed", "timeout"),
    ).to_json()
    assert (told["errors"], told["rejected"], told["goodput"]) == (2, 1, 0.25)
    assert told["problems"] == {"timeout": 2, "queue-full": 1}
    assert told["latency_s"]["count"] == 1


def test_goodput_is_measured_at_each_requests_own_deadline() -> None:
    hurried = RequestKind(deadline_ms=200)
    told = summary(answered(11, 0.5), answered(12, 0.5, kind=hurried), answered(13, 0.1, kind=hurried))
    assert told.good == 2
    assert summary(answered(11, 0.5), goal_s=0.4).good == 0


def test_branches_have_figures_of_their_own() -> None:
    told = summary(answered(11, 0.1), answered(12, 0.1), answered(13, 2.0, "think")).to_json()["by_branch"]
    assert {branch: of["count"] for branch, of in told.items()} == {"direct": 2, "think": 1}
    assert told["think"]["latency_s"]["p50"] == pytest.approx(2, rel=2e-3)


def test_a_backlog_worked_off_later_was_not_achieved() -> None:
    """Ten a second where five can be served: the queue grows by five a second."""
    falling_behind = [answered(10 + i / 10, 0.1 + (i / 10) * 1.0) for i in range(100)]
    told = summary(*falling_behind)
    assert told.offered_rps == pytest.approx(10)
    assert told.achieved_share == pytest.approx(0.5, abs=0.03)
    assert "did not keep up" in faults(told, 1.0)[0]


def test_what_is_under_way_at_the_end_was_achieved() -> None:
    assert summary(*(answered(10 + i / 10, 0.9) for i in range(100))).achieved_share == 1


def test_planners_that_still_wait_count_as_offered_and_not_as_sent() -> None:
    missed = Exchange(RequestKind(), 11, math.nan, 12, MISSED)
    told = summary(answered(10.9, 1.1), missed)
    assert told.achieved_share == 0.5
    assert len(told.lags()) == 1


def test_a_client_that_is_late_makes_the_run_invalid() -> None:
    late = [
        Exchange(RequestKind(), 10 + i / 10, 10.3 + i / 10, 10.4 + i / 10, Verdict("answered"))
        for i in range(99)
    ]
    assert "the client was the bottleneck" in faults(summary(*late), 0.025)[0]
    assert faults(summary(*late), 0.5) == []


@settings(deadline=None, max_examples=50)
@given(
    st.lists(
        st.tuples(
            st.floats(0, 30), st.floats(0, 40), st.sampled_from(("answered", "rejected", "failed", "missed"))
        ),
        max_size=60,
    )
)
def test_every_request_is_counted_once(ended: list[tuple[float, float, Outcome]]) -> None:
    told = summary(
        *(
            Exchange(
                RequestKind(),
                due,
                due,
                due + took,
                Verdict(outcome, "" if outcome == "answered" else outcome),
            )
            for due, took, outcome in ended
        )
    )
    counts = told.to_json()["counts"]
    assert counts["offered"] == sum(counts[name] for name in ("answered", "rejected", "failed", "missed"))
    assert 0 <= told.good <= told.in_time <= counts["answered"]


def test_nothing_can_be_said_of_no_time() -> None:
    with pytest.raises(ValueError, match="takes no time"):
        summarise([], Window("empty", 5, 5), 1)
