"""A question to a teacher: how long it may take, who is told that none answers, and what it costs."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Final, Protocol

import structlog

from looktwice.clients.labelling.teachers.teacher import Answer, TeacherBusy, TeacherClosed, TeacherError
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.problems import TEACHER_AWAY, TEACHER_REFUSED, ProblemError

log = structlog.stdlib.get_logger()

RETRY_FOR_S: Final = 30.0
"""That a teacher may be busy or away before its caller is told."""


class Named(Protocol):
    """A teacher, of whatever."""

    @property
    def name(self) -> str:
        """Who it is."""


@contextmanager
def asking(teacher: Named, metrics: Metrics) -> Generator[list[Answer]]:
    """Where the answers go that a teacher gives in the block; they are counted, whatever comes of them.

    Raises:
        ProblemError: the teacher is away, or does not take the question.
    """
    answers: list[Answer] = []
    try:
        yield answers
    except (TeacherBusy, TeacherClosed) as error:
        # What an endpoint says, or where it is, is the operator's business.
        log.warning("teacher away", teacher=teacher.name, reason=str(error))
        raise ProblemError(TEACHER_AWAY, f"{teacher.name} does not answer; the log has why") from None
    except TeacherError as error:
        log.warning("teacher refused", teacher=teacher.name, reason=str(error))
        detail = f"{teacher.name} does not take this question; the log has why"
        raise ProblemError(TEACHER_REFUSED, detail) from None
    finally:
        metrics.teacher_paid(
            teacher.name,
            sum(answer.input_tokens for answer in answers),
            sum(answer.output_tokens for answer in answers),
            sum(answer.cost_usd for answer in answers),
        )
