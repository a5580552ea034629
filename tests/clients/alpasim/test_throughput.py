from __future__ import annotations

import pytest

from looktwice.clients.alpasim.driver import DriverConfig
from looktwice.clients.alpasim.throughput import Throughput, measure
from tests.clients.alpasim.driving import driving
from tests.service.scenes import scene


def test_the_same_rollouts_are_driven_one_by_one_and_together() -> None:
    with driving(DriverConfig(deadline_ms=None)) as made:
        found = measure(made.address, [scene()], sessions=3, steps=2, rounds=2)
        assert made.driver.sessions == 0
    figures = found.to_json()
    assert (figures["sessions"], figures["steps"], figures["rounds"]) == (3, 2, 2)
    assert len(found.alone_s) == len(found.among_s) == 12
    # Two ways and one round to warm up; no picture comes twice.
    assert len(made.engine.submitted) == 2 * 3 * 3 * 2
    newest = [request.scene.clips[0].images[-1] for request in made.engine.submitted]
    assert len(set(newest)) == len(newest)


def test_the_ratio_is_the_median_of_the_rounds() -> None:
    found = Throughput(8, 1, (1.0, 2.0, 4.0), (3.0, 5.0, 40.0), (0.1,), (0.2,))
    assert found.ratio == pytest.approx(3.0)
