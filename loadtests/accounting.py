"""From exchanges to figures: rates, latencies, goodput; no input or output."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Literal

from hdrh.histogram import HdrHistogram

from looktwice.loadtests.exchange import BRANCHES, OUTCOMES, Exchange
from looktwice.loadtests.loads import Window

_US_PER_S: Final = 1e6
_LONGEST_US: Final = 3_600_000_000
_DIGITS: Final = 3
Percentile = Literal["p50", "p90", "p95", "p99", "p999"]
PERCENTILES: Final[dict[Percentile, float]] = {
    "p50": 50.0,
    "p90": 90.0,
    "p95": 95.0,
    "p99": 99.0,
    "p999": 99.9,
}


class Latencies:
    """A histogram of seconds; times beyond an hour count as an hour."""

    def __init__(self, seconds: Iterable[float] = ()) -> None:
        self._histogram = HdrHistogram(1, _LONGEST_US, _DIGITS)
        for value in seconds:
            self._histogram.record_value(min(max(round(value * _US_PER_S), 1), _LONGEST_US))

    def __len__(self) -> int:
        return int(self._histogram.get_total_count())

    def percentile_s(self, name: Percentile) -> float | None:
        """The time within which so many lie; None where there are no times."""
        return self._percentiles_us[PERCENTILES[name]] / _US_PER_S if len(self) else None

    def beyond(self, name: Percentile) -> int:
        """How many times lie above the percentile: what its figure rests on."""
        return round(len(self) * (1 - PERCENTILES[name] / 100))

    def buckets(self) -> list[tuple[float, int]]:
        """(upper edge in s, count) of every bucket that holds a time, ascending."""
        return [
            (step.value_iterated_to / _US_PER_S, step.count_added_in_this_iter_step)
            for step in self._histogram.get_recorded_iterator()
        ]

    def to_json(self) -> dict[str, Any]:
        """Percentiles in seconds (null without times), and how many times lie above each.

        ``hdr`` is the histogram itself, in the format that other HDR histogram tools read and add up.
        """
        return {
            **{name: self.percentile_s(name) for name in PERCENTILES},
            "max": self._histogram.get_max_value() / _US_PER_S if len(self) else None,
            "count": len(self),
            "beyond": {name: self.beyond(name) for name in PERCENTILES},
            "hdr": self._histogram.encode().decode() if len(self) else None,
        }

    @cached_property
    def _percentiles_us(self) -> dict[float, int]:
        # All in one go: each walk through the histogram takes milliseconds.
        found: dict[float, int] = self._histogram.get_percentile_to_value_dict(list(PERCENTILES.values()))
        return found


LEAST_ACHIEVED: Final = 0.99
"""Of what was offered: below, the figures are those of another load than the one that was asked for."""


@dataclass(frozen=True)
class Summary:
    """One window's figures.

    Attributes:
        window: the stretch of the run; a request belongs to where it was due.
        exchanges: its requests, in the order they were due.
        goal_s: the latency that requests without a deadline of their own should have.
        in_time: requests of the window whose answers were there by its end, or within their goal.
    """

    window: Window
    exchanges: tuple[Exchange, ...]
    goal_s: float
    in_time: int

    @property
    def offered_rps(self) -> float:
        """Requests due per second."""
        return len(self.exchanges) / self.window.seconds

    @property
    def achieved_rps(self) -> float:
        """Requests answered per second, as far as the service kept up.

        An answer counts when it came before the window's end, or within its goal: a backlog that is worked
        off later was not served at the offered rate, a request under way at the end was.
        """
        return self.in_time / self.window.seconds

    @property
    def achieved_share(self) -> float:
        """Achieved of offered; 1 where nothing was offered."""
        return self.in_time / len(self.exchanges) if self.exchanges else 1.0

    @property
    def good(self) -> int:
        """Requests answered within their deadline or goal."""
        return sum(exchange.good(self.goal_s) for exchange in self.exchanges)

    @property
    def goodput(self) -> float:
        """Share of all offered requests that are `good`, rejected and failed ones among them; 1 of none."""
        return self.good / len(self.exchanges) if self.exchanges else 1.0

    def count(self, outcome: str) -> int:
        """Requests that ended so."""
        return sum(exchange.verdict.outcome == outcome for exchange in self.exchanges)

    def answered(self, branch: str | None = None) -> list[Exchange]:
        """Answered requests, of one branch or of all."""
        return [
            each
            for each in self.exchanges
            if each.verdict.outcome == "answered" and branch in (None, each.verdict.branch)
        ]

    def latencies(self, branch: str | None = None) -> Latencies:
        """Of answered requests, from when they were due."""
        return Latencies(each.latency_s for each in self.answered(branch))

    def lags(self) -> Latencies:
        """How late requests were sent; ``missed`` ones never were."""
        return Latencies(each.lag_s for each in self.exchanges if each.verdict.outcome != "missed")

    def problems(self) -> dict[str, int]:
        """Why requests were not answered, by how often."""
        return dict(
            Counter(each.verdict.problem for each in self.exchanges if each.verdict.problem).most_common()
        )

    def to_json(self) -> dict[str, Any]:
        """Scripts rely on the keys that DESIGN's commands list."""
        answered = self.answered()
        first_plans = [each.first_plan_s - each.due_s for each in answered if each.first_plan_s is not None]
        told = [each.verdict for each in answered if each.verdict.deadline_met is not None]
        return {
            "offered_rps": self.offered_rps,
            "achieved_rps": self.achieved_rps,
            "latency_s": self.latencies().to_json(),
            "errors": self.count("failed"),
            "rejected": self.count("rejected"),
            "goodput": self.goodput,
            "goodput_rps": self.good / self.window.seconds,
            "goal_s": self.goal_s,
            "by_branch": {
                branch: {"count": len(found), "latency_s": found.to_json()}
                for branch in BRANCHES
                if len(found := self.latencies(branch))
            },
            "by_kind": dict(Counter(str(each.kind) for each in self.exchanges).most_common()),
            "seconds": self.window.seconds,
            "counts": {
                "offered": len(self.exchanges),
                **{name: self.count(name) for name in OUTCOMES},
            },
            "problems": self.problems(),
            "schedule_lag_s": self.lags().to_json(),
            "first_plan_s": Latencies(first_plans).to_json() if first_plans else None,
            "deadlines": {
                "met": sum(bool(verdict.deadline_met) for verdict in told),
                "missed": sum(not verdict.deadline_met for verdict in told),
                "cut_draws": sum(verdict.cut or 0 for verdict in told),
            }
            if told
            else None,
        }


