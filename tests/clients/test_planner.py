from __future__ import annotations

import asyncio
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import numpy as np
import pytest

from looktwice.clients import wire
from looktwice.clients.planner import (
    Access,
    AsyncPlannerClient,
    BadAnswer,
    PlanEvent,
    PlannerClient,
    PlannerError,
    PlannerTimeout,
    PlannerUnreachable,
    PlanResult,
    RequestRefused,
    RetryPolicy,
    ServiceBusy,
    ServiceFailed,
    plan_request,
    reflect_request,
)
from looktwice.model.driving.plan import parse_plan
from looktwice.model.engines.engine import EngineError
from looktwice.service.operations.keys import new_line
from looktwice.service.operations.settings import Settings
from tests.service.scenes import scene
from tests.service.scripted_engine import KEEP_ON, REASONING, SLOW_DOWN, ScriptedEngine
from tests.service.serving import serve

PREFILL = parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")
PROBLEM = {"type": "https://looktwice.dev/problems/x", "title": "T", "detail": "D", "request_id": "r-1"}


def answering(*answers: tuple[int, dict[str, str]]) -> tuple[httpx.MockTransport, list[httpx.Request]]:
    """A service that gives these answers in turn; the last one for ever."""
    seen: list[httpx.Request] = []

    def handle(request: httpx.Request) -> httpx.Response:
        status, headers = answers[min(len(seen), len(answers) - 1)]
        seen.append(request)
        if status == 200:
            return httpx.Response(200, json={"models": []})
        return httpx.Response(status, json=PROBLEM | {"status": status}, headers=headers)

    return httpx.MockTransport(handle), seen


def test_plans_over_a_real_connection() -> None:
    engine = ScriptedEngine()
    controls = wire.Controls(n=3, seed=5, thinking="always")
    with serve(engine, Settings()) as served, PlannerClient(served.url) as planner:
        result = planner.plan(scene("a"), controls, request_id="mine")
        assert [card.name for card in planner.models()] == ["scripted"]
    assert (result.request_id, result.model.name, len(result.draws)) == ("mine", "scripted", 3)
    draw = result.draws[1]
    assert (draw.index, draw.plan, draw.revised_plan, draw.thinking) == (1, KEEP_ON, SLOW_DOWN, REASONING)
    assert (draw.branch, draw.tokens["thinking"]) == ("Thinking:", 48)
    assert draw.trajectory.shape == (64, 4)
    assert draw.trajectory.dtype == np.float32
    assert result.timing.total_ms >= result.timing.engine_ms
    asked = engine.submitted[0]
    assert np.array_equal(asked.scene.history, scene().history)
    assert asked.scene.clips == scene().clips
    assert asked.scene.route is not None
    assert (asked.controls.n, asked.controls.seed, asked.controls.thinking) == (3, 5, "always")


def test_asyncio_plans_at_once_and_cancels() -> None:
    engine = ScriptedEngine()

    async def use(url: str, cancelled: Callable[[], bool]) -> None:
        async with AsyncPlannerClient(url) as planner:
            results = await asyncio.gather(*(planner.plan(scene(f"s{i}"), prefill=PREFILL) for i in range(4)))
            assert all(draw.plan == PREFILL for result in results for draw in result.draws)
            assert (await planner.models())[0].cameras == ["front_wide_120", "front_tele_30"]
            engine.may_finish.clear()
            call = asyncio.ensure_future(planner.plan(scene("left")))
            while not engine.submitted or engine.submitted[-1].scene.scene_id != "left":
                await asyncio.sleep(0.01)
            call.cancel()
            while not cancelled():
                await asyncio.sleep(0.01)

    with serve(engine, Settings()) as served:
        limited = asyncio.wait_for(use(served.url, lambda: bool(engine.cancelled)), 30)
        asyncio.run(limited)
    assert engine.cancelled == [engine.submitted[-1].request_id]


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (422, RequestRefused),
        (413, RequestRefused),
        (429, ServiceBusy),
        (503, ServiceBusy),
        (500, ServiceFailed),
    ],
)
def test_problems_become_typed_errors(status: int, expected: type[PlannerError]) -> None:
    transport, seen = answering((status, {}))
    with PlannerClient("http://x", transport=transport) as planner, pytest.raises(expected) as caught:
        planner.plan(scene())
    error = caught.value
    assert isinstance(error, RequestRefused | ServiceBusy | ServiceFailed)
    assert (error.type, error.title, error.detail) == ("https://looktwice.dev/problems/x", "T", "D")
    assert (error.status, error.request_id) == (status, "r-1")
    assert "r-1" in str(error)
    assert len(seen) == 1, "nothing is tried again unless the service says when"


