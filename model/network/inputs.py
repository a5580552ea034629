"""A scene as the network's inputs: prompt, positions, patches, history, route."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from threading import Lock
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from cachetools import LRUCache

from looktwice.model.driving.hashing import hash_of
from looktwice.model.driving.images import ImageError, decode_image
from looktwice.model.driving.next_view import expected_views
from looktwice.model.driving.scene import Clip, Scene
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.families.family import Attempt, PictureRequest, Situation, TextInputs
from looktwice.model.families.registry import family_named
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.network.chat_prompt import prompt_text
from looktwice.model.network.composer import SEEN_PICTURES
from looktwice.model.network.patches import normalise, patchify, resize
from looktwice.model.network.track_features import track_features
from looktwice.model.network.visual_codes import Seen, VisualCodes, frame_of
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.network.vocabulary import VIDEO_PAD, Vocabulary

IntArray = npt.NDArray[np.int64]

_EXPECTED_KEPT: Final = 64
"""Pictures whose codes are kept; several parts of an engine ask for those of one request."""


@dataclass(frozen=True, eq=False)
class Prompt:
    """Tokens and positions; without text inputs the same for all scenes of a format that bring the same.

    Attributes:
        ids: int64 [t] tokens.
        position_ids: int64 [3, t] rotary positions (time, row, column).
        position_offset: the rotary position of the token at place i behind the prompt is
            i + position_offset: pictures take fewer positions than tokens.
    """

    ids: IntArray
    position_ids: IntArray
    position_offset: int


@dataclass(frozen=True, eq=False)
class ModelInputs:
    """One scene, ready for the network.

    Attributes:
        prompt: tokens and positions.
        patches: uint8 [p, 1176], not yet normalised (the network does it); see `pixel_values_videos`.
        video_grid_thw: int64 [cameras, 3] slices, rows and columns of patches per clip.
        history: float32 [16, 4].
        route: float32 [20, 2] or None.
        tracks: float32 [16, features] of `track_features`, or None.
    """

    prompt: Prompt
    patches: npt.NDArray[np.uint8]
    video_grid_thw: IntArray
    history: FloatArray
    route: FloatArray | None
    tracks: FloatArray | None = None

    @property
    def pixel_values_videos(self) -> npt.NDArray[np.float32]:
        """The patches normalised, as Qwen2.5-VL's processor gives them: float32 [p, 1176]."""
        return normalise(self.patches)


def moved_pictures(scene: Scene, view: PictureRequest, count: int = SEEN_PICTURES) -> Seen | None:
    """What a view would show if only the ego moved, as each of its last ``count`` pictures tells it.

    Takes some ms each. None where the scene has no clip of its camera, or a picture is damaged.

    Returns:
        uint8 [count, 112, 224, 3], the last one of now.
    """
    shown = _shown(scene, view)
    if shown is None:
        return None
    # A picture that the tower does not look at must not decide whether the model answers.
    with suppress(ImageError):
        frames = list(map(frame_of, shown.images[-count:]))
        return expected_views(frames, view.camera, scene.history, view.motion)
    return None


def _shown(scene: Scene, view: PictureRequest) -> Clip | None:
    return next((clip for clip in scene.clips if clip.camera == view.camera), None)


