"""What is asked of a contender."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from model.bench.scenes import fresh
from model.driving.scene import Scene
from model.engines.engine import Controls, PlanRequest, Thinking


@dataclass(frozen=True)
class Workload:
    """``scenes`` requests at once with ``n`` draws each."""

    scenes: int
    n: int
    thinking: Thinking
    temperature: float = 1.0

    def requests(self, scenes: Sequence[Scene], number: int) -> list[PlanRequest]:
        """Requests for scenes that no cache knows; ``number`` tells one round from another."""
        controls = Controls(thinking=self.thinking, n=self.n, temperature=self.temperature)
        return [
            PlanRequest(
                f"{number}-{place}",
                fresh(scenes[(number + place) % len(scenes)], 1000 * number + place),
                controls=_seeded(controls, 1000 * number + place),
            )
            for place in range(self.scenes)
        ]


def _seeded(controls: Controls, seed: int) -> Controls:
    values: dict[str, Any] = vars(controls) | {"seed": seed}
    return Controls(**values)
