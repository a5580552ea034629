"""What the endpoints work with, made once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from looktwice.clients.labelling.teachers.teacher import Teacher
from looktwice.model.engines.engine import Engine
from looktwice.service.http.idempotency import Idempotency
from looktwice.service.operations.lifecycle import Lifecycle
from looktwice.service.operations.metrics import Metrics
from looktwice.service.operations.pulse import Pulse
from looktwice.service.operations.settings import Settings
from looktwice.service.planning.submitting import Planning
from looktwice.service.scoring.process import Scorer


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
    planning: Planning
    idempotency: Idempotency
    teacher: Teacher
    load: Callable[[Path], Engine] | None
    began_s: int
    pulse: Pulse
    scorer: Scorer
