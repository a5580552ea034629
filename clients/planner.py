"""Clients of the planning service: scenes in, typed plans and trajectories out.

::

    with PlannerClient("http://127.0.0.1:8000") as planner:
        result = planner.plan(scene, wire.Controls(n=6))
        result.draws[0].trajectory  # float32 [64, 4]
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import httpx
from pydantic import BaseModel

from clients import wire
from clients.answers import (
    BUSY_STATUSES,
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
    plan_result,
    read,
    reflect_result,
    retry_after_s,
    unreachable,
)
from clients.labelling.teachers.view import Surroundings
from clients.wire_values import rows, wire_agents, wire_scene
from model.driving.plan import Plan
from model.driving.scene import Scene

__all__ = [
    "AsyncPlannerClient",
    "BadAnswer",
    "LookedAt",
    "Patience",
    "PlanResult",
    "PlannedDraw",
    "PlannerClient",
    "PlannerError",
    "PlannerProblem",
    "PlannerTimeout",
    "PlannerUnreachable",
    "ReflectResult",
    "RequestRefused",
    "ServiceBusy",
    "ServiceFailed",
    "label_request",
    "plan_request",
    "reflect_request",
]


@dataclass(frozen=True)
class Patience:
    """How long a client tries.

    Attributes:
        timeout_s: for one attempt, connecting included.
        attempts: at most, the first one included. Only 429 and 503 answers that say how long to wait are
            tried again, and never beyond a request's own ``deadline_ms``.
        longest_wait_s: a longer Retry-After is reported instead of waited for.
    """

    timeout_s: float = 30.0
    attempts: int = 3
    longest_wait_s: float = 5.0


class PlannerClient:
    """Blocking client; safe to share between threads, as its httpx client is."""

    def __init__(
        self, base_url: str, patience: Patience = Patience(), transport: httpx.BaseTransport | None = None
    ) -> None:
        self._patience = patience
        self._http = httpx.Client(base_url=base_url, timeout=patience.timeout_s, transport=transport)

    def plan(
        self,
        scene: Scene,
        controls: wire.Controls = wire.Controls(),
        *,
        prefill: Plan | None = None,
        format: str = "cf_vla",
        request_id: str | None = None,
    ) -> PlanResult:
        """Plan for ``scene``.

        Args:
            scene: what the car sees.
            controls: draws, thinking, sampling, deadline.
            prefill: the first plan, to be continued instead of one the model writes.
            format: a response format the model writes.
            request_id: shows up in the service's log; made there when None.

        Raises:
            PlannerError: see its subclasses.
        """
        asked = plan_request(scene, controls, prefill=prefill, format=format)
        answered = self._send(_call(self._http, "/v1/plan", asked, request_id), controls.deadline_ms)
        return plan_result(answered)

    def reflect(
        self,
        scene: Scene,
        plan: Plan,
        controls: wire.ReflectControls = wire.ReflectControls(),
        *,
        format: str = "cf_vla",
        request_id: str | None = None,
    ) -> ReflectResult:
        """Have ``plan``, from whatever planner, looked at.

        Args:
            scene: what the car sees.
            plan: to keep or to revise.
            controls: draws, thinking, sampling, deadline.
            format: a response format the model writes.
            request_id: shows up in the service's log; made there when None.

        Raises:
            PlannerError: see its subclasses.
        """
        asked = reflect_request(scene, plan, controls, format=format)
        answered = self._send(_call(self._http, "/v1/reflect", asked, request_id), controls.deadline_ms)
        return reflect_result(answered)

    def label(
        self,
        scene: Scene,
        predicted: Plan,
        expert: Plan,
        *,
        surroundings: Surroundings | None = None,
        seed: int = 0,
    ) -> wire.LabelResponse:
        """Have the service's teacher say why ``predicted`` is less good than ``expert``.

        Args:
            scene: what the model saw.
            predicted: the plan it made.
            expert: the better one, which the answer leads to without naming it.
            surroundings: the scene's annotations; the built-in teacher needs them.
            seed: another one, other words.

        Raises:
            PlannerError: see its subclasses.
        """
        asked = label_request(scene, predicted, expert, surroundings, seed)
        return read(self._send(_call(self._http, "/v1/label", asked, None)), wire.LabelResponse)

    def models(self) -> list[wire.ModelCard]:
        """The models behind the service; raises `PlannerError`."""
        return self._model_list().models

    def teacher(self) -> wire.TeacherName | None:
        """Who writes the service's labels, if anybody; raises `PlannerError`."""
        return self._model_list().teacher

    def _model_list(self) -> wire.ModelList:
        return read(self._send(self._http.build_request("GET", "/v1/models")), wire.ModelList)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _send(self, request: httpx.Request, deadline_ms: int | None = None) -> httpx.Response:
        attempts = _Attempts(self._patience, deadline_ms)
        while True:
            try:
                response = self._http.send(request)
            except httpx.HTTPError as error:
                raise unreachable(error) from error
            wait_s = attempts.wait_after(response)
            if wait_s is None:
                return response
            time.sleep(wait_s)


