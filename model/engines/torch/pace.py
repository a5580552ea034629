"""How long things take, as far as deadlines need to know. No torch."""

from __future__ import annotations

from enum import Enum
from typing import Final

_MEMORY: Final = 0.1
"""Weight of the latest observation in a running mean."""
_FIRST_STEP_S: Final = 0.02
_FIRST_ENDING: Final = 40.0
"""Passes from the end of thinking to the end of the response, before any was seen."""
_CALM: Final = 1.5
"""With less than so many times the necessary time left, a text ends at the next sentence."""
_LATE_STEPS: Final = 4.0
"""So many times their usual deviation steps may take longer than usual: when a new scene's prompt goes
through the network between two of them, for one."""


class TimeFor(Enum):
    """What there is time for, within a text."""

    GO_ON = "go on"
    END_SENTENCE = "end with this sentence"
    END_NOW = "end now"


class Pace:
    """Running means of the time of a step, of how far steps are from it, and of the passes behind a text."""

    def __init__(self) -> None:
        self.step_s, self.deviation_s = _FIRST_STEP_S, 0.0
        self.ending_passes = _FIRST_ENDING

    def saw_step(self, seconds: float) -> None:
        """A step took so long."""
        self.deviation_s += _MEMORY * (abs(seconds - self.step_s) - self.deviation_s)
        self.step_s += _MEMORY * (seconds - self.step_s)

    def saw_ending(self, passes: int) -> None:
        """A response took so many passes behind its text."""
        self.ending_passes += _MEMORY * (passes - self.ending_passes)

    def time_for(self, deadline_s: float, now_s: float) -> TimeFor:
        """What a text may do, so that what must follow it fits before the deadline."""
        left_s = deadline_s - now_s
        needed_s = self.step_s * self.ending_passes
        if left_s > _CALM * needed_s:
            return TimeFor.GO_ON
        return TimeFor.END_SENTENCE if left_s > needed_s else TimeFor.END_NOW

    def last_step(self, deadline_s: float, now_s: float) -> bool:
        """Whether another step might end behind the deadline."""
        return now_s + self.step_s + _LATE_STEPS * self.deviation_s > deadline_s