class InputBuilder:
    """Builds inputs for one checkpoint. Safe to use from several threads.

    ``visual_codes`` are those of the checkpoint, where it has any; see `expected`.
    """

    def __init__(
        self, vocabulary: Vocabulary, settings: VlaSettings, visual_codes: VisualCodes | None = None
    ) -> None:
        self._vocabulary = vocabulary
        self.settings = settings
        self._visual_codes = visual_codes
        self._expected: LRUCache[str, tuple[int, ...] | None] = LRUCache(_EXPECTED_KEPT)
        self._lock = Lock()
        self._prompts: dict[tuple[str, bool, bool], Prompt] = {}
        self._texts: dict[str, CompiledFormat] = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> InputBuilder:
        # `transformers` copies processors with all that they hold, and a lock cannot be copied.
        return InputBuilder(self._vocabulary, self.settings, self._visual_codes)

    @property
    def video_grid_thw(self) -> IntArray:
        """int64 [cameras, 3]."""
        return np.array([self.settings.grid] * len(self.settings.cameras), np.int64)

    def build(
        self, scene: Scene, format: str, attempt: Attempt | None = None, view: PictureRequest | None = None
    ) -> ModelInputs:
        """The inputs of ``scene`` for a response in ``format``, which may refine an attempt.

        ``view`` is the picture that is asked for, if any.

        Raises:
            SceneError: a camera is missing.
            ImageError: a picture cannot be decoded.
            FamilyError: an unknown format, or one that refines an attempt where there is none.
            FormatError: its family says of the scene what its prompt cannot say.
        """
        return ModelInputs(
            prompt=self.prompt_for(scene, format, attempt, view),
            patches=np.concatenate([self.patches(pictures) for pictures in self.slices(scene)]),
            video_grid_thw=self.video_grid_thw,
            history=scene.history,
            route=self.route_of(scene),
            tracks=self.tracks(scene),
        )

    def prompt_for(
        self, scene: Scene, format: str, attempt: Attempt | None = None, view: PictureRequest | None = None
    ) -> Prompt:
        """The prompt alone of what `build` gives; raises `FamilyError` and `FormatError` as it does."""
        camera = None if view is None else view.camera
        situation = Situation(scene.history, self.route_of(scene), attempt, camera)
        tracks = self.settings.with_tracks and scene.tracks is not None
        return self.prompt(format, situation, tracks=tracks)

    def expected(self, scene: Scene, view: PictureRequest | None) -> tuple[int, ...] | None:
        """The 98 codes of a view if only the ego moved; takes some ms, once for a picture.

        None where no view is asked for, the scene has no clip of its camera, or the checkpoint no such codes.
        """
        if view is None or self._visual_codes is None:
            return None
        shown = _shown(scene, view)
        if shown is None:
            return None
        key = hash_of(shown.images[-1], repr(view), scene.history.tobytes())
        with self._lock:
            if key in self._expected:
                return self._expected[key]
        moved = moved_pictures(scene, view, 1)
        codes = None if moved is None else tuple(self._visual_codes.encode(moved[-1]).tolist())
        with self._lock:
            self._expected[key] = codes
        return codes

    def route_of(self, scene: Scene) -> FloatArray | None:
        """The route [20, 2] that the network is given, or None."""
        return scene.route if self.settings.with_route else None

    def tracks(self, scene: Scene) -> FloatArray | None:
        """The tracks' features [16, features] that the network is given, or None."""
        if not self.settings.with_tracks or scene.tracks is None:
            return None
        return track_features(scene.tracks, scene.route)

    def slices(self, scene: Scene) -> list[tuple[bytes, ...]]:
        """The encoded pictures of each time slice, camera by camera; the tower sees slices one by one.

        Raises:
            SceneError: a camera is missing.
        """
        depth = self.settings.temporal_patch_size
        return [
            images[start : start + depth]
            for images in (scene.clip(camera).images for camera in self.settings.cameras)
            for start in range(0, len(images), depth)
        ]

    def patches(self, pictures: tuple[bytes, ...]) -> npt.NDArray[np.uint8]:
        """The patches of one slice, uint8 [p, 1176]; raises `ImageError` for what cannot be decoded."""
        return self.patchified([self.frame(picture) for picture in pictures])

    def frame(self, picture: bytes) -> npt.NDArray[np.uint8]:
        """A picture in the network's size, uint8 [h, w, 3]; raises `ImageError` where that fails."""
        return resize(decode_image(picture), self.settings)

    def patchified(self, frames: Sequence[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
        """The patches of the `frame`s of one slice, uint8 [p, 1176]."""
        return patchify(np.stack(frames), self.settings)

    def prompt(self, format: str, situation: Situation, *, tracks: bool = False) -> Prompt:
        """The prompt of a format in a situation, with its route if it has one.

        Raises:
            FamilyError: an unknown format.
            FormatError: its family says what its prompt cannot say.
        """
        key = (format, situation.route is not None, tracks)
        if text := self.text(format, situation):
            return self._prompt(*key, text)
        if key not in self._prompts:
            self._prompts[key] = self._prompt(*key, text)
        return self._prompts[key]

    def text(self, format: str, situation: Situation) -> list[int]:
        """The tokens of a family's own text inputs; raises as `prompt` does."""
        inputs = family_named(format).inputs
        if inputs is None:
            return []
        return [token.id for token in self._text(format, inputs).render(inputs.values(situation))]

    def longest_prompt(self, format: str) -> int:
        """Tokens of the longest prompt, of scenes that bring all that the checkpoint takes."""
        inputs = self.settings.inputs
        prompt = self._prompt(format, "route" in inputs, "tracks" in inputs, [])
        texts = family_named(format).inputs
        return len(prompt.ids) + (0 if texts is None else self._text(format, texts).longest())

    def _prompt(self, format: str, route: bool, tracks: bool, text: Sequence[int]) -> Prompt:
        before, behind = prompt_text(format, self.settings, route=route, tracks=tracks)
        # Nothing is merged over the seam: the second part begins with a special token.
        encode = self._vocabulary.encode
        ids = np.array([*encode(before), *text, *encode(behind)], np.int64)
        positions = rotary_positions(ids == self._vocabulary.id_of(VIDEO_PAD), self.settings)
        return Prompt(ids, positions, int(positions.max()) + 1 - len(ids))

    def _text(self, format: str, inputs: TextInputs) -> CompiledFormat:
        if format not in self._texts:
            self._texts[format] = CompiledFormat(inputs.format, self._vocabulary)
        return self._texts[format]


def rotary_positions(is_video: npt.NDArray[np.bool_], settings: VlaSettings) -> IntArray:
    """Rotary positions int64 [3, t] of a sequence whose video placeholders are marked.

    Text counts on in all three rows; a clip's tokens count slices (spaced by real time), rows and
    columns from its beginning, and the text behind goes on after its larger side
    (transformers, `Qwen2_5_VLModel.get_rope_index`). What a resampler gathered has no place in a picture,
    and counts as text.

    Raises:
        ValueError: the placeholders are not whole clips.
    """
    if settings.scene_tokens:
        return np.tile(np.arange(len(is_video), dtype=np.int64), (3, 1))
    slices, rows, columns = settings.grid
    merge = settings.spatial_merge_size
    spacing = settings.tokens_per_second * settings.seconds_per_slice
    time = (np.arange(slices) * spacing).astype(np.int64)
    clip = np.stack(
        np.meshgrid(time, np.arange(rows // merge), np.arange(columns // merge), indexing="ij")
    ).reshape(3, -1)
    positions = np.zeros((3, len(is_video)), np.int64)
    place, now = 0, 0
    while place < len(is_video):
        if not is_video[place]:
            positions[:, place] = now
            place, now = place + 1, now + 1
            continue
        end = place + settings.clip_tokens
        if not is_video[place:end].all() or len(is_video) < end:
            raise ValueError(f"a clip must have {settings.clip_tokens} placeholders in a row")
        positions[:, place:end] = clip + now
        place, now = end, now + max(rows, columns) // merge
    return positions
