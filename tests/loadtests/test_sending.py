"""Every kind of request over real sockets, and every way in which an answer stays away."""

from __future__ import annotations

import asyncio
import time

import pytest

from looktwice.loadtests.bodies import make_call
from looktwice.loadtests.exchange import Exchange
from looktwice.loadtests.mix import BATCH_SCENES, RequestKind
from looktwice.loadtests.sending import Sender, ServiceTarget, connected
from tests.loadtests.scenes import labelled_scenes
from tests.loadtests.stand_in import StandIn, standing_in
from tests.sockets import free_port


def sent(url: str, kind: RequestKind, timeout_s: float = 20) -> Exchange:
    call = make_call(kind, labelled_scenes()[: BATCH_SCENES if kind.work == "batch" else 1], seed=0)

    async def send() -> Exchange:
        async with connected(ServiceTarget(url, api_key="key")) as http:
            return await Sender(http, timeout_s, time.monotonic()).send(call, 0.0)

    return asyncio.run(send())


@pytest.mark.parametrize(
    ("kind", "branch"),
    [
        (RequestKind("direct", 2), "direct"),
        (RequestKind("think", 2, "msgpack"), "think"),
        (RequestKind("think", 2, "multipart", stream=True), "think"),
        (RequestKind("reflect", 2, stream=True), "reflect"),
        (RequestKind("label", 1), "label"),
        (RequestKind("batch", 2, "multipart"), "batch"),
    ],
    ids=str,
)
def test_every_kind_is_answered(kind: RequestKind, branch: str) -> None:
    with standing_in(StandIn()) as url:
        exchange = sent(url, kind)
    assert (exchange.verdict.outcome, exchange.verdict.branch) == ("answered", branch)
    assert 0 <= exchange.sent_s <= exchange.ended_s
    assert (exchange.first_plan_s is not None) == kind.stream


def test_deadlines_are_told_and_read() -> None:
    with standing_in(StandIn()) as url:
        verdict = sent(url, RequestKind(n=1, deadline_ms=300)).verdict
    assert (verdict.deadline_met, verdict.cut) == (True, 1)


@pytest.mark.parametrize("stream", [False, True])
def test_refusals_are_rejections(stream: bool) -> None:
    with standing_in(StandIn(most_waiting=0)) as url:
        verdict = sent(url, RequestKind(n=1, stream=stream)).verdict
    assert (verdict.outcome, verdict.problem) == ("rejected", "queue-full")


def test_failures_are_named() -> None:
    with standing_in(StandIn(failing=True)) as url:
        assert sent(url, RequestKind(n=1)).verdict.problem == "internal"
    with standing_in(StandIn(service_s=1)) as url:
        exchange = sent(url, RequestKind(n=1), timeout_s=0.2)
    assert exchange.verdict.problem == "timeout"
    assert exchange.latency_s >= 0.2
    assert sent(f"http://127.0.0.1:{free_port()}", RequestKind(n=1)).verdict.problem == "ConnectError"
