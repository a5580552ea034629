"""Clients of the planning service: scenes in, typed plans and trajectories out.

```python
with PlannerClient("http://127.0.0.1:8000") as planner:
    result = planner.plan(scene, wire.Controls(n=6))
    result.draws[0].trajectory  # float32 [64, 4]
```
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Iterator, Sequence
from functools import partial
from types import TracebackType
from typing import Self, TypeVar

import httpx
from httpx_sse import EventSource
from pydantic import BaseModel

from looktwice.clients import wire, wire_feedback, wire_imagine, wire_refine, wire_scores
from looktwice.clients.answers import (
    BadAnswer,
    LookedAt,
    PlannedDraw,
    PlannerError,
    PlannerProblem,
    PlannerTimeout,
    PlannerUnreachable,
    PlanResult,
    ReflectResult,
    RequestRefused,
    ServiceBusy,
    ServiceFailed,
    batch_results,
    plan_result,
    problem_of,
    read,
    reflect_result,
    score_results,
)
from looktwice.clients.calling import Access, RetryPolicy, Tries, body_of, headers_of, typed_errors
from looktwice.clients.requests import (
    attempt_at,
    imagine_request,
    label_request,
    plan_request,
    refine_request,
    reflect_request,
)
from looktwice.clients.streams import (
    ImagineEvent,
    PlanEvent,
    RefineEvent,
    Tell,
    imagine_event,
    plan_event,
    refine_event,
)
from looktwice.model.driving.outcome import Outcome
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.view import Surroundings

__all__ = [
    "Access",
    "AsyncPlannerClient",
    "BadAnswer",
    "ImagineEvent",
    "LookedAt",
    "RetryPolicy",
    "PlanResult",
    "PlannedDraw",
    "PlannerClient",
    "PlannerError",
    "PlannerProblem",
    "PlannerTimeout",
    "PlannerUnreachable",
    "RefineEvent",
    "ReflectResult",
    "RequestRefused",
    "ServiceBusy",
    "ServiceFailed",
    "PlanEvent",
    "attempt_at",
    "imagine_request",
    "label_request",
    "plan_request",
    "refine_request",
    "reflect_request",
]


_Event = TypeVar("_Event")


class PlannerClient:
    """Blocking client; safe to share between threads, as its httpx client is.

    Args:
        base_url: of the service, such as ``http://127.0.0.1:8000``.
        retries: how long it tries.
        transport: of its httpx client, in place of connections.
        access: how it speaks to the service.
    """

    def __init__(
        self,
        base_url: str,
        retries: RetryPolicy = RetryPolicy(),
        transport: httpx.BaseTransport | None = None,
        access: Access = Access(),
    ) -> None:
        self._retries, self._body = retries, partial(body_of, packed=access.packed)
        self._http = httpx.Client(
            base_url=base_url, timeout=retries.timeout_s, transport=transport, headers=headers_of(access)
        )

    def plan(
        self,
        scene: Scene,
        controls: wire.Controls = wire.Controls(),
        *,
        prefill: Plan | None = None,
        format: str | None = None,
        attempt: wire.Attempt | None = None,
        request_id: str | None = None,
    ) -> PlanResult:
        """Plan for ``scene``.

        Args:
            scene: what the car sees.
            controls: draws, thinking, sampling, deadline.
            prefill: the first plan, to be continued instead of one the model writes.
            format: a response format the model writes; its first where None.
            attempt: to be refined, by formats that do; see `attempt_at`.
            request_id: shows up in the service's log; made there when None.

        Raises:
            PlannerError: see its subclasses.
        """
        asked = plan_request(scene, controls, prefill=prefill, format=format, attempt=attempt)
        return plan_result(self._ask("/v1/plan", asked, request_id, controls.deadline_ms))

    def plan_batch(self, asked: Sequence[wire.PlanRequest]) -> list[PlanResult | PlannerProblem]:
        """Plan for many scenes in one request (`plan_request` makes them); a scene that fails does so alone.

        Raises:
            PlannerError: the batch as a whole failed.
        """
        batch = wire.BatchRequest(requests=list(asked))
        return batch_results(self._ask("/v1/plan/batch", batch))

    def stream(self, asked: wire.PlanRequest | wire.ReflectRequest) -> Iterator[tuple[str, PlanEvent]]:
        """What a draw writes, as it is written: names and data of `looktwice.clients.wire.EVENTS`, at last
        ``done``.

        Args:
            asked: see `plan_request` and `reflect_request`.

        Raises:
            PlannerError: before the first event or at the place of the one that failed.
        """
        return self._stream(_path_of(asked), asked, plan_event)

    def stream_imagine(self, asked: wire_imagine.ImagineRequest) -> Iterator[tuple[str, ImagineEvent]]:
        """Pictures as they are written: names and data of `looktwice.clients.wire_imagine.EVENTS`, at last
        ``done``.

        Args:
            asked: see `imagine_request`.

        Raises:
            PlannerError: as of `stream`.
        """
        return self._stream("/v1/imagine", asked, imagine_event)

    def stream_refine(self, asked: wire_refine.RefineRequest) -> Iterator[tuple[str, RefineEvent]]:
        """Refinements as they are written: names and data of `looktwice.clients.wire_refine.EVENTS`, at last
        ``done``.

        Args:
            asked: see `refine_request`.

        Raises:
            PlannerError: as of `stream`.
        """
        return self._stream("/v1/refine", asked, refine_event)

    def reflect(
        self,
        scene: Scene,
        plan: Plan,
        controls: wire.ReflectControls = wire.ReflectControls(),
        *,
        format: str | None = None,
        request_id: str | None = None,
    ) -> ReflectResult:
        """Have ``plan``, from whatever planner, looked at.

        Args:
            scene: what the car sees.
            plan: to keep or to revise.
            controls: draws, thinking, sampling, deadline.
            format: a response format the model writes; its first where None.
            request_id: shows up in the service's log; made there when None.

        Raises:
            PlannerError: see its subclasses.
        """
        asked = reflect_request(scene, plan, controls, format=format)
        return reflect_result(self._ask("/v1/reflect", asked, request_id, controls.deadline_ms))

    def label(
        self,
        scene: Scene,
        predicted: Plan,
        expert: Plan,
        *,
        surroundings: Surroundings | None = None,
        seed: int = 0,
        outcome: Outcome | None = None,
    ) -> wire.LabelResponse:
        """Have the service's teacher say why ``predicted`` is less good than ``expert``.

        Args:
            scene: what the model saw.
            predicted: the plan it made.
            expert: the better one, which the answer leads to without naming it.
            surroundings: the scene's annotations; the built-in teacher needs them.
            seed: another one, other words.
            outcome: what ``predicted`` failed at when it was followed, where that is known.

        Raises:
            PlannerError: see its subclasses.
        """
        asked = label_request(scene, predicted, expert, surroundings, seed, outcome)
        return read(self._ask("/v1/label", asked), wire.LabelResponse)

    def score(self, request: wire_scores.ScoreRequest) -> wire_scores.ScoreResponse:
        """Score trajectories by NAVSIM's rules; raises `PlannerError`."""
        return read(self._ask("/v1/score", request), wire_scores.ScoreResponse)

    def score_batch(
        self, asked: Sequence[wire_scores.ScoreRequest]
    ) -> list[wire_scores.ScoreResponse | PlannerProblem]:
        """Score trajectories of many scenes in one request, 64 at most; a scene that fails does so alone.

        Raises:
            PlannerError: the batch as a whole failed.
        """
        batch = wire_scores.ScoreBatchRequest(requests=list(asked))
        return score_results(self._ask("/v1/score/batch", batch))

    def feedback(self, request: wire_feedback.FeedbackRequest) -> wire_feedback.FeedbackResponse:
        """Have trajectories judged, and be told why they fail; raises `PlannerError`."""
        return read(self._ask("/v1/feedback", request), wire_feedback.FeedbackResponse)

    def refine(self, request: wire_refine.RefineRequest) -> wire_refine.RefineResponse:
        """Have a draft refined by feedback on it (`refine_request` makes the body); raises `PlannerError`."""
        answer = self._ask("/v1/refine", request, deadline_ms=request.controls.deadline_ms)
        return read(answer, wire_refine.RefineResponse)

    def imagine(self, request: wire_imagine.ImagineRequest) -> wire_imagine.ImagineResponse:
        """See what a camera will see (`imagine_request` makes the body); raises `PlannerError`."""
        return read(self._ask("/v1/imagine", request), wire_imagine.ImagineResponse)

    def models(self) -> list[wire.ModelCard]:
        """The models behind the service; raises `PlannerError`."""
        return self._model_list().models

    def teacher(self) -> wire.TeacherName | None:
        """Who writes the service's labels, if anybody; raises `PlannerError`."""
        return self._model_list().teacher

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _model_list(self) -> wire.ModelList:
        return read(self._send(self._http.build_request("GET", "/v1/models")), wire.ModelList)

    def _ask(
        self, path: str, asked: BaseModel, request_id: str | None = None, deadline_ms: int | None = None
    ) -> httpx.Response:
        return self._send(
            self._http.build_request("POST", path, **self._body(asked, request_id)), deadline_ms
        )

    def _stream(self, path: str, asked: BaseModel, tell: Tell[_Event]) -> Iterator[tuple[str, _Event]]:
        body = self._body(asked.model_copy(update={"stream": True}))
        with typed_errors(), self._http.stream("POST", path, **body) as response:
            if response.status_code != 200:
                response.read()
                raise problem_of(response)
            for event in EventSource(response).iter_sse():
                if (data := tell(event, response)) is not None:
                    yield event.event, data

    def _send(self, request: httpx.Request, deadline_ms: int | None = None) -> httpx.Response:
        tries = Tries(self._retries, deadline_ms)
        while True:
            with typed_errors():
                response = self._http.send(request)
            wait_s = tries.wait_after(response)
            if wait_s is None:
                return response
            time.sleep(wait_s)


