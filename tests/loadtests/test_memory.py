from __future__ import annotations

import pytest

from looktwice.loadtests.memory import MemoryReading, growth


def test_growth_is_the_slope_of_what_was_read() -> None:
    readings = [MemoryReading(10.0 * step, 1_000_000 + 500 * step) for step in range(100)]
    grown = growth(readings)
    assert grown is not None
    assert grown.bytes_per_hour == pytest.approx(500 / 10 * 3600)
    assert grown.last_bytes - grown.first_bytes == pytest.approx(90 * 500, rel=0.02)
    assert grown.late == pytest.approx(45 * 500 / 1_022_500, rel=0.05)


def test_what_fills_up_in_the_first_half_is_no_growth_of_the_second() -> None:
    grown = growth([MemoryReading(float(step), 1_000_000 + 20_000 * min(step, 40)) for step in range(100)])
    assert grown is not None
    assert grown.last_bytes > 1.5 * grown.first_bytes
    assert grown.late == 0


def test_one_peak_is_no_growth() -> None:
    readings = [MemoryReading(float(step), 9_000_000 if step == 50 else 1_000_000) for step in range(101)]
    grown = growth(readings)
    assert grown is not None
    assert grown.first_bytes == grown.last_bytes
    assert grown.bytes_per_hour == pytest.approx(0, abs=1)


def test_one_reading_says_nothing() -> None:
    assert growth([MemoryReading(0, 1)]) is None