def summarise(exchanges: Sequence[Exchange], window: Window, goal_s: float) -> Summary:
    """The figures of the requests that were due in ``window``."""
    if window.seconds <= 0:
        raise ValueError(f"nothing can be said of {window.name}: it takes no time")
    within = sorted(
        (each for each in exchanges if window.start_s <= each.due_s < window.end_s),
        key=lambda each: each.due_s,
    )
    in_time = sum(
        each.verdict.outcome == "answered" and (each.ended_s <= window.end_s or each.good(goal_s))
        for each in within
    )
    return Summary(window, tuple(within), goal_s, in_time)


def faults(summary: Summary, lag_limit_s: float) -> list[str]:
    """Why the figures are not those of the load that was asked for; empty when they are."""
    found = []
    lag_s = summary.lags().percentile_s("p99")
    if lag_s is not None and lag_s > lag_limit_s:
        found.append(
            f"{summary.window.name}: the client was the bottleneck: 1 in 100 requests was sent more than "
            f"{lag_s * 1e3:.1f} ms late, the limit is {lag_limit_s * 1e3:.0f} ms; take more --workers, "
            "or another machine than the server's"
        )
    if summary.achieved_share < LEAST_ACHIEVED:
        found.append(
            f"{summary.window.name}: the service did not keep up: {summary.achieved_rps:.2f} of "
            f"{summary.offered_rps:.2f} requests a second, {summary.achieved_share:.1%}"
        )
    return found
