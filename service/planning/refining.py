"""Refining of one draft, from the parsed body to the answer: what is said of it, and what comes of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

import looktwice.clients.wire as wire
import looktwice.clients.wire_refine as wire_refine
from looktwice.clients.wire_scores import TrajectoryScore
from looktwice.clients.wire_values import rows
from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.feedback import Feedback, FeedbackError
from looktwice.model.driving.pdm.foresight import CONSTANT_VELOCITY, world_ahead
from looktwice.model.driving.pdm.judging import judged_plans
from looktwice.model.driving.pdm.labelled import plans_of
from looktwice.model.driving.pdm.profiles import SolveError
from looktwice.model.driving.pdm.rule_teacher import NAME, feedback_on
from looktwice.model.driving.pdm.scoring import Others, Scores, score
from looktwice.model.driving.pdm.world import STEP_S, STEPS, ScoreError, World
from looktwice.model.driving.trajectory import (
    HALF_SECONDS_S,
    TEN_HZ_S,
    TIMES_OF,
    FloatArray,
    GeometryError,
    at_times,
    check_trajectory,
)
from looktwice.model.engines.engine import Draw
from looktwice.model.families.registry import family_named
from looktwice.model.network.model_card import ModelCard
from looktwice.service.planning.events import Arrival, Begun, PlannedScene, SceneEvent
from looktwice.service.planning.telling import PlanTeller, Written
from looktwice.service.planning.validation import Geometry, geometry_of
from looktwice.service.planning.wire_answers import plan_answer
from looktwice.service.problems import (
    INVALID_FEEDBACK,
    INVALID_TRACKS,
    INVALID_TRAJECTORY,
    NEEDS_TRACKS,
    OTHER_PLAN,
    UNKNOWN_FORMAT,
    ProblemError,
    at,
)
from looktwice.service.scoring.request_scores import answer as score_answer
from looktwice.service.scoring.rule_feedback import CALLER, plan_id_of

VERSION: Final[Version] = "v1.1"
"""PDMS, which the paper judges by."""
_POINTER: Final = "/draft"


@dataclass(frozen=True, eq=False)
class Refining:
    """A draft that is to be refined.

    Attributes:
        format: that refines it.
        planning: what the engine is asked.
        geometry: of the scene, as the model takes it.
        world: that plans are scored in; None where nothing around is known.
        judged: what is known of the draft before it is refined.
    """

    format: str
    planning: wire.PlanRequest
    geometry: Geometry
    world: World | None
    judged: wire_refine.DraftJudged


def refining_of(asked: wire_refine.RefineRequest, card: ModelCard, request_id: str) -> Refining:
    """What a request comes to, before the engine hears of it.

    Raises:
        ProblemError: a model without a format that refines; a draft that cannot be; feedback that is none, or
            that nothing can be made of.
    """
    format = refining_format(card)
    draft, times_s = _draft(asked.draft)
    world, before = None, None
    geometry = geometry_of(asked.scene)
    if geometry.tracks is not None:
        try:
            world = world_ahead(geometry.history, geometry.route, geometry.tracks)
        except ScoreError as error:
            # Of what is checked already, boxes alone can be too small; they are called by their places.
            raise at(INVALID_TRACKS, f"/scene/tracks/{error.place}", error.detail) from None
        try:
            before = _scores(world, draft[None])
        except (ScoreError, SolveError) as error:
            raise at(INVALID_TRAJECTORY, _POINTER, f"cannot be followed: {error}") from None
    feedback = _feedback(asked, world, draft, before)
    wanted_s = family_named(format).times_s
    if wanted_s[-1] > times_s[-1]:
        raise at(INVALID_TRAJECTORY, _POINTER, f"{format} refines drafts of {wanted_s[-1]:g} s")
    scene = asked.scene
    if "tracks" not in card.inputs:
        scene, geometry = scene.model_copy(update={"tracks": None}), replace(geometry, tracks=None)
    planning = wire.PlanRequest(
        scene=scene,
        controls=wire.Controls(**dict(asked.controls)),
        format=format,
        attempt=wire.Attempt(
            trajectory=rows(at_times(draft, times_s, wanted_s)),
            times_s=None if wanted_s == TEN_HZ_S else list(wanted_s),
            feedback=feedback.text,
        ),
        stream=asked.stream,
    )
    judged = _judged(feedback, world, before, request_id)
    return Refining(format, planning, geometry, world, judged)


def refining_format(card: ModelCard) -> str:
    """The model's first format that refines an attempt; raises `ProblemError` where it has none."""
    if not card.formats:
        raise ProblemError(UNKNOWN_FORMAT, "this service runs without a model; it only scores")
    found = next((name for name in card.formats if family_named(name).refines), None)
    if found is None:
        written = ", ".join(card.formats)
        raise ProblemError(
            UNKNOWN_FORMAT, f"{card.name} refines no drafts: it writes {written}, and none of these does"
        )
    return found


