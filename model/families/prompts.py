"""What a family's prompt says of a scene beside its pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from looktwice.model.driving.next_view import Motion
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.formats.pieces import Format, Values


@dataclass(frozen=True, eq=False)
class Attempt:
    """An answer that was given to a scene before, to be refined.

    Attributes:
        trajectory: float32 [t, 4], the draft, at the times of the family that refines it.
        feedback: what is said of it.
    """

    trajectory: FloatArray
    feedback: str


class PictureRequest(NamedTuple):
    """A picture that is asked for: what a camera will see in half a second.

    Attributes:
        camera: one of `CAMERAS`.
        motion: where the ego will be then; None where nobody decides that.
    """

    camera: str
    motion: Motion | None = None


@dataclass(frozen=True, eq=False)
class Situation:
    """What text inputs are made of: what a scene and an example of training both know.

    Attributes:
        history: float32 [16, 4].
        route: float32 [20, 2]; None where the prompt has none.
        attempt: given exactly to families that refine one.
        camera: whose next picture is to be imagined, one of `CAMERAS`; None where nobody asks for one.
    """

    history: FloatArray
    route: FloatArray | None = None
    attempt: Attempt | None = None
    camera: str | None = None


@dataclass(frozen=True, eq=False)
class TextInputs:
    """What a prompt says of a scene in words and numbers, such as the present speed or a command.

    Attributes:
        format: of the text, which stands at the end of the prompt; tokenised by pieces, as responses are.
        values: of the format's sections; numbers must lie on their grid.
    """

    format: Format
    values: Callable[[Situation], Values]
