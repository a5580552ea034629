"""A teacher behind `POST /v1/label` of a LookTwice service, which checks its answers itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

from looktwice.clients.answers import BadAnswer, PlannerError, PlannerProblem, PlannerUnreachable, ServiceBusy
from looktwice.clients.labelling.checks import FailedCheck
from looktwice.clients.labelling.teachers.teacher import (
    Answer,
    NothingInView,
    Question,
    TeacherBusy,
    TeacherClosed,
    TeacherError,
)
from looktwice.clients.planner import Access, AsyncPlannerClient, RetryPolicy
from looktwice.clients.wire import MAX_SEED, TeacherName

RETRY_POLICY = RetryPolicy(timeout_s=120.0, attempts=1)
"""Who waits how long is the asker's to say."""
LABEL_REFUSED, NOTHING_IN_VIEW = "label-refused", "nothing-in-view"


class ServiceTeacher:
    """`looktwice.clients.labelling.teachers.teacher.Teacher` over HTTP. Make one with `connect`."""

    def __init__(self, planner: AsyncPlannerClient, teacher: TeacherName) -> None:
        self._planner, self._teacher = planner, teacher

    @classmethod
    async def connect(cls, base_url: str, access: Access = Access()) -> Self:
        """The teacher of the service there, by the name it has now.

        Raises:
            TeacherClosed: nobody answers there, or nobody who labels.
        """
        planner = AsyncPlannerClient(base_url, RETRY_POLICY, access=access)
        try:
            teacher = await planner.teacher()
        except PlannerError as error:
            raise TeacherClosed(f"no service answers at {base_url}: {error}") from error
        if teacher is None:
            raise TeacherClosed(f"the service at {base_url} has no teacher")
        return cls(planner, teacher)

    @property
    def name(self) -> str:
        """The name of the service's teacher."""
        return self._teacher.name

    @property
    def revision(self) -> str:
        """The revision of the service's teacher."""
        return self._teacher.revision

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        """See `Teacher.reflect`."""
        seed = (question.seed + len(complaints)) % MAX_SEED
        try:
            answered = await self._planner.label(
                question.scene,
                question.predicted,
                question.expert,
                surroundings=question.surroundings,
                seed=seed,
                outcome=question.outcome,
            )
        except (ServiceBusy, PlannerUnreachable) as error:
            raise TeacherBusy(str(error), getattr(error, "retry_after_s", None)) from error
        except PlannerProblem as error:
            if error.type.endswith(LABEL_REFUSED):
                return Answer("", unusable=error.detail)
            if error.type.endswith(NOTHING_IN_VIEW):
                raise NothingInView(error.detail) from error
            raise TeacherError(error.detail) from error
        except BadAnswer as error:
            raise TeacherClosed(str(error)) from error
        if answered.teacher != self._teacher:
            raise TeacherClosed(f"{answered.teacher.name} {answered.teacher.revision} answers there now")
        return Answer(answered.reflection, answered.input_tokens, answered.output_tokens, answered.cost_usd)

    async def close(self) -> None:
        """Close the connections."""
        await self._planner.close()
