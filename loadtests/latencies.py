"""Percentiles of times, from an HDR histogram: 1 µs to an hour, three digits, whatever the number of them."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Any, Final, Literal

from hdrh.histogram import HdrHistogram

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