def refine_answer(refining: Refining, planned: PlannedScene, arrival: Arrival) -> wire_refine.RefineResponse:
    """The answer of POST /v1/refine, once the refinements are there; they are scored here."""
    answer = plan_answer(planned, arrival.request_id)
    after = list[TrajectoryScore | None]([None] * len(answer.draws))
    if refining.world is not None:
        after = _after(refining.world, planned.draws, arrival.request_id)
    total_ms = round(1000 * (time.monotonic() - arrival.since_s), 2)
    deadline, deadline_ms = answer.deadline, refining.planning.controls.deadline_ms
    if deadline is not None and deadline_ms is not None:
        # Scoring comes after the engine's part.
        deadline = deadline.model_copy(update={"met": deadline.met and total_ms <= deadline_ms})
    return wire_refine.RefineResponse(
        request_id=answer.request_id,
        model=answer.model,
        format=refining.format,
        **dict(refining.judged),
        draws=[
            wire_refine.Refinement(**dict(draw), after=after[place])
            for place, draw in enumerate(answer.draws)
        ],
        agreed=answer.agreed,
        timing=answer.timing.model_copy(update={"total_ms": total_ms}),
        deadline=deadline,
    )


def _judged(
    feedback: wire_refine.DraftFeedback, world: World | None, before: Scores | None, request_id: str
) -> wire_refine.DraftJudged:
    scored = None
    if world is not None and before is not None:
        scored = score_answer(world, before, request_id)
    return wire_refine.DraftJudged(
        feedback=feedback,
        foresight=None if world is None else CONSTANT_VELOCITY,
        version=VERSION,
        missing=[] if scored is None else scored.missing,
        before=None if scored is None else scored.scores[0],
    )


class RefineTeller:
    """Tells of the draft first, then of its refinements as of any draws."""

    def __init__(self, refining: Refining) -> None:
        self._judged = refining.judged
        self._tell = PlanTeller(refining.format)

    async def __call__(self, event: SceneEvent) -> list[tuple[str, Written | wire_refine.DraftJudged]]:
        """Events of `looktwice.clients.wire_refine.EVENTS` with their data."""
        if isinstance(event, Begun):
            return [("feedback", self._judged)]
        return [*await self._tell(event)]


def _draft(asked: list[list[float]]) -> tuple[FloatArray, tuple[float, ...]]:
    """A draft [8, 4] or [64, 4], and when its poses are."""
    if len(asked) not in TIMES_OF:
        raise at(
            INVALID_TRAJECTORY, _POINTER, f"has {len(asked)} poses; 8 at 0.5 s or 64 at 0.1 s are refined"
        )
    times_s = TIMES_OF[len(asked)]
    try:
        return check_trajectory(asked, times_s), times_s
    except GeometryError as error:
        raise at(INVALID_TRAJECTORY, _POINTER, str(error)) from None


def _scores(world: World, trajectories: FloatArray) -> Scores:
    """Of trajectories [n, 8 or 64, 4]; raises `ScoreError` or `SolveError` where they cannot be followed."""
    return score(world, plans_of(trajectories), VERSION, centre=True)


def _feedback(
    asked: wire_refine.RefineRequest, world: World | None, draft: FloatArray, before: Scores | None
) -> wire_refine.DraftFeedback:
    given = asked.feedback
    if isinstance(given, wire_refine.SectionsGiven):
        plan_id = plan_id_of([[x, y, heading] for x, y, _, heading in asked.draft])
        if given.plan_id not in (None, plan_id):
            raise at(OTHER_PLAN, "/feedback/plan_id", f"this draft is {plan_id}")
        try:
            text = str(Feedback(**given.model_dump(exclude={"plan_id"})))
        except FeedbackError as error:
            raise at(INVALID_FEEDBACK, "/feedback", str(error)) from None
        return wire_refine.DraftFeedback(text=text, written_by=CALLER, correct=None)
    if given != wire_refine.AUTO:
        return wire_refine.DraftFeedback(text=given, written_by=CALLER, correct=None)
    if world is None or before is None:
        raise at(
            NEEDS_TRACKS,
            "/scene/tracks",
            "auto feedback is about tracked objects: send them (an empty list where nobody is around), or "
            "write the feedback",
        )
    (judged,) = judged_plans(
        world, plans_of(draft[None]), before, Others(), threshold=asked.threshold, centre=True
    )
    return wire_refine.DraftFeedback(text=str(feedback_on(judged)), written_by=NAME, correct=judged.correct)


def _after(world: World, draws: tuple[Draw, ...], request_id: str) -> list[TrajectoryScore | None]:
    """What refinements are worth; None where they end before scores do, or cannot be followed."""
    times_s = draws[0].times_s
    if times_s[-1] < STEPS * STEP_S:
        return [None] * len(draws)
    trajectories = np.stack([at_times(draw.trajectory, times_s, HALF_SECONDS_S) for draw in draws])
    try:
        return list(_told_scores(world, trajectories, request_id))
    except (ScoreError, SolveError):
        # One that cannot be followed must not take the others' scores.
        return [_worth(world, each[None], request_id) for each in trajectories]


def _worth(world: World, trajectory: FloatArray, request_id: str) -> TrajectoryScore | None:
    try:
        return _told_scores(world, trajectory, request_id)[0]
    except (ScoreError, SolveError):
        return None


def _told_scores(world: World, trajectories: FloatArray, request_id: str) -> list[TrajectoryScore]:
    return score_answer(world, _scores(world, trajectories), request_id).scores
