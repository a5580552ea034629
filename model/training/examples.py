"""Labelled scenes brought into arrays for training, cached per scene file.

Reading nested Parquet rows costs milliseconds a scene; an epoch would spend more on that than on learning.
The cache holds what training reads, in flat arrays, and is rebuilt whenever its scene file is newer.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.facts import scene_facts
from looktwice.model.driving.hashing import hash_of
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.perceived import ROW_SIZE, Perceived, perceived_of, perceived_of_row
from looktwice.model.driving.plan import Plan, plan_from_bins
from looktwice.model.driving.reasoning import thoughts_of
from looktwice.model.driving.scene import CAMERAS, CLIP_FRAMES, LabelledScene
from looktwice.model.driving.scene_store import read_scenes, scene_files
from looktwice.model.driving.thoughts import Thoughts, read_thoughts
from looktwice.model.driving.tracks import tracks_of
from looktwice.model.driving.trajectory import POSE_MIRROR, FloatArray
from looktwice.model.driving.whole_files import written_whole
from looktwice.model.families.family import LessonPart
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.track_features import MIRRORED, track_features, without_route
from looktwice.model.training.dense import coarse, no_target, relative_motion

CACHE_VERSION: Final = 8
DENSE_FAR_M: Final = 200.0
"""Ranges beyond are all the same to a dense target."""
_NOTHING_KNOWN: Final = np.full(ROW_SIZE, np.nan, np.float32)


@dataclass(frozen=True, eq=False)
class Examples:
    """N labelled scenes as arrays.

    Attributes:
        pictures: uint8, all encoded pictures one after the other, each distinct one once.
        picture_spans: int64 [N, cameras, 4, 2], first and last-plus-one byte of each picture.
        now_spans, next_spans: int64 [N, `CAMERAS`, 2], of what each camera saw last, and half a second later;
            empty where nothing is known.
        pictured: bool [N], which examples have pictures; those of drives without cameras have none.
        history: float32 [N, 16, 4].
        route: float32 [N, 20, 2]; NaN where a scene has none.
        future: float32 [N, 64, 4].
        plan_bins: int8 [N, 3, 64].
        tracks: float32 [N, 16, features], see `track_features`.
        dense_classes: uint8 [N, cameras, 24, 48]; `UNLABELLED` where a scene has no dense targets.
        dense_range_log: float16 [N, cameras, 24, 48], log(1 + metres); 0 where there is nothing.
        dense_motion: float16 [N, cameras, 2, 24, 48], speed of agents relative to the ego, forward and to the
            left in the ego frame, divided by `SPEED_SCALE_MS`; 0 where no agent is.
        facts: float32 [N, facts].
        thoughts: str [N], the expert's; empty where annotations do not tell it.
        perceived: float32 [N, ROW_SIZE], see `Perceived.row`; NaN where annotations do not tell it.
        episode: int64 [N], the simulator's seed.
        scene_id: str [N].
    """

    pictures: npt.NDArray[np.uint8]
    picture_spans: npt.NDArray[np.int64]
    now_spans: npt.NDArray[np.int64]
    next_spans: npt.NDArray[np.int64]
    pictured: npt.NDArray[np.bool_]
    history: FloatArray
    route: FloatArray
    future: FloatArray
    plan_bins: npt.NDArray[np.int8]
    tracks: FloatArray
    dense_classes: npt.NDArray[np.uint8]
    dense_range_log: npt.NDArray[np.float16]
    dense_motion: npt.NDArray[np.float16]
    facts: FloatArray
    thoughts: npt.NDArray[np.str_]
    perceived: FloatArray
    episode: npt.NDArray[np.int64]
    scene_id: npt.NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.history)

    def picture(self, index: int, camera: int, frame: int) -> bytes:
        """One encoded picture."""
        first, last = self.picture_spans[index, camera, frame]
        return self.pictures[first:last].tobytes()

    def now_picture(self, index: int, camera: str) -> bytes | None:
        """What a camera saw last, encoded; None where the scene has no clip of it."""
        first, last = self.now_spans[index, CAMERAS.index(camera)]
        return self.pictures[first:last].tobytes() or None

    def next_cameras(self, index: int) -> tuple[str, ...]:
        """The cameras whose picture half a second later is known."""
        first, last = self.next_spans[index].T
        return tuple(camera for camera, known in zip(CAMERAS, last > first, strict=True) if known)

    def next_picture(self, index: int, camera: str) -> bytes:
        """What one of `next_cameras` saw half a second later, encoded."""
        first, last = self.next_spans[index, CAMERAS.index(camera)]
        return self.pictures[first:last].tobytes()

    @cached_property
    def has_route(self) -> npt.NDArray[np.bool_]:
        """Which examples have a route, bool [N]."""
        return np.asarray(np.isfinite(self.route).all(axis=(1, 2)))

    def motion(self, index: int, *, mirror: bool, route: bool) -> tuple[FloatArray, FloatArray, bool]:
        """History [16, 4], route [20, 2], and whether it counts: where it is asked for, and known."""
        known = route and bool(self.has_route[index])
        history, way = self.history[index], np.nan_to_num(self.route[index])
        if mirror:
            history, way = history * POSE_MIRROR, way * POSE_MIRROR[:2]
        return history, way, known

    def tracks_given(self, index: int, *, mirror: bool, route: bool) -> FloatArray:
        """Tracks [16, features]; without a route, what they tell of it is left out."""
        tracks = self.tracks[index].copy() if route else without_route(self.tracks[index])
        if mirror:
            tracks[:, MIRRORED] *= -1
        return tracks

    def thought(self, index: int) -> Thoughts | None:
        """The expert's thoughts; None where they are not known."""
        text = str(self.thoughts[index])
        return read_thoughts(text) if text else None

    def perception(self, index: int) -> Perceived | None:
        """What there is to perceive; None where it is not known."""
        return perceived_of_row(self.perceived[index])

    def tell(self, part: LessonPart) -> npt.NDArray[np.bool_]:
        """Of which examples that part of a lesson is known, bool [N]."""
        if part == "thoughts":
            return np.asarray(self.thoughts != "")
        return np.asarray(~np.isnan(self.perceived[:, 0]))

    def plan(self, index: int) -> Plan:
        """The expert's plan."""
        return plan_from_bins(self.plan_bins[index])

    @classmethod
    def from_scenes(cls, scenes: Iterable[LabelledScene], cameras: Sequence[str]) -> Examples:
        """Gather scenes; every scene needs all ``cameras``, dense targets it may lack."""
        blob, spans_of = bytearray(), dict[bytes, tuple[int, int]]()

        def span(picture: bytes) -> tuple[int, int]:
            nonlocal blob
            if picture not in spans_of:
                spans_of[picture] = (len(blob), len(blob) + len(picture))
                blob += picture
            return spans_of[picture]

        columns: dict[str, list[Any]] = {field.name: [] for field in fields(cls)}
        for labelled in scenes:
            scene = labelled.scene
            spans = [span(picture) for camera in cameras for picture in scene.clip(camera).images]
            columns["picture_spans"].append(np.reshape(spans, (len(cameras), CLIP_FRAMES, 2)))
            later = {frame.camera: span(frame.image) for frame in labelled.next_frames}
            columns["pictured"].append(scene.has_pictures)
            now = {clip.camera: span(clip.images[-1]) for clip in scene.clips if scene.has_pictures}
            columns["now_spans"].append([now.get(camera, (0, 0)) for camera in CAMERAS])
            columns["next_spans"].append([later.get(camera, (0, 0)) for camera in CAMERAS])
            columns["history"].append(scene.history)
            columns["route"].append(
                np.full((20, 2), np.nan, np.float32) if scene.route is None else scene.route
            )
            columns["future"].append(labelled.future)
            columns["plan_bins"].append(expert_plan(labelled).bins())
            columns["tracks"].append(track_features(tracks_of(labelled.agents), scene.route))
            dense = {target.camera: coarse(target) for target in labelled.dense}
            cells = [dense.get(camera) or no_target(camera) for camera in cameras]
            columns["dense_classes"].append([target.classes for target in cells])
            columns["dense_range_log"].append(
                [np.log1p(np.minimum(target.range_m, DENSE_FAR_M)) for target in cells]
            )
            columns["dense_motion"].append([relative_motion(target, labelled) for target in cells])
            columns["facts"].append(scene_facts(labelled))
            columns["thoughts"].append(str(thoughts_of(labelled) or ""))
            perceived = perceived_of(labelled)
            columns["perceived"].append(_NOTHING_KNOWN if perceived is None else perceived.row())
            columns["episode"].append(labelled.seed)
            columns["scene_id"].append(scene.scene_id)
        types: dict[str, Any] = {
            "picture_spans": np.int64,
            "now_spans": np.int64,
            "next_spans": np.int64,
            "pictured": np.bool_,
            "plan_bins": np.int8,
            "dense_classes": np.uint8,
            "dense_range_log": np.float16,
            "dense_motion": np.float16,
            "episode": np.int64,
            "scene_id": np.str_,
            "thoughts": np.str_,
        }
        arrays = {
            name: np.asarray(values, types.get(name, np.float32))
            for name, values in columns.items()
            if name != "pictures"
        }
        return cls(pictures=np.frombuffer(bytes(blob), np.uint8), **arrays)

    @classmethod
    def concatenate(cls, parts: Sequence[Examples]) -> Examples:
        """Several sets of examples as one."""
        starts = np.cumsum([0, *(len(part.pictures) for part in parts)])[:-1]
        columns = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)
        }
        for name in ("picture_spans", "now_spans", "next_spans"):
            # Empty spans stay empty, wherever they lie.
            columns[name] = np.concatenate(
                [getattr(part, name) + start for part, start in zip(parts, starts, strict=True)]
            )
        return cls(**columns)


