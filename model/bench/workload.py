"""What is asked of a contender."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from looktwice.model.driving.scene import Scene
from looktwice.model.driving.variations import fresh, moved
from looktwice.model.engines.engine import Controls, PlanRequest, Thinking


@dataclass(frozen=True)
class Workload:
    """``scenes`` requests at once with ``n`` draws each."""

    scenes: int
    n: int
    thinking: Thinking
    temperature: float = 1.0
    deadline_ms: int | None = None

    def requests(self, scenes: Sequence[Scene], number: int, step: int = 0) -> list[PlanRequest]:
        """Requests for scenes that no cache knows; ``number`` tells one round from another.

        With the next ``step`` a planner asks again a tenth of a second later: the same pictures and seed, a
        history that has moved on.
        """
        # Drawn, as other engines' samplers draw them.
        controls = Controls(
            thinking=self.thinking,
            n=self.n,
            temperature=self.temperature,
            deadline_ms=self.deadline_ms,
            numbers="drawn",
            codes="drawn",
        )
        return [
            PlanRequest(
                f"{number}-{place}-{step}",
                moved(fresh(scenes[(number + place) % len(scenes)], 1000 * number + place), step),
                "cf_vla",
                controls=_seeded(controls, 1000 * number + place),
            )
            for place in range(self.scenes)
        ]


def _seeded(controls: Controls, seed: int) -> Controls:
    values: dict[str, Any] = vars(controls) | {"seed": seed}
    return Controls(**values)