class AsyncPlannerClient:
    """The same for asyncio; see `PlannerClient`. Cancelling a call cancels the planning."""

    def __init__(
        self,
        base_url: str,
        retries: RetryPolicy = RetryPolicy(),
        transport: httpx.AsyncBaseTransport | None = None,
        access: Access = Access(),
    ) -> None:
        self.base_url = base_url
        self._retries, self._body = retries, partial(body_of, packed=access.packed)
        self._http = httpx.AsyncClient(
            base_url=base_url, timeout=retries.timeout_s, transport=transport, headers=headers_of(access)
        )

    async def plan(
        self,
        scene: Scene,
        controls: wire.Controls = wire.Controls(),
        *,
        prefill: Plan | None = None,
        format: str | None = None,
        attempt: wire.Attempt | None = None,
        request_id: str | None = None,
    ) -> PlanResult:
        """Plan for ``scene``; see `PlannerClient.plan`."""
        asked = plan_request(scene, controls, prefill=prefill, format=format, attempt=attempt)
        return plan_result(await self._ask("/v1/plan", asked, request_id, controls.deadline_ms))

    async def plan_batch(self, asked: Sequence[wire.PlanRequest]) -> list[PlanResult | PlannerProblem]:
        """Plan for many scenes; see `PlannerClient.plan_batch`."""
        batch = wire.BatchRequest(requests=list(asked))
        return batch_results(await self._ask("/v1/plan/batch", batch))

    def stream(self, asked: wire.PlanRequest | wire.ReflectRequest) -> AsyncGenerator[tuple[str, PlanEvent]]:
        """What a draw writes, as it is written; see `PlannerClient.stream`."""
        return self._stream(_path_of(asked), asked, plan_event)

    def stream_imagine(self, asked: wire_imagine.ImagineRequest) -> AsyncGenerator[tuple[str, ImagineEvent]]:
        """Pictures as they are written; see `PlannerClient.stream_imagine`."""
        return self._stream("/v1/imagine", asked, imagine_event)

    def stream_refine(self, asked: wire_refine.RefineRequest) -> AsyncGenerator[tuple[str, RefineEvent]]:
        """Refinements as they are written; see `PlannerClient.stream_refine`."""
        return self._stream("/v1/refine", asked, refine_event)

    async def reflect(
        self,
        scene: Scene,
        plan: Plan,
        controls: wire.ReflectControls = wire.ReflectControls(),
        *,
        format: str | None = None,
        request_id: str | None = None,
    ) -> ReflectResult:
        """Have ``plan`` looked at; see `PlannerClient.reflect`."""
        asked = reflect_request(scene, plan, controls, format=format)
        return reflect_result(await self._ask("/v1/reflect", asked, request_id, controls.deadline_ms))

    async def label(
        self,
        scene: Scene,
        predicted: Plan,
        expert: Plan,
        *,
        surroundings: Surroundings | None = None,
        seed: int = 0,
        outcome: Outcome | None = None,
    ) -> wire.LabelResponse:
        """Have the service's teacher look at a plan; see `PlannerClient.label`."""
        asked = label_request(scene, predicted, expert, surroundings, seed, outcome)
        return read(await self._ask("/v1/label", asked), wire.LabelResponse)

    async def score(self, request: wire_scores.ScoreRequest) -> wire_scores.ScoreResponse:
        """Score trajectories by NAVSIM's rules; raises `PlannerError`."""
        return read(await self._ask("/v1/score", request), wire_scores.ScoreResponse)

    async def score_batch(
        self, asked: Sequence[wire_scores.ScoreRequest]
    ) -> list[wire_scores.ScoreResponse | PlannerProblem]:
        """Score trajectories of many scenes; see `PlannerClient.score_batch`."""
        batch = wire_scores.ScoreBatchRequest(requests=list(asked))
        return score_results(await self._ask("/v1/score/batch", batch))

    async def feedback(self, request: wire_feedback.FeedbackRequest) -> wire_feedback.FeedbackResponse:
        """Have trajectories judged, and be told why they fail; raises `PlannerError`."""
        return read(await self._ask("/v1/feedback", request), wire_feedback.FeedbackResponse)

    async def refine(self, request: wire_refine.RefineRequest) -> wire_refine.RefineResponse:
        """Have a draft refined by feedback on it; see `PlannerClient.refine`."""
        answer = await self._ask("/v1/refine", request, deadline_ms=request.controls.deadline_ms)
        return read(answer, wire_refine.RefineResponse)

    async def imagine(self, request: wire_imagine.ImagineRequest) -> wire_imagine.ImagineResponse:
        """See what a camera will see; see `PlannerClient.imagine`."""
        return read(await self._ask("/v1/imagine", request), wire_imagine.ImagineResponse)

    async def models(self) -> list[wire.ModelCard]:
        """The models behind the service; raises `PlannerError`."""
        return (await self._model_list()).models

    async def teacher(self) -> wire.TeacherName | None:
        """Who writes the service's labels, if anybody; raises `PlannerError`."""
        return (await self._model_list()).teacher

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def _model_list(self) -> wire.ModelList:
        return read(await self._send(self._http.build_request("GET", "/v1/models")), wire.ModelList)

    async def _ask(
        self, path: str, asked: BaseModel, request_id: str | None = None, deadline_ms: int | None = None
    ) -> httpx.Response:
        request = self._http.build_request("POST", path, **self._body(asked, request_id))
        return await self._send(request, deadline_ms)

    async def _stream(
        self, path: str, asked: BaseModel, tell: Tell[_Event]
    ) -> AsyncGenerator[tuple[str, _Event]]:
        body = self._body(asked.model_copy(update={"stream": True}))
        with typed_errors():
            async with self._http.stream("POST", path, **body) as response:
                if response.status_code != 200:
                    await response.aread()
                    raise problem_of(response)
                async for event in EventSource(response).aiter_sse():
                    if (data := tell(event, response)) is not None:
                        yield event.event, data

    async def _send(self, request: httpx.Request, deadline_ms: int | None = None) -> httpx.Response:
        tries = Tries(self._retries, deadline_ms)
        while True:
            with typed_errors():
                response = await self._http.send(request)
            wait_s = tries.wait_after(response)
            if wait_s is None:
                return response
            await asyncio.sleep(wait_s)


def _path_of(asked: wire.PlanRequest | wire.ReflectRequest) -> str:
    return "/v1/reflect" if isinstance(asked, wire.ReflectRequest) else "/v1/plan"
