"""What a foreign checkpoint is told of a scene: text with units and frames, pictures in between."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.images import decode_image
from looktwice.model.driving.scene import CLIP_PERIOD_S, Clip, Scene, Track
from looktwice.model.driving.trajectory import HISTORY_STEPS, STEP_S, FloatArray, present_speed
from looktwice.model.families.family import Family
from looktwice.model.network.chat_prompt import SYSTEM
from looktwice.model.network.patches import resize
from looktwice.model.network.vla_settings import VlaSettings

Picture = npt.NDArray[np.uint8]
"""uint8 RGB [h, w, 3]."""
Part = str | Picture
"""Of a prompt."""

PICTURES: Final = VlaSettings(image_width=448, image_height=224)
"""Its cameras are looked through, and pictures are brought to its size before the checkpoint's own processor
gets them."""
_FRAME: Final = (
    "All positions are in the car's frame: x in metres ahead, y in metres to the left, heading in radians, "
    "growing to the left. The car is at x 0, y 0, heading 0 now."
)
_TOLD_STEPS: Final = 5
"""Every so many poses of the history one is told."""


def prompt_parts(scene: Scene, family: Family, own_text: str, cameras: Sequence[str]) -> Iterator[Part]:
    """The prompt of a scene, in order.

    Args:
        scene: what the car sees.
        family: whose response is asked for.
        own_text: what the family itself says of the scene.
        cameras: whose pictures are shown; none for a model that reads text alone.

    Raises:
        SceneError: a camera is missing.
        ImageError: a picture cannot be decoded.
    """
    times_s = family.times_s
    poses = f"The trajectory has {len(times_s)} poses, from {times_s[0]:g} s to {times_s[-1]:g} s from now."
    yield f"{SYSTEM} {family.task}\n{_FRAME}\n{poses}\n"
    for camera in cameras:
        yield from _clip(scene.clip(camera))
    yield _history(scene.history)
    if scene.route is not None:
        yield f"Route ahead, a point every 4 m: {_points(scene.route)}\n"
    if scene.tracks is not None:
        yield f"Objects around now: {'; '.join(map(_track, scene.tracks)) or 'none'}\n"
    yield own_text


def _clip(clip: Clip) -> Iterator[Part]:
    last = len(clip.images) - 1
    for number, image in enumerate(clip.images):
        yield f"Camera {clip.camera}, {_ago((last - number) * CLIP_PERIOD_S)}: "
        yield resize(decode_image(image), PICTURES)
        yield "\n"


def _history(history: FloatArray) -> str:
    told = "; ".join(
        f"{_ago((HISTORY_STEPS - 1 - row) * STEP_S)} [{x_m:z.2f}, {y_m:z.2f}], heading {heading_rad:z.3f}"
        for row, (x_m, y_m, _, heading_rad) in enumerate(history.tolist())
        if (HISTORY_STEPS - 1 - row) % _TOLD_STEPS == 0
    )
    return f"History of the car: {told}\nSpeed now: {present_speed(history):z.1f} m/s\n"


def _track(track: Track) -> str:
    lights = f", lights on: {' and '.join(sorted(track.lights))}" if track.lights else ""
    return (
        f"{track.kind} at [{track.x_m:z.1f}, {track.y_m:z.1f}], heading {track.heading_rad:z.2f}, "
        f"{track.speed_ms:z.1f} m/s, {track.length_m:.1f} m long, {track.width_m:.1f} m wide{lights}"
    )


def _points(points: FloatArray) -> str:
    return ", ".join(f"[{x_m:z.1f}, {y_m:z.1f}]" for x_m, y_m in points.tolist())


def _ago(time_s: float) -> str:
    return f"{time_s:g} s ago" if time_s else "now"
