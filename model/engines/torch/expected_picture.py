"""What a camera sees now, moved as the ego: a guess of what it will see in half a second."""

from __future__ import annotations

from looktwice.model.engines.engine import PlanRequest
from looktwice.model.families.picture_codes import PICTURE
from looktwice.model.network.checkpoint import Parts


def expected_picture(request: PlanRequest, parts: Parts) -> tuple[int, ...]:
    """The 98 tokens of what the camera that is asked for would see if only the ego moved.

    Empty where `InputBuilder.expected` has none, or the checkpoint writes no pictures.
    """
    codes = parts.inputs.expected(request.scene, request.controls.view)
    if codes is None or PICTURE not in parts.vocabulary.alphabets:
        return ()
    [ids] = parts.vocabulary.alphabets[PICTURE]
    return tuple(ids[code] for code in codes)
