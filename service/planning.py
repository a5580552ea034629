"""One planning request, from the parsed body to the answer."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Awaitable, Callable
from typing import Final, NamedTuple

import structlog

import clients.wire as wire
from model.driving.images import ImageError
from model.driving.plan import Plan, PlanError, plan_changes, plan_iou
from model.driving.scene import SceneError
from model.engines.engine import (
    DraftFinished,
    Draw,
    DrawFinished,
    Engine,
    EngineError,
    ModelCard,
    PlanRequest,
    RequestError,
)
from service.intake import engine_request
from service.metrics import Metrics
from service.problems import ENGINE_FAILED, INVALID_IMAGE, REFUSED, ProblemError

_DECIMALS: Final = 4
"""Of poses on the wire: a tenth of a millimetre."""

log = structlog.stdlib.get_logger()


class Drawn(NamedTuple):
    """A draw, and the direct trajectory that was ready before its reflection was, if there was one."""

    draw: Draw
    draft: Draw | None


class CallerLeft(Exception):
    """The caller closed the connection before the answer was ready."""


async def answer(
    asked: wire.PlanRequest,
    engine: Engine,
    metrics: Metrics,
    request_id: str,
    caller_leaves: Callable[[], Awaitable[None]],
) -> wire.PlanResponse:
    """Plan for one scene.

    Args:
        asked: the parsed body.
        engine: a started engine.
        metrics: where draws are counted.
        request_id: the caller's id for the request.
        caller_leaves: returns when the caller has gone; the engine's work is then dropped.

    Raises:
        ProblemError: the request cannot be served; the engine failed.
        CallerLeft: nobody waits for the answer.
    """
    drawn, timing = await _decode(asked, engine, metrics, request_id, caller_leaves)
    return wire.PlanResponse(
        request_id=request_id, model=_model(engine), draws=[_draw(*each) for each in drawn], timing=timing()
    )


async def reflect(
    asked: wire.ReflectRequest,
    engine: Engine,
    metrics: Metrics,
    request_id: str,
    caller_leaves: Callable[[], Awaitable[None]],
) -> wire.ReflectResponse:
    """Look at a given plan; see `answer`."""
    drawn, timing = await _decode(asked, engine, metrics, request_id, caller_leaves)
    first = drawn[0].draw
    if first.plan is None or first.think_probability is None:
        raise ProblemError(REFUSED, f"responses in the format {asked.format} hold no plan to reflect upon")
    return wire.ReflectResponse(
        request_id=request_id,
        model=_model(engine),
        plan=wire_plan(first.plan),
        think_probability=first.think_probability,
        draws=[_reflection(first.plan, draw) for draw, _ in drawn],
        timing=timing(),
    )


async def _decode(
    asked: wire.PlanRequest | wire.ReflectRequest,
    engine: Engine,
    metrics: Metrics,
    request_id: str,
    caller_leaves: Callable[[], Awaitable[None]],
) -> tuple[list[Drawn], Callable[[], wire.Timing]]:
    """The draws of a request, and what tells the time that it has taken when the answer is made."""
    began = time.perf_counter()
    engine_id = f"{request_id}/{secrets.token_hex(4)}"
    # On a thread: megabytes of base64 must not hold up the answers of others.
    request = await asyncio.to_thread(engine_request, asked, engine.card, engine_id)
    checked = time.perf_counter()
    with metrics.plans_in_flight.track_inprogress():
        drawn = await _while_wanted(_draws(engine, request), caller_leaves)
    finished = time.perf_counter()
    endpoint = "reflect" if isinstance(asked, wire.ReflectRequest) else "plan"
    for draw, _ in drawn:
        metrics.draw_finished(draw, request.controls.thinking, endpoint)

    def timing() -> wire.Timing:
        return wire.Timing(
            total_ms=_ms(time.perf_counter() - began),
            checks_ms=_ms(checked - began),
            engine_ms=_ms(finished - checked),
        )

    return drawn, timing


def _model(engine: Engine) -> wire.ModelName:
    return wire.ModelName(name=engine.card.name, revision=engine.card.revision)


def model_card(card: ModelCard) -> wire.ModelCard:
    """A model card for the wire."""
    return wire.ModelCard(
        name=card.name,
        revision=card.revision,
        engine=card.engine,
        formats=list(card.formats),
        cameras=list(card.cameras),
        image_size=list(card.image_size),
        parameters=card.parameters,
        details=dict(card.details),
    )


async def _draws(engine: Engine, request: PlanRequest) -> list[Drawn]:
    drafts: dict[int, Draw] = {}
    draws: list[Draw] = []
    try:
        async for event in engine.submit(request):
            if isinstance(event, DraftFinished):
                drafts[event.draw.index] = event.draw
            elif isinstance(event, DrawFinished):
                draws.append(event.draw)
    except ImageError as error:
        raise ProblemError(INVALID_IMAGE, str(error)) from error
    except (RequestError, SceneError, PlanError) as error:
        raise ProblemError(REFUSED, str(error)) from error
    except EngineError as error:
        log.exception("engine failed")
        raise ProblemError(ENGINE_FAILED, str(error)) from error
    except asyncio.CancelledError:
        engine.cancel(request.request_id)
        raise
    return [Drawn(draw, drafts.get(draw.index)) for draw in sorted(draws, key=lambda draw: draw.index)]


async def _while_wanted(
    work: Awaitable[list[Drawn]], caller_leaves: Callable[[], Awaitable[None]]
) -> list[Drawn]:
    working = asyncio.ensure_future(work)
    leaving = asyncio.ensure_future(caller_leaves())
    try:
        await asyncio.wait((working, leaving), return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        raise CallerLeft
    finally:
        working.cancel()
        leaving.cancel()
        await asyncio.gather(working, leaving, return_exceptions=True)


def _draw(draw: Draw, draft: Draw | None) -> wire.Draw:
    return wire.Draw(
        index=draw.index,
        plan=None if draw.plan is None else wire_plan(draw.plan),
        branch=draw.branch,
        think_probability=draw.think_probability,
        thinking=draw.thinking,
        revised_plan=None if draw.revised_plan is None else wire_plan(draw.revised_plan),
        trajectory=_trajectory(draw),
        draft_trajectory=None if draft is None or draw.thinking is None else _trajectory(draft),
        tokens=dict(draw.tokens),
    )


def _reflection(given: Plan, draw: Draw) -> wire.Reflection:
    revised = draw.revised_plan or given
    changes = [
        wire.PlanChange(
            group=change.group,
            start_s=change.start / 10,
            end_s=change.end / 10,
            proposed=change.before,
            revised=change.after,
        )
        for change in plan_changes(given, revised)
    ]
    return wire.Reflection(
        index=draw.index,
        decision="revise" if changes else "keep",
        thinking=draw.thinking,
        revised_plan=None if draw.revised_plan is None else wire_plan(draw.revised_plan),
        plan_iou=plan_iou(given, revised),
        changes=changes,
        trajectory=_trajectory(draw),
        tokens=dict(draw.tokens),
    )


def _trajectory(draw: Draw) -> list[list[float]]:
    rows: list[list[float]] = draw.trajectory.astype(float).round(_DECIMALS).tolist()
    return rows


def wire_plan(plan: Plan) -> wire.Plan:
    """A plan for the wire."""
    tracks = {
        group: [
            wire.MetaAction(start_s=action.start / 10, end_s=action.end / 10, word=action.word)
            for action in track
        ]
        for group, track in plan.tracks()
    }
    return wire.Plan(text=str(plan), tracks=wire.Tracks(**tracks))


def _ms(seconds: float) -> float:
    return round(1000 * seconds, 2)