@pytest.mark.parametrize("status", [429, 503])
def test_tries_again_when_told_when(status: int) -> None:
    transport, seen = answering((status, {"Retry-After": "0"}), (200, {}))
    with PlannerClient("http://x", transport=transport) as planner:
        assert planner.models() == []
    assert len(seen) == 2


def test_asyncio_tries_again_too() -> None:
    transport, seen = answering((503, {"Retry-After": "0"}), (200, {}))

    async def use() -> None:
        async with AsyncPlannerClient("http://x", transport=transport) as planner:
            assert await planner.models() == []

    asyncio.run(use())
    assert len(seen) == 2


def test_gives_up_after_the_last_attempt() -> None:
    transport, seen = answering((503, {"Retry-After": "0"}))
    retries = RetryPolicy(attempts=4)
    with PlannerClient("http://x", retries, transport) as planner, pytest.raises(ServiceBusy) as caught:
        planner.models()
    assert len(seen) == 4
    assert caught.value.retry_after_s == 0


def test_does_not_wait_longer_than_it_may() -> None:
    transport, seen = answering((503, {"Retry-After": "3600"}))
    with PlannerClient("http://x", transport=transport) as planner, pytest.raises(ServiceBusy) as caught:
        planner.models()
    assert (len(seen), caught.value.retry_after_s) == (1, 3600)


@pytest.mark.parametrize("zone", [" GMT", " -0000", ""])
def test_dates_of_retry_after_are_in_utc(zone: str) -> None:
    date = (datetime.now(UTC) + timedelta(hours=1)).strftime("%a, %d %b %Y %H:%M:%S") + zone
    transport, _ = answering((503, {"Retry-After": date}))
    with PlannerClient("http://x", transport=transport) as planner, pytest.raises(ServiceBusy) as caught:
        planner.models()
    assert caught.value.retry_after_s == pytest.approx(3600, abs=10)


def test_does_not_wait_beyond_the_deadline() -> None:
    transport, seen = answering((503, {"Retry-After": "1"}))
    with PlannerClient("http://x", transport=transport) as planner, pytest.raises(ServiceBusy):
        planner.plan(scene(), wire.Controls(deadline_ms=100))
    assert len(seen) == 1


@pytest.mark.parametrize("content", [b"<html>a proxy</html>", b'{"models": 3}'])
@pytest.mark.parametrize("status", [200, 502])
def test_other_answers_are_not_of_the_contract(content: bytes, status: int) -> None:
    transport = httpx.MockTransport(lambda _: httpx.Response(status, content=content))
    with PlannerClient("http://x", transport=transport) as planner, pytest.raises(BadAnswer):
        planner.models()


def test_a_trajectory_out_of_this_world_is_a_bad_answer() -> None:
    document = {
        "request_id": "r",
        "model": {"name": "m", "revision": "1"},
        "timing": {"total_ms": 1.0, "checks_ms": 0.0, "engine_ms": 1.0},
        "agreed": 0,
        "draws": [
            {
                **dict.fromkeys(["plan", "branch", "think_probability", "thinking", "revised_plan"]),
                "index": 0,
                "trajectory": [[1e9, 0.0, 0.0, 0.0]] * 64,
                "tokens": {},
            }
        ],
    }
    transport = httpx.MockTransport(lambda _: httpx.Response(200, json=document))
    with PlannerClient("http://x", transport=transport) as planner, pytest.raises(BadAnswer, match="1000"):
        planner.plan(scene())


def test_nobody_there() -> None:
    with PlannerClient("http://127.0.0.1:1") as planner, pytest.raises(PlannerUnreachable):
        planner.models()


def test_no_answer_in_time() -> None:
    def never(request: httpx.Request) -> httpx.Response:
        raise httpx.ReadTimeout("too long", request=request)

    transport = httpx.MockTransport(never)
    with PlannerClient("http://x", transport=transport) as planner, pytest.raises(PlannerTimeout):
        planner.models()


