"""Deadlines: how long steps take, what there is still time for, which draws get a draft. No torch.

A draft is the direct trajectory of a draw that reflects. It is decoded beside the reflection and is the
answer if the reflection does not end before the deadline.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Final

from looktwice.model.engines.engine_requests import leads_to_reflection
from looktwice.model.families.family import Branch
from looktwice.model.formats.cursor import Cursor

_WEIGHT: Final = 0.1
"""Weight of the latest observation in a running mean."""
_FIRST_STEP_S: Final = 0.02
_FIRST_ENDING_PASSES: Final = 10.0
"""Before any was seen. Rather too few: a look that is not taken tells nothing of its length, and one that
does not end in time has a draft beside it."""
_FIRST_PICTURE_PASSES: Final = 60.0
"""Likewise, but rather too many: nothing stands in for a response whose picture comes too late."""
_CALM: Final = 1.5
"""With less than so many times the necessary time left, a text ends at the next sentence."""
_LATE_DEVIATIONS: Final = 4.0
"""A step may take so many deviations longer than usual, for example when it also prefills a new scene."""

Choices = Sequence[tuple[int, tuple[int, ...]]]
"""Tokens chosen at one decision, each with the draws that chose it."""


class TimeFor(Enum):
    """What there is time for within a text. Where a picture may begin, all but the last mean that it may."""

    GO_ON = "go on"
    END_SENTENCE = "end with this sentence"
    END_NOW = "end now"


class LatencyModel:
    """Running means of what a step takes and how many passes follow a text.

    Attributes:
        step_s: mean duration of a step, prefill included.
        deviation_s: mean absolute deviation of a step from it.
        ending_passes: passes from where a second look can no longer be cut to the response's end: from the
            end of its text, or from the branch where there is no text that could be ended.
        picture_passes: passes from where a response begins a picture to its end.
    """

    def __init__(self) -> None:
        self.step_s, self.deviation_s = _FIRST_STEP_S, 0.0
        self.ending_passes, self.picture_passes = _FIRST_ENDING_PASSES, _FIRST_PICTURE_PASSES

    def saw_step(self, seconds: float) -> None:
        """A step took so long."""
        self.deviation_s += _WEIGHT * (abs(seconds - self.step_s) - self.deviation_s)
        self.step_s += _WEIGHT * (seconds - self.step_s)

    def saw_ending(self, passes: int) -> None:
        """A second look that could no longer be cut took so many passes."""
        self.ending_passes += _WEIGHT * (passes - self.ending_passes)

    def saw_picture(self, passes: int) -> None:
        """A response took so many passes from where its picture began."""
        self.picture_passes += _WEIGHT * (passes - self.picture_passes)

    def time_for(self, deadline_s: float, now_s: float, *, picture: bool = False) -> TimeFor:
        """What a text may do, or whether a ``picture`` may begin, so that the rest fits in time."""
        left_s = deadline_s - now_s
        needed_s = self.step_s * (self.picture_passes if picture else self.ending_passes)
        if left_s > _CALM * needed_s:
            return TimeFor.GO_ON
        return TimeFor.END_SENTENCE if left_s > needed_s else TimeFor.END_NOW

    def last_step(self, deadline_s: float, now_s: float) -> bool:
        """Whether another step might end behind the deadline."""
        return now_s + self.step_s + _LATE_DEVIATIONS * self.deviation_s > deadline_s


def drafts_of(branch: Branch, cursor: Cursor, chosen: Choices) -> list[tuple[int, tuple[int, ...]]]:
    """The drafts to begin where draws choose ``chosen`` at ``cursor``.

    Returns:
        The token of the direct option with the draws that chose to reflect; nothing away from the branch.
    """
    if cursor.allowed().choice != branch.name:
        return []
    direct = next(int(id) for id in cursor.allowed().ids if branch.direct in cursor.option_texts(int(id)))
    return [(direct, draws) for token, draws in chosen if leads_to_reflection(branch, cursor, token)]
