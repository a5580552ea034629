"""What the endpoints work with, made once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import structlog
from fastapi import Request

from looktwice.clients.labelling.teachers.teacher import Teacher
from looktwice.clients.wire import Problem
from looktwice.model.engines.engine import Engine
from looktwice.service.admission.places import Admission, full_as_problem
from looktwice.service.http.idempotency import Idempotency, made_before
from looktwice.service.http.problem_documents import problem_document
from looktwice.service.operations.lifecycle import Lifecycle
from looktwice.service.operations.pulse import Pulse
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.operations.settings import Settings
from looktwice.service.planning.submitting import SceneSubmitter
from looktwice.service.problems import ProblemError, unforeseen
from looktwice.service.scoring.process import Scorer

log = structlog.stdlib.get_logger()


@dataclass(frozen=True)
class Dependencies:
    """See the modules they come from.

    Attributes:
        load: makes an engine over a checkpoint folder, like the one that answers; None where it cannot be
            replaced.
        began_s: when the service began, in s since 1970.
    """

    settings: Settings
    metrics: Metrics
    lifecycle: Lifecycle
    planning: SceneSubmitter
    idempotency: Idempotency
    teacher: Teacher
    load: Callable[[Path], Engine] | None
    began_s: int
    pulse: Pulse
    scorer: Scorer

    def check_open(self, admission: Admission) -> None:
        """Raise `ProblemError` while the service drains, or where ``admission`` has no place."""
        self.lifecycle.check_accepting()
        with full_as_problem():
            admission.check_open()

    def check_planning(self, request: Request, *, batch: bool = False) -> None:
        """The same for plans; a request whose answer was made before needs no place."""
        if not made_before(request, self.idempotency):
            self.planning.check_open(batch=batch)

    def problem_within(self, error: Exception, request_id: str) -> Problem:
        """What ended one scene of a batch, counted; the others go on. To be called while it is handled."""
        if isinstance(error, ProblemError):
            failure = error
        else:
            log.exception("scene of a batch failed")
            failure = unforeseen()
        self.metrics.count_problem_within(failure.kind)
        return problem_document(failure, request_id)
