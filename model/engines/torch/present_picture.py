"""What a camera sees now, as a guess of what it will see in half a second: sky and road mostly stay."""

from __future__ import annotations

from model.driving.images import ImageError
from model.engines.engine import PlanRequest
from model.families.picture_codes import PICTURE
from model.network.checkpoint import Parts
from model.network.visual_codes import frame_of


def present_picture(request: PlanRequest, parts: Parts) -> tuple[int, ...]:
    """The 98 tokens of what the camera that is asked for sees now; takes some ms.

    Empty where no camera is asked for, the scene has no clip of it, or the checkpoint has no codes of
    pictures.
    """
    images = [clip.images[-1] for clip in request.scene.clips if clip.camera == request.controls.camera]
    if not images or parts.visual_codes is None or PICTURE not in parts.vocabulary.alphabets:
        return ()
    try:
        frame = frame_of(images[0])
    except ImageError:
        # A picture that the model does not look at must not decide whether it answers.
        return ()
    [ids] = parts.vocabulary.alphabets[PICTURE]
    return tuple(ids[code] for code in parts.visual_codes.encode(frame).tolist())
