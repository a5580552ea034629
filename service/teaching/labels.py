"""One question to a teacher, from the parsed body to the checked reflection."""

from __future__ import annotations

import asyncio
from typing import Final

import numpy as np

import looktwice.clients.wire as wire
from looktwice.clients.labelling.teachers.teacher import (
    AnnotationsMissing,
    NothingInView,
    Question,
    ReflectionRefused,
    Teacher,
    ask,
)
from looktwice.clients.retries import with_retries
from looktwice.model.driving.outcome import Outcome
from looktwice.model.driving.scene import AGENT_KINDS, Agent, SceneError
from looktwice.model.driving.tracks import track_of
from looktwice.model.driving.view import Surroundings
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.planning.validation import plan_of, scene_of
from looktwice.service.problems import (
    INVALID_REQUEST,
    LABEL_REFUSED,
    NEEDS_ANNOTATIONS,
    NOTHING_IN_VIEW,
    ProblemError,
    at,
)
from looktwice.service.teaching.asking import RETRY_FOR_S, asking

_TOLD: Final = {
    "collision": ("collided_s", "hit"),
    "off_road": ("off_road_s",),
    "off_route": ("off_route_s",),
    "comfort": ("uncomfortable_s", "uncomfortable"),
}
"""What a failure must come with; the others are told by the metres."""

_UNKNOWN_HEIGHT_M: Final = 1.5
"""The wire has no heights; teachers look at nothing that depends on them."""


async def label(
    asked: wire.LabelRequest, teacher: Teacher, metrics: Metrics, request_id: str
) -> wire.LabelResponse:
    """A checked reflection.

    Raises:
        ProblemError: the request cannot be served; the teacher lacks something or fails the checks.
    """
    question = await asyncio.to_thread(_question, asked)
    with asking(teacher, metrics) as answers:
        try:
            reflection = await with_retries(lambda: ask(teacher, question, answers), RETRY_FOR_S)
        except AnnotationsMissing as error:
            raise ProblemError(NEEDS_ANNOTATIONS, f"{teacher.name}: {error}") from None
        except NothingInView as error:
            raise ProblemError(NOTHING_IN_VIEW, f"{teacher.name}: {error}") from None
        except ReflectionRefused as error:
            metrics.count_label(teacher.name, [each.check for each in error.failed], written=False)
            raise ProblemError(
                LABEL_REFUSED, f"{teacher.name}, asked {error.attempts} times: {error}"
            ) from None
    metrics.count_label(teacher.name, [each.check for each in reflection.failed], written=True)
    return wire.LabelResponse(
        request_id=request_id,
        reflection=reflection.text,
        teacher=teacher_name(teacher),
        attempts=reflection.attempts,
        failed_checks=[f"{each.check}: {each.detail}" for each in reflection.failed],
        input_tokens=sum(answer.input_tokens for answer in answers),
        output_tokens=sum(answer.output_tokens for answer in answers),
        cost_usd=sum(answer.cost_usd for answer in answers),
    )


def teacher_name(teacher: Teacher) -> wire.TeacherName:
    """A teacher's provenance."""
    return wire.TeacherName(name=teacher.name, revision=teacher.revision)


def _question(asked: wire.LabelRequest) -> Question:
    return Question(
        scene_of(asked.scene),
        plan_of(asked.predicted_plan, "/predicted_plan"),
        plan_of(asked.expert_plan, "/expert_plan"),
        None if asked.annotations is None else _surroundings(asked.annotations),
        asked.seed,
        None if asked.outcome is None else _outcome(asked.outcome),
    )


def _outcome(asked: wire.PlanOutcome) -> Outcome:
    """What a plan failed at; each failure must come with what is told of it."""
    told = asked.model_dump()
    for name in asked.fails:
        for field in _TOLD.get(name, ()):
            if told[field] is None:
                raise at(INVALID_REQUEST, f"/outcome/{field}", f"is missing: the plan fails at {name}")
    outcome = Outcome.from_json(told)
    for name, is_so in (("behind", outcome.behind_m > 0), ("ahead", outcome.behind_m < 0)):
        if name in asked.fails and not is_so:
            problem = (
                f"says otherwise: the plan fails at {name}, and driven_m and expert_m must tell by how much"
            )
            raise at(INVALID_REQUEST, "/outcome/driven_m", problem)
    return outcome


def _surroundings(asked: wire.Annotations) -> Surroundings:
    agents = tuple(_agent(agent, number) for number, agent in enumerate(asked.agents))
    return Surroundings(agents, tuple(np.array(line, np.float32) for line in asked.lane_lines))


def _agent(asked: wire.Agent, number: int) -> Agent:
    kind = next((kind for kind in AGENT_KINDS if kind == asked.kind), None)
    if kind is None:
        problem = f"unknown kind {asked.kind!r}; known are {', '.join(AGENT_KINDS)}"
        raise at(INVALID_REQUEST, f"/annotations/agents/{number}/kind", problem)
    poses = np.array([[np.nan] * 3 if row is None else row for row in asked.poses], np.float32)
    lights = frozenset(asked.lights)
    agent = Agent(asked.agent_id, kind, asked.length_m, asked.width_m, _UNKNOWN_HEIGHT_M, poses, lights)
    try:
        track_of(agent)  # teachers look at where it is now
    except SceneError as error:
        raise at(INVALID_REQUEST, f"/annotations/agents/{number}", str(error)) from None
    return agent
