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
    """``scenes`` requests at once with ``n`` draws each.

    Attributes:
        format: of the responses.
        camera: whose picture each response imagines; None leaves that to the model, where it imagines any.
    """

    scenes: int
    n: int
    thinking: Thinking
    format: str
    temperature: float = 1.0
    deadline_ms: int | None = None
    camera: str | None = None

    def controls(self) -> Controls:
        """What is asked of the engine, but for the seed; raises `RequestError` for what cannot be asked."""
        # Drawn, as other engines' samplers draw them.
        return Controls(
            thinking=self.thinking,
            n=self.n,
            temperature=self.temperature,
            deadline_ms=self.deadline_ms,
            numbers="drawn",
            codes="drawn",
            imagine="auto" if self.camera is None else "always",
            camera=self.camera,
        )

    def requests(self, scenes: Sequence[Scene], number: int, step: int = 0) -> list[PlanRequest]:
        """Requests for scenes that no cache knows; ``number`` tells one round from another.

        With the next ``step`` a planner asks again a tenth of a second later: the same pictures and seed, a
        history that has moved on.
        """
        controls = self.controls()
        return [
            PlanRequest(
                f"{number}-{place}-{step}",
                moved(fresh(scenes[(number + place) % len(scenes)], 1000 * number + place), step),
                self.format,
                controls=_seeded(controls, 1000 * number + place),
            )
            for place in range(self.scenes)
        ]


def _seeded(controls: Controls, seed: int) -> Controls:
    values: dict[str, Any] = vars(controls) | {"seed": seed}
    return Controls(**values)
