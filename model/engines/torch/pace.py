"""How long things take, as far as deadlines need to know. No torch."""

from __future__ import annotations

from enum import Enum
from typing import Final

_MEMORY: Final = 0.1
"""Weight of the latest observation in a running mean."""
_PASS_MEMORY: Final = 0.02
"""The same for passes: a line needs some that differ."""
_ALIKE: Final = 1.0
"""Passes whose rows vary by less than this tell little of what a row takes."""
_FIRST_STEP_S: Final = 0.02
_FIRST_ENDING: Final = 40.0
"""Passes from the end of thinking to the end of the response, before any was seen."""
_LONGER: Final = 2.0
"""So many times their usual deviation the longest of a request's draws are longer than usual."""
_FIRST_DIRECT: Final = 15.0
"""Passes of a response that does not reflect, before any was seen."""
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
    """Running means of what steps, passes and prompts take, and of how many passes a response needs.

    Attributes:
        step_s: a step, prompts and all.
        deviation_s: how far steps are from it.
        ending_passes: behind a text.
        prompt_s: to read a prompt.
    """

    def __init__(self) -> None:
        self.step_s, self.deviation_s = _FIRST_STEP_S, 0.0
        self.ending_passes = _FIRST_ENDING
        self._direct_passes, self._direct_deviation = _FIRST_DIRECT, 0.0
        self.prompt_s, self._reading_s = 0.0, 0.0
        self._pass_s, self._rows = _FIRST_STEP_S, 1.0
        self._square, self._product = 1.0, _FIRST_STEP_S

    def saw_step(self, seconds: float) -> None:
        """A step took so long."""
        self.deviation_s += _MEMORY * (abs(seconds - self.step_s) - self.deviation_s)
        self.step_s += _MEMORY * (seconds - self.step_s)

    def saw_ending(self, passes: int) -> None:
        """A response took so many passes behind its text."""
        self.ending_passes += _MEMORY * (passes - self.ending_passes)

    def saw_direct(self, passes: int) -> None:
        """A response that does not reflect took so many passes."""
        self._direct_deviation += _MEMORY * (abs(passes - self._direct_passes) - self._direct_deviation)
        self._direct_passes += _MEMORY * (passes - self._direct_passes)

    def direct_passes_left(self, passes: int) -> float:
        """How many more a response needs that does not reflect, were it one of the longer ones."""
        return max(1.0, self._direct_passes + _LONGER * self._direct_deviation - passes)

    def saw_prompts(self, seconds: float, read: int) -> None:
        """Reading prompts took so long, and so many of them are ready by it."""
        self._reading_s += seconds
        if read:
            self.prompt_s += _MEMORY * (self._reading_s / read - self.prompt_s)
            self._reading_s = 0.0

    def saw_pass(self, seconds: float, rows: int) -> None:
        """A pass of so many rows took so long."""
        self._pass_s += _PASS_MEMORY * (seconds - self._pass_s)
        self._rows += _PASS_MEMORY * (rows - self._rows)
        self._square += _PASS_MEMORY * (rows**2 - self._square)
        self._product += _PASS_MEMORY * (seconds * rows - self._product)

    def pass_s(self, rows: int) -> float:
        """How long a pass of so many rows takes: on the line through those that were seen."""
        together = self._product - self._pass_s * self._rows
        a_row_s = max(0.0, together) / (self._square - self._rows**2 + _ALIKE)
        return max(0.0, self._pass_s + a_row_s * (rows - self._rows))

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
