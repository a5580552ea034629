"""Loads over real sockets: what an open and a closed loop report about the same service."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import time
from collections import Counter
from itertools import pairwise

import numpy as np

from looktwice.loadtests.accounting import summarise
from looktwice.loadtests.bodies import make_calls
from looktwice.loadtests.exchange import Exchange
from looktwice.loadtests.loads import (
    Fleet,
    LoadPhase,
    OpenLoop,
    PlanningCar,
    Window,
    poisson_arrivals,
    run_load,
)
from looktwice.loadtests.mix import Mix
from looktwice.loadtests.sending import ServiceTarget
from tests.loadtests.scenes import labelled_scenes
from tests.loadtests.stand_in import StandIn, standing_in
from tests.waiting import until

CALLS = tuple(make_calls(labelled_scenes(), Mix(draws={1: 1}).kinds(10, seed=0), seed=0))
GOAL_S = 0.2


def test_stalls_are_reported_by_the_clock_of_when_requests_were_due() -> None:
    """The service stalls for 1 s in every 4 s, so no request that is due there can be in time."""
    seconds, every_s, stall_s = 8.0, 4.0, 1.0
    opened = OpenLoop(poisson_arrivals([LoadPhase("all", seconds, 25)], 3), CALLS)
    # It asks again as soon as it has its answer, as closed loops commonly do.
    closed = Fleet((PlanningCar(CALLS, period_s=0.02, offset_s=0.0),), seconds)
    service = StandIn(stall_every_s=every_s, stall_s=stall_s)
    with standing_in(service) as url:

        async def both() -> tuple[float, list[Exchange], list[Exchange]]:
            target, starts_at = ServiceTarget(url), time.monotonic() + 0.2
            exchanges = await asyncio.gather(
                run_load(opened, target, starts_at), run_load(closed, target, starts_at)
            )
            return starts_at - service.began_s, *exchanges

        into_s, of_open, of_closed = asyncio.run(both())

    def stalled(exchanges: list[Exchange]) -> list[Exchange]:
        """Those due so early in a stall that their goal has passed when it ends."""
        begins_s = every_s - stall_s
        return [each for each in exchanges if begins_s < (each.due_s + into_s) % every_s < every_s - GOAL_S]

    hit = stalled(of_open)
    assert len(hit) > 0.1 * len(of_open)
    assert not any(each.good(GOAL_S) for each in hit)
    assert all(each.verdict.outcome == "answered" for each in of_open)
    hit = stalled(of_closed)
    outcomes = Counter(each.verdict.outcome for each in hit)
    assert outcomes["answered"] <= 3, "the answers of a closed loop alone say little of three stalls at most"
    assert outcomes["answered"] + outcomes["missed"] == len(hit) > 0.1 * len(of_closed)
    whole = Window("all", 0, seconds)
    for exchanges in (of_open, of_closed):
        late = len(stalled(exchanges)) / len(exchanges)
        assert summarise(exchanges, whole, GOAL_S).goodput <= 1 - late, "missed ticks are counted"


def test_an_open_loop_does_not_wait_for_answers() -> None:
    service = StandIn(service_s=5.0)  # long enough for a machine that others keep busy
    load = OpenLoop(np.linspace(0, 0.3, 20), CALLS)
    with standing_in(service) as url:
        exchanges = asyncio.run(run_load(load, ServiceTarget(url), time.monotonic() + 0.1))
    assert len(exchanges) == 20
    last_sent_s = max(each.sent_s for each in exchanges)
    assert last_sent_s < min(each.ended_s for each in exchanges)


def test_a_planner_waits_and_counts_the_ticks_that_went_by() -> None:
    planner = PlanningCar(CALLS, period_s=0.05, offset_s=0.0)
    with standing_in(StandIn(service_s=0.12)) as url:
        exchanges = asyncio.run(run_load(Fleet((planner,), 1.5), ServiceTarget(url), time.monotonic() + 0.1))
    np.testing.assert_allclose([each.due_s for each in exchanges], 0.05 * np.arange(30), atol=1e-9)
    sent = [each for each in exchanges if each.verdict.outcome == "answered"]
    assert 0 < len(sent) <= 10
    for before, after in pairwise(sent):
        assert before.ended_s <= after.due_s + 1e-9


def test_work_split_between_workers_is_the_same_work() -> None:
    load = OpenLoop(np.arange(7.0), CALLS, first=4)
    parts = load.split(3)
    again = sorted(
        (due_s, part.calls[place].body) for part in parts for place, due_s in enumerate(part.due_s.tolist())
    )
    assert again == [(due_s, CALLS[(4 + due_s) % 10].body) for due_s in range(7)]
    fleet = Fleet(tuple(PlanningCar(CALLS, 0.1, offset) for offset in (0.0, 0.01, 0.02)), 1)
    assert {planner.offset_s for part in fleet.split(2) for planner in part.planners} == {0.0, 0.01, 0.02}


def test_a_generator_that_is_killed_sends_no_more() -> None:
    service = StandIn()
    asks = ["loadtest", "--rate", "20", "--seconds", "300", "--distinct", "4", "--service"]
    with standing_in(service) as url:
        generator = subprocess.Popen([sys.executable, "-m", "looktwice.service.cli", *asks, url])
        try:
            until(lambda: len(service.seen) > 5, 60)
        finally:
            generator.send_signal(signal.SIGKILL)
            generator.wait()
        seen = [-1]

        def silent() -> bool:
            seen.append(len(service.seen))
            return seen[-1] == seen[-2]

        until(silent, 20, every_s=1.0)
