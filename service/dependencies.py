"""What the endpoints work with, made once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from clients.labelling.teachers.teacher import Teacher
from model.engines.engine import Engine
from service.idempotency import Idempotency
from service.lifecycle import Lifecycle
from service.metrics import Metrics
from service.planning import Planning
from service.pulse import Pulse
from service.scorer import Scorer
from service.settings import Settings


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
