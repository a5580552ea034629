"""Feedback of other teachers than the built-in one."""

from __future__ import annotations

import asyncio
from typing import Final

import looktwice.clients.wire_feedback as wire_feedback
from looktwice.clients.labelling.teachers.feedback_teacher import (
    FeedbackQuestion,
    FeedbackTeacher,
    ask_feedback,
)
from looktwice.clients.labelling.teachers.teacher import ReflectionRefused
from looktwice.clients.retries import with_retries
from looktwice.clients.wire import TeacherName
from looktwice.model.driving.pdm.feedback import Feedback
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.problems import FEEDBACK_REFUSED, at
from looktwice.service.scoring.rule_feedback import FeedbackAnswer, sections_of
from looktwice.service.teaching.asking import RETRY_FOR_S, asking

ASKED_AT_ONCE: Final = 4
"""Questions of one request that a teacher has at a time."""


async def taught(
    given: FeedbackAnswer, teacher: FeedbackTeacher, metrics: Metrics
) -> wire_feedback.FeedbackResponse:
    """The answer with an outside teacher's sections in the place of the built-in one's.

    Raises:
        ProblemError: the teacher is away, does not take a question, or fails the checks.
    """
    places = asyncio.Semaphore(ASKED_AT_ONCE)

    async def one(row: int) -> wire_feedback.PlanFeedback:
        plan, question = given.response.feedback[row], given.questions[row]
        if question is None:
            return plan
        async with places:
            feedback, attempts = await _asked(teacher, question, metrics, f"/trajectories/{row}")
        changes = {
            "sections": sections_of(feedback),
            "text": str(feedback),
            "written_by": teacher.name,
            "attempts": attempts,
        }
        return plan.model_copy(update=changes)

    tasks = [asyncio.create_task(one(row)) for row in range(len(given.questions))]
    try:
        feedback = list(await asyncio.gather(*tasks))
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    name = TeacherName(name=teacher.name, revision=teacher.feedback_revision)
    return given.response.model_copy(update={"feedback": feedback, "teacher": name})


async def _asked(
    teacher: FeedbackTeacher, question: FeedbackQuestion, metrics: Metrics, pointer: str
) -> tuple[Feedback, int]:
    with asking(teacher, metrics) as answers:
        try:
            written = await with_retries(lambda: ask_feedback(teacher, question, answers), RETRY_FOR_S)
        except ReflectionRefused as error:
            metrics.feedback_failed(teacher.name, [each.check for each in error.failed])
            raise at(
                FEEDBACK_REFUSED, pointer, f"{teacher.name}, asked {error.attempts} times: {error}"
            ) from None
    metrics.feedback_failed(teacher.name, [each.check for each in written.failed])
    return written.feedback, written.attempts