class AsyncPlannerClient:
    """The same for asyncio; see `PlannerClient`. Cancelling a call cancels the planning."""

    def __init__(
        self,
        base_url: str,
        patience: Patience = Patience(),
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._patience = patience
        self._http = httpx.AsyncClient(base_url=base_url, timeout=patience.timeout_s, transport=transport)

    async def plan(
        self,
        scene: Scene,
        controls: wire.Controls = wire.Controls(),
        *,
        prefill: Plan | None = None,
        format: str = "cf_vla",
        request_id: str | None = None,
    ) -> PlanResult:
        """Plan for ``scene``; see `PlannerClient.plan`."""
        asked = plan_request(scene, controls, prefill=prefill, format=format)
        answered = await self._send(_call(self._http, "/v1/plan", asked, request_id), controls.deadline_ms)
        return plan_result(answered)

    async def reflect(
        self,
        scene: Scene,
        plan: Plan,
        controls: wire.ReflectControls = wire.ReflectControls(),
        *,
        format: str = "cf_vla",
        request_id: str | None = None,
    ) -> ReflectResult:
        """Have ``plan`` looked at; see `PlannerClient.reflect`."""
        asked = reflect_request(scene, plan, controls, format=format)
        call = _call(self._http, "/v1/reflect", asked, request_id)
        return reflect_result(await self._send(call, controls.deadline_ms))

    async def label(
        self,
        scene: Scene,
        predicted: Plan,
        expert: Plan,
        *,
        surroundings: Surroundings | None = None,
        seed: int = 0,
    ) -> wire.LabelResponse:
        """Have the service's teacher look at a plan; see `PlannerClient.label`."""
        asked = label_request(scene, predicted, expert, surroundings, seed)
        return read(await self._send(_call(self._http, "/v1/label", asked, None)), wire.LabelResponse)

    async def models(self) -> list[wire.ModelCard]:
        """The models behind the service; raises `PlannerError`."""
        return (await self._model_list()).models

    async def teacher(self) -> wire.TeacherName | None:
        """Who writes the service's labels, if anybody; raises `PlannerError`."""
        return (await self._model_list()).teacher

    async def _model_list(self) -> wire.ModelList:
        return read(await self._send(self._http.build_request("GET", "/v1/models")), wire.ModelList)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def _send(self, request: httpx.Request, deadline_ms: int | None = None) -> httpx.Response:
        attempts = _Attempts(self._patience, deadline_ms)
        while True:
            try:
                response = await self._http.send(request)
            except httpx.HTTPError as error:
                raise unreachable(error) from error
            wait_s = attempts.wait_after(response)
            if wait_s is None:
                return response
            await asyncio.sleep(wait_s)


def plan_request(
    scene: Scene,
    controls: wire.Controls = wire.Controls(),
    *,
    prefill: Plan | None = None,
    format: str = "cf_vla",
) -> wire.PlanRequest:
    """The body of POST /v1/plan for ``scene``."""
    if prefill is not None:
        controls = controls.model_copy(update={"prefill": str(prefill)})
    return wire.PlanRequest(scene=wire_scene(scene), controls=controls, format=format)


def reflect_request(
    scene: Scene,
    plan: Plan,
    controls: wire.ReflectControls = wire.ReflectControls(),
    *,
    format: str = "cf_vla",
) -> wire.ReflectRequest:
    """The body of POST /v1/reflect for ``plan`` in ``scene``."""
    return wire.ReflectRequest(scene=wire_scene(scene), plan=str(plan), controls=controls, format=format)


def label_request(
    scene: Scene, predicted: Plan, expert: Plan, surroundings: Surroundings | None = None, seed: int = 0
) -> wire.LabelRequest:
    """The body of POST /v1/label for two plans in ``scene``."""
    return wire.LabelRequest(
        scene=wire_scene(scene),
        predicted_plan=str(predicted),
        expert_plan=str(expert),
        annotations=None
        if surroundings is None
        else wire.Annotations(
            agents=wire_agents(surroundings.agents),
            lane_lines=[rows(line) for line in surroundings.lane_lines],
        ),
        seed=seed,
    )


class _Attempts:
    """Decides, without waiting itself, whether and when to try again."""

    def __init__(self, patience: Patience, deadline_ms: int | None) -> None:
        self._left = patience.attempts
        self._longest_wait_s = patience.longest_wait_s
        self._ends = None if deadline_ms is None else time.monotonic() + deadline_ms / 1000

    def wait_after(self, response: httpx.Response) -> float | None:
        """Seconds to wait before the next attempt; None when ``response`` is the last word."""
        self._left -= 1
        wait_s = retry_after_s(response)
        if response.status_code not in BUSY_STATUSES or wait_s is None or self._left <= 0:
            return None
        if wait_s > self._longest_wait_s or (self._ends and time.monotonic() + wait_s > self._ends):
            return None
        return wait_s


def _call(
    http: httpx.Client | httpx.AsyncClient, path: str, asked: BaseModel, request_id: str | None
) -> httpx.Request:
    headers = {"Content-Type": "application/json"}
    if request_id is not None:
        headers[wire.REQUEST_ID_HEADER] = request_id
    return http.build_request("POST", path, content=asked.model_dump_json(), headers=headers)