def _cache_name(file: Path, cameras: Sequence[str]) -> str:
    """Of two folders' files of one name, and of two choices of cameras, each has an entry of its own."""
    return f"{file.stem}-{hash_of(str(file.resolve()), *cameras)[:12]}.v{CACHE_VERSION}.npz"


def load_examples(scenes: Path, cache: Path, cameras: Sequence[str], workers: int = 2) -> Examples:
    """The examples of a scene file or folder, through the cache folder."""
    jobs = [(file, cache / _cache_name(file, cameras)) for file in scene_files(scenes)]
    stale = [
        (file, cached)
        for file, cached in jobs
        if not cached.exists() or cached.stat().st_mtime < file.stat().st_mtime
    ]
    cache.mkdir(parents=True, exist_ok=True)
    if stale:
        with ProcessPoolExecutor(min(workers, len(stale))) as pool:
            list(pool.map(_fill_cache, *zip(*[(*job, tuple(cameras)) for job in stale], strict=True)))
    parts = []
    for _, cached in jobs:
        with np.load(cached) as arrays:
            part = cast("dict[str, Any]", {field.name: arrays[field.name] for field in fields(Examples)})
        if len(part["history"]):
            parts.append(Examples(**part))
    return Examples.concatenate(parts)


def _fill_cache(file: Path, cached: Path, cameras: tuple[str, ...]) -> None:
    examples = Examples.from_scenes(read_scenes(file), cameras)
    with written_whole(cached) as temporary, temporary.open("wb") as content:
        np.savez(content, **{field.name: getattr(examples, field.name) for field in fields(Examples)})


def example_frames(
    examples: Examples, index: int, mirror: bool, inputs: InputBuilder, latest: int = CLIP_FRAMES
) -> npt.NDArray[np.uint8]:
    """An example's pictures in the network's size, or their mirror images.

    Returns:
        uint8 [cameras x ``latest``, h, w, 3], the oldest first.
    """
    cameras, count = examples.picture_spans.shape[1:3]
    frames = np.stack(
        [
            inputs.frame(examples.picture(index, camera, number))
            for camera in range(cameras)
            for number in range(count - latest, count)
        ]
    )
    return np.ascontiguousarray(frames[:, :, ::-1]) if mirror else frames
