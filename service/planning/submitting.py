"""One scene on its way through the service: let in, checked, decoded, told of as it is written."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import AsyncGenerator, Generator
from contextlib import aclosing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import structlog

import looktwice.clients.wire as wire
from looktwice.model.driving.agreement import Agreement, agreement
from looktwice.model.driving.images import ImageError
from looktwice.model.driving.plan import PlanError
from looktwice.model.driving.scene import SceneError
from looktwice.model.engines.engine import (
    DraftFinished,
    Draw,
    DrawFinished,
    Engine,
    EngineError,
    Event,
    PlanRequest,
    RequestError,
    Started,
)
from looktwice.model.network.model_card import ModelCard
from looktwice.service.admission.places import Admission, Place, full_as_problem, let_in, whole_seconds
from looktwice.service.admission.rates import RateLimited, Rates
from looktwice.service.operations.lifecycle import Lifecycle
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.operations.traces import Traces
from looktwice.service.planning.events import Arrival, Begun, Judged, PlannedScene, SceneEvent
from looktwice.service.planning.validation import Geometry, engine_request
from looktwice.service.problems import (
    DECODE_TIMEOUT,
    ENGINE_FAILED,
    INVALID_IMAGE,
    QUEUE_TIMEOUT,
    RATE_LIMITED,
    REFUSED,
    ProblemError,
)

_ANSWERING_MS: Final = 3
"""Of a deadline, left for writing the answer."""

AnyPlanRequest = wire.PlanRequest | wire.ReflectRequest

log = structlog.stdlib.get_logger()


@dataclass(frozen=True)
class TimeLimits:
    """How long a scene may take, in s: until it begins, and from then on."""

    queue_s: float
    decode_s: float


class SceneSubmitter:
    """Takes scenes to the engine; one for the whole service."""

    def __init__(
        self,
        lifecycle: Lifecycle,
        admission: Admission,
        rates: Rates,
        metrics: Metrics,
        traces: Traces,
        limits: TimeLimits,
    ) -> None:
        self._lifecycle, self._admission, self._rates = lifecycle, admission, rates
        self._metrics, self._traces, self._limits = metrics, traces, limits

    def check_open(self, *, batch: bool = False) -> None:
        """Raise `ProblemError` where nothing could be accepted now; asked before a body is read."""
        self._lifecycle.check_ready()
        with full_as_problem():
            self._admission.check_open(batch=batch)

    @contextmanager
    def batch(self, scenes: int) -> Generator[None]:
        """Let a batch in until it is answered; raises `ProblemError` where there are too many."""
        with self._lifecycle.accepted(), let_in(self._admission.batch(scenes)):
            yield

    async def spend(self, owner: str, draws: int) -> None:
        """Count what ``owner`` asks for; raises `ProblemError` where it is too much."""
        try:
            await self._rates.spend(owner, draws)
        except RateLimited as error:
            wait_s = None if error.retry_after_s is None else whole_seconds(error.retry_after_s)
            raise ProblemError(RATE_LIMITED, str(error), retry_after_s=wait_s) from None

    async def events(
        self, asked: AnyPlanRequest, arrival: Arrival, geometry: Geometry | None = None
    ) -> AsyncGenerator[SceneEvent]:
        """What happens to a scene, at last the whole of it; closing it early frees everything.

        `Started` is told as `Begun`, finished draws as `Judged`.

        Args:
            asked: the scene, and what is to be done with it.
            arrival: of the request.
            geometry: of the scene, where that is checked already.

        Raises:
            ProblemError: at the first iteration where it is not let in; later where it fails.
        """
        with self._lifecycle.accepted(), let_in(self._admission.place(asked.controls.n)) as place:
            await self.spend(arrival.owner, asked.controls.n)
            async with aclosing(self._plan(asked, arrival, place, geometry)) as events:
                async for event in events:
                    yield event

    async def in_turn(self, asked: AnyPlanRequest, arrival: Arrival) -> PlannedScene:
        """A scene of a batch that was let in, which waits for its place; raises `ProblemError`."""
        async with self._admission.place_in_turn(asked.controls.n) as place:
            return await last(self._plan(asked, arrival, place))

    async def _plan(
        self, asked: AnyPlanRequest, arrival: Arrival, place: Place, geometry: Geometry | None = None
    ) -> AsyncGenerator[SceneEvent]:
        endpoint = "reflect" if isinstance(asked, wire.ReflectRequest) else "plan"
        draws, drafts, agreements = list[Draw](), dict[int, Draw](), dict[int, Agreement]()
        with self._lifecycle.engine() as engine, self._traces.planning(asked, engine.card) as span:
            checking_s = time.monotonic()
            request = await self._checked(asked, engine.card, arrival, geometry)
            paint = partial(engine.paint, request)
            submitted_s = began_s = time.monotonic()
            try:
                with self._metrics.plans_in_flight.track_inprogress():
                    async with aclosing(self._decode(engine, request)) as events:
                        async for event in events:
                            if isinstance(event, Started):
                                place.began()
                                began_s = time.monotonic()
                                yield Begun(paint)
                                continue
                            if isinstance(event, DraftFinished):
                                drafts[event.draw.index] = event.draw
                            elif isinstance(event, DrawFinished):
                                draw = event.draw
                                draws.append(draw)
                                agreements[draw.index] = _judged(draw, request)
                                yield Judged(draw, agreements[draw.index])
                                continue
                            yield event
            except ProblemError as error:
                if asked.controls.deadline_ms is not None and error.kind in (QUEUE_TIMEOUT, DECODE_TIMEOUT):
                    self._metrics.count_deadline(met=False)
                raise
            finished_s = time.monotonic()
            draws.sort(key=lambda draw: draw.index)
            deadline_met = _met(asked.controls.deadline_ms, arrival)
            for draw in draws:
                agreement = agreements[draw.index]
                self._metrics.draw_finished(draw, agreement, request.controls.thinking, endpoint)
            queue_s = place.waited_s + began_s - submitted_s
            self._metrics.answered(endpoint, queue_s, finished_s - submitted_s)
            if deadline_met is not None:
                self._metrics.count_deadline(met=deadline_met)
            span.drew(draws)
            timing = wire.Timing(
                total_ms=_ms(finished_s - arrival.since_s),
                checks_ms=_ms(submitted_s - checking_s),
                engine_ms=_ms(finished_s - submitted_s),
                queue_ms=_ms(queue_s),
            )
            deadline = None
            if deadline_met is not None:
                cut = [draw.index for draw in draws if draw.cut is not None]
                deadline = wire.Deadline(met=deadline_met, cut=cut)
            yield PlannedScene(
                *(tuple(draws), agreements, drafts, engine.card, timing, deadline, paint),
                prompt_tokens=partial(engine.prompt_tokens, request),
            )

    async def _checked(
        self, asked: AnyPlanRequest, card: ModelCard, arrival: Arrival, geometry: Geometry | None
    ) -> PlanRequest:
        engine_id = f"{arrival.request_id}/{secrets.token_hex(4)}"
        # On a thread: megabytes of base64 must not hold up the answers of others.
        request = await asyncio.to_thread(engine_request, asked, card, engine_id, geometry)
        if (deadline_ms := request.controls.deadline_ms) is None:
            return request
        left_ms = deadline_ms - round(1000 * (time.monotonic() - arrival.since_s)) - _ANSWERING_MS
        return replace(request, controls=replace(request.controls, deadline_ms=max(1, left_ms)))

    async def _decode(self, engine: Engine, request: PlanRequest) -> AsyncGenerator[Event]:
        """The engine's events under the limits of time, its errors as problems."""
        loop = asyncio.get_running_loop()
        late, limit_s = QUEUE_TIMEOUT, self._limits.queue_s
        ends_s = loop.time() + limit_s
        try:
            async with aclosing(engine.submit(request)) as events:
                while True:
                    async with asyncio.timeout_at(ends_s):
                        event = await anext(events, None)
                    if event is None:
                        return
                    if isinstance(event, Started):
                        late, limit_s = DECODE_TIMEOUT, self._limits.decode_s
                        ends_s = loop.time() + limit_s
                    yield event
        except TimeoutError:
            raise ProblemError(late, f"it was given up after {limit_s:g} s") from None
        except ImageError as error:
            raise ProblemError(INVALID_IMAGE, str(error)) from error
        except (RequestError, SceneError, PlanError) as error:
            raise ProblemError(REFUSED, str(error)) from error
        except EngineError as error:
            log.error("engine failed", exc_info=error)
            raise ProblemError(ENGINE_FAILED, "decoding failed; the log has why") from error


async def last(events: AsyncGenerator[SceneEvent]) -> PlannedScene:
    """The whole of a scene, once it is there."""
    async with aclosing(events):
        async for event in events:
            if isinstance(event, PlannedScene):
                return event
    raise AssertionError("a scene ended without its draws")


def _judged(draw: Draw, request: PlanRequest) -> Agreement:
    return agreement(draw.plan, draw.thinking, draw.revised_plan, draw.at_10_hz, request.scene.history)


def _met(deadline_ms: int | None, arrival: Arrival) -> bool | None:
    if deadline_ms is None:
        return None
    return 1000 * (time.monotonic() - arrival.since_s) <= deadline_ms


def _ms(seconds: float) -> float:
    return round(1000 * seconds, 2)
