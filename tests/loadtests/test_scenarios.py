"""Whole scenarios, with worker processes, against a service whose behaviour is known."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from looktwice.loadtests.attacks import Hostility
from looktwice.loadtests.load_report import LoadReport
from looktwice.loadtests.load_run import Result, Setup
from looktwice.loadtests.mix import Mix
from looktwice.loadtests.report_page import page
from looktwice.loadtests.scenarios.hostile import hostile
from looktwice.loadtests.scenarios.steady import burst, fleet, poisson, soak
from looktwice.loadtests.scenarios.sweep import KneeSearch, sweep
from tests.loadtests.scenes import setup
from tests.loadtests.stand_in import StandIn, standing_in

ONE_DRAW = Mix(draws={1: 1})


class Page(HTMLParser):
    """Notes what a page is made of, and what it would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.fetched: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "xlink:href") and not (value or "").startswith(("#", "data:")):
                self.fetched.append(value or "")


def written(result: Result, used: Setup) -> Page:
    card = {"name": "<stand-in>", "revision": "1", "engine": "none"}
    read = Page()
    read.feed(page(LoadReport(used, result, "2026-01-01", {"cores": 2}, {"models": [card]}, {"python": "3"})))
    assert "script" not in read.tags
    assert read.fetched == []
    return read


def test_a_steady_rate_between_two_workers() -> None:
    service = StandIn()
    mix = Mix(works={"direct": 1, "think": 1}, draws={1: 1}, payloads={"json": 1, "msgpack": 1}, stream=0.5)
    with standing_in(service) as url:
        used = replace(setup(url, mix, rate_rps=30), workers=2)
        result = poisson(used)
    told = result.overall.to_json()
    # Whether the run counts is a matter of how busy the machine is.
    assert told["counts"]["answered"] == told["counts"]["offered"] > 30
    assert set(told["by_branch"]) == {"direct", "think"}
    assert told["first_plan_s"]["count"] > 5
    assert len(result.exchanges) == len(service.seen) > told["counts"]["offered"], "the warm-up stands apart"
    assert written(result, used).tags.count("svg") == 2


def test_a_sweep_finds_the_knee_of_a_service_that_serves_one_at_a_time() -> None:
    with standing_in(StandIn(service_s=0.01, at_once=1)) as url:
        used = setup(url, ONE_DRAW, seconds=1.5, goal_s=0.5)
        result = sweep(used, KneeSearch(30, growth=4, precision=4.0))
    knee_rps = result.extra["knee_rps"]
    assert knee_rps is not None
    assert knee_rps < 100, "more cannot be served"
    points = {point["rate_rps"]: point["sustained"] for point in result.extra["points"]}
    assert not points[max(points)]
    assert result.overall.window.name == "measured"
    assert written(result, used).tags.count("svg") == 2


def test_a_sweep_without_a_knee_is_not_valid() -> None:
    with standing_in(StandIn(failing=True)) as url:
        result = sweep(setup(url, ONE_DRAW, rate_rps=200, seconds=1), KneeSearch(200, least_rps=150))
    assert result.extra["knee_rps"] is None
    assert "no rate was sustained" in result.faults[-1]


def test_a_fleet_gets_what_the_service_can_give() -> None:
    with standing_in(StandIn(service_s=0.15)) as url:
        used = setup(url, ONE_DRAW, seconds=2, goal_s=0.1)
        result = fleet(used, planners=3, hz=10)
    assert result.overall.offered_rps == pytest.approx(30, rel=0.05)
    assert 1 < result.extra["fleet"]["plans_hz"] <= 5.5, "every second tick goes by"
    assert result.extra["fleet"]["missed_share"] >= 0.4
    assert "did not keep up" in result.faults[0]
    assert "svg" in written(result, used).tags


def test_a_burst_is_told_apart_from_what_was_before() -> None:
    with standing_in(StandIn(service_s=0.04, at_once=1, most_waiting=5)) as url:
        used = setup(url, ONE_DRAW, rate_rps=4, seconds=2)
        result = burst(used, factor=20, burst_s=1.5)
    told = result.extra["burst"]
    assert result.valid, result.faults
    # How much slower it is depends on the machine; that it is told from these phases does not.
    before_s, during_s = (
        result.phases[name].latencies().percentile_s("p95") for name in ("unloaded", "burst")
    )
    assert before_s is not None
    assert during_s is not None
    assert told["p95_ratio"] == pytest.approx(during_s / before_s)
    assert told["rejected"] == result.phases["burst"].count("rejected")
    assert told["rejected"] > 20
    assert result.phases["unloaded"].count("rejected") == 0
    assert result.phases["burst"].window.seconds == pytest.approx(1.5)
    assert written(result, used).tags.count("svg") == 2


def test_failures_in_a_burst_are_not_how_a_service_refuses() -> None:
    with standing_in(StandIn(failing=True)) as url:
        result = burst(setup(url, ONE_DRAW, rate_rps=5, seconds=1), factor=4, burst_s=1)
    assert any("not how a service refuses" in fault for fault in result.faults)


def test_polite_clients_are_measured_while_others_are_hostile() -> None:
    service = StandIn(service_s=0.1)
    with standing_in(service) as url:
        used = setup(url, Mix(draws={1: 1, 2: 1}), rate_rps=10, seconds=1.5)
        result = hostile(used, Hostility(leaving=2, never_reading=2, slow_bodies=3))
    assert result.valid, result.faults
    asked = [
        [
            (each.kind, round(each.due_s - part.window.start_s, 6))
            for each in sorted(part.exchanges, key=lambda each: each.due_s)
        ]
        for part in result.phases.values()
    ]
    assert asked[0] == asked[1] == asked[2], "the same is asked before, meanwhile and after"
    assert len({kind for kind, _ in asked[0]}) == 2
    ends = result.extra["hostile"]["clients"]
    assert ends["leaving"]["left"] > 5
    assert ends["never_reading"] == {"200": 2}
    assert ends["slow_bodies"] == {"held": 3}
    assert result.extra["hostile"]["left_behind"] == {"looktwice_plans_in_flight": 0}
    assert result.phases["hostile"].count("answered") == len(result.phases["hostile"].exchanges)


def test_a_soak_sees_memory_grow() -> None:
    """The process watched is not the service's, which a soak cannot know."""
    grows = "import time\nkept = []\nwhile True: kept.append(bytearray(4_000_000)); time.sleep(0.1)"
    with standing_in(StandIn()) as url, subprocess.Popen([sys.executable, "-c", grows]) as process:
        try:
            used = setup(url, ONE_DRAW, seconds=3)
            result = soak(used, knee_rps=40, share=0.5, pid=process.pid)
        finally:
            process.kill()
    memory = result.extra["memory"]
    assert memory["growth_bytes"] > 20_000_000
    assert memory["growth_bytes_per_hour"] > 20_000_000 * 1200
    assert memory["late_growth"] > 0.05
    assert any("memory grew" in fault for fault in result.faults)
    assert result.overall.offered_rps == pytest.approx(20, rel=0.5)
    assert written(result, used).tags.count("svg") == 3


def test_a_soak_of_a_process_that_is_not_there_is_refused() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    with pytest.raises(ValueError, match=str(process.pid)):
        soak(setup("http://127.0.0.1:9"), 1, 0.5, process.pid)
