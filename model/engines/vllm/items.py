"""A scene's arrays as vLLM takes them, by what vLLM calls modalities; without vLLM itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.tracks import MAX_TRACKS
from looktwice.model.driving.trajectory import HISTORY_STEPS, ROUTE_POINTS
from looktwice.model.network.inputs import ModelInputs
from looktwice.model.network.track_features import TRACK_FEATURES
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.network.vocabulary import HISTORY, ROUTE, TRACK, VIDEO_PAD

CLIPS: Final = "video"
"""Clips go by vLLM's own name for moving pictures: its rotary positions know that."""
SCENE: Final = "scene"
"""All clips of a scene, with what its resampler looks along."""
PLACEHOLDERS: Final = {
    CLIPS: VIDEO_PAD,
    SCENE: VIDEO_PAD,
    "history": HISTORY,
    "route": ROUTE,
    "tracks": TRACK,
}
"""The token that stands in a prompt for an item of each kind."""


Form = tuple[tuple[int, ...], type[np.generic]]
"""An array's shape and type."""


class ItemKind(NamedTuple):
    """What vLLM calls a modality.

    Attributes:
        tokens: how many an item takes in a prompt.
        items: of a prompt, at most.
        arrays: shape and type of each array of an item, by the name under which the network takes it.
    """

    tokens: int
    items: int
    arrays: Mapping[str, Form]


def kinds_of(settings: VlaSettings) -> dict[str, ItemKind]:
    """What a prompt of a checkpoint can hold, by modality."""
    slices, rows, columns = settings.grid
    cameras, patches = len(settings.cameras), slices * rows * columns
    width = 3 * settings.temporal_patch_size * settings.patch_size**2
    history, route = ((HISTORY_STEPS, 4), np.float32), ((ROUTE_POINTS, 2), np.float32)
    kinds: dict[str, ItemKind] = {}
    if settings.scene_tokens:
        seen: dict[str, Form] = {
            "scene_patches": ((cameras * patches, width), np.uint8),
            "scene_history": history,
            "scene_route": route,
            "scene_has_route": ((), np.bool_),
        }
        kinds[SCENE] = ItemKind(settings.scene_tokens, 1, seen)
    else:
        clip: dict[str, Form] = {
            "pixel_values_videos": ((patches, width), np.uint8),
            "video_grid_thw": ((3,), np.int64),
            "second_per_grid_ts": ((), np.float32),
        }
        kinds[CLIPS] = ItemKind(settings.clip_tokens, cameras, clip)
    kinds["history"] = ItemKind(1, 1, {"history": history})
    if settings.with_route:
        kinds["route"] = ItemKind(1, 1, {"route": route})
    if settings.with_tracks:
        tracks: dict[str, Form] = {
            "tracks": ((MAX_TRACKS, len(TRACK_FEATURES)), np.float32),
            "tracks_history": history,
            "tracks_route": route,
            "tracks_has_route": ((), np.bool_),
        }
        kinds["tracks"] = ItemKind(settings.intent_tokens, 1, tracks)
    return kinds


Arrays = dict[str, npt.NDArray[Any]]


def items_of(inputs: ModelInputs, settings: VlaSettings) -> dict[str, Arrays]:
    """A scene's arrays [items, ...] by modality and name."""
    items: dict[str, Arrays] = {}
    route = np.zeros((ROUTE_POINTS, 2), np.float32) if inputs.route is None else inputs.route
    if settings.scene_tokens:
        items[SCENE] = {
            "scene_patches": inputs.patches[None],
            "scene_history": inputs.history[None],
            "scene_route": route[None],
            "scene_has_route": np.array([inputs.route is not None]),
        }
    else:
        clips = len(inputs.video_grid_thw)
        items[CLIPS] = {
            "pixel_values_videos": inputs.patches.reshape(clips, -1, inputs.patches.shape[1]),
            "video_grid_thw": inputs.video_grid_thw,
            "second_per_grid_ts": np.full(clips, settings.seconds_per_slice, np.float32),
        }
    items["history"] = {"history": inputs.history[None]}
    if inputs.route is not None:
        items["route"] = {"route": inputs.route[None]}
    if inputs.tracks is not None:
        items["tracks"] = {
            "tracks": inputs.tracks[None],
            "tracks_history": inputs.history[None],
            "tracks_route": route[None],
            "tracks_has_route": np.array([inputs.route is not None]),
        }
    return items
