"""What a camera sees now, moved as the ego: a guess of what it will see in half a second."""

from __future__ import annotations

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.images import ImageError
from looktwice.model.driving.next_view import moved_view
from looktwice.model.driving.short_term import INERTIA
from looktwice.model.engines.engine import PlanRequest
from looktwice.model.families.picture_codes import PICTURE
from looktwice.model.network.checkpoint import Parts
from looktwice.model.network.visual_codes import frame_of


def expected_picture(request: PlanRequest, parts: Parts) -> tuple[int, ...]:
    """The 98 tokens of what the camera that is asked for would see if only the ego moved; takes some ms.

    Cameras are taken for those that our models are trained with: for another one the guess is worse. Empty
    where no camera is asked for, the scene has no clip of it, or the checkpoint has no codes of pictures.
    """
    scene, camera = request.scene, request.controls.camera
    images = [clip.images[-1] for clip in scene.clips if clip.camera == camera]
    if camera is None or not images or parts.visual_codes is None:
        return ()
    if PICTURE not in parts.vocabulary.alphabets:
        return ()
    try:
        frame = frame_of(images[0])
    except ImageError:
        # A picture that the model does not look at must not decide whether it answers.
        return ()
    moved = moved_view(frame, CAMERA_SPECS[camera], INERTIA.ego(scene.history, None))
    [ids] = parts.vocabulary.alphabets[PICTURE]
    return tuple(ids[code] for code in parts.visual_codes.encode(moved).tolist())