def test_a_plan_is_looked_at_over_a_real_connection() -> None:
    engine = ScriptedEngine()
    engine.cut = "shortened"
    controls = wire.ReflectControls(n=2, thinking="always", deadline_ms=60_000)
    with serve(engine, Settings()) as served, PlannerClient(served.url) as planner:
        result = planner.reflect(scene("a"), PREFILL, controls, request_id="mine")
        with pytest.raises(RequestRefused):
            planner.reflect(scene("a"), PREFILL, format="unheard_of")
    assert (result.request_id, result.plan, len(result.draws)) == ("mine", PREFILL, 2)
    look = result.draws[1]
    assert (look.index, look.decision, look.revised_plan, look.thinking) == (
        1,
        "revise",
        SLOW_DOWN,
        REASONING,
    )
    assert look.cut == "shortened"
    assert 0 <= look.plan_iou < 1
    assert look.changes[0].proposed == "Wait"
    assert look.trajectory.shape == (64, 4)
    assert engine.submitted[0].controls.prefill == PREFILL


def test_packed_bodies_and_a_key_change_nothing(tmp_path: Path) -> None:
    key, line = new_line("car")
    (tmp_path / "keys").write_text(line)
    engine = ScriptedEngine()
    with serve(
        engine, Settings(api_keys_file=tmp_path / "keys"), headers={"Authorization": f"Bearer {key}"}
    ) as served:
        with PlannerClient(served.url, access=Access(api_key=key)) as planner:
            plain = planner.plan(scene())
        with PlannerClient(served.url, access=Access(api_key=key, packed=True)) as planner:
            packed = planner.plan(scene())
        with PlannerClient(served.url) as planner, pytest.raises(RequestRefused, match="needs a key"):
            planner.plan(scene())
    assert [draw.plan for draw in packed.draws] == [draw.plan for draw in plain.draws]
    first, second = engine.submitted
    assert first.scene.clips == second.scene.clips == scene().clips


def test_a_stream_is_read_event_by_event() -> None:
    asked = plan_request(scene(), wire.Controls(n=2, thinking="always"))

    async def follow(url: str) -> list[tuple[str, PlanEvent]]:
        async with AsyncPlannerClient(url) as planner:
            return [event async for event in planner.stream(asked)]

    with serve(ScriptedEngine(), Settings()) as served, PlannerClient(served.url) as planner:
        events = list(planner.stream(asked))
        plain = planner.plan(scene(), wire.Controls(n=2, thinking="always"))
        later = asyncio.run(follow(served.url))
        looks = list(planner.stream(reflect_request(scene(), KEEP_ON, wire.ReflectControls(n=1))))
    assert [name for name, _ in later] == [name for name, _ in events]
    texts = [data.text for _, data in events if isinstance(data, wire.ThinkingWritten) and data.index == 0]
    assert "".join(texts) == REASONING
    name, done = events[-1]
    assert name == "done"
    assert isinstance(done, PlanResult)
    assert [draw.plan for draw in done.draws] == [draw.plan for draw in plain.draws]
    assert looks[-1][0] == "done"


def test_a_stream_that_fails_raises_what_the_service_said() -> None:
    engine = ScriptedEngine()
    asked = plan_request(scene())
    with serve(engine, Settings()) as served, PlannerClient(served.url) as planner:
        engine.failure_later = EngineError("broke")
        stream = planner.stream(asked)
        assert next(stream)[0] == "plan"
        with pytest.raises(ServiceBusy, match="the log has why"):
            list(stream)
        engine.failure_later, engine.failure = None, EngineError("at once")
        with pytest.raises(ServiceBusy, match="the log has why"):
            next(planner.stream(asked))


def test_a_batch_has_a_result_for_each() -> None:
    good, bad = plan_request(scene("good")), plan_request(scene("bad"), format="haiku")

    async def ask(url: str) -> int:
        async with AsyncPlannerClient(url) as planner:
            return len(await planner.plan_batch([good, bad]))

    with serve(ScriptedEngine(), Settings()) as served, PlannerClient(served.url) as planner:
        first, second = planner.plan_batch([good, bad])
        assert asyncio.run(ask(served.url)) == 2
    assert isinstance(second, RequestRefused)
    assert second.type.endswith("unknown-format")
    assert not isinstance(first, RequestRefused)
