"""Scenes: what a planner sees at one instant, and what a labelled scene knows besides."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.agents import AGENT_KINDS as AGENT_KINDS
from looktwice.model.driving.agents import LIGHTS as LIGHTS
from looktwice.model.driving.agents import TRACK_STEPS as TRACK_STEPS
from looktwice.model.driving.agents import Agent as Agent
from looktwice.model.driving.agents import AgentKind as AgentKind
from looktwice.model.driving.agents import Light as Light
from looktwice.model.driving.agents import SceneError as SceneError
from looktwice.model.driving.lane_map import LaneMap
from looktwice.model.driving.tracks import Track as Track
from looktwice.model.driving.tracks import check_tracks, tracks_of
from looktwice.model.driving.trajectory import (
    FloatArray,
    at_speed,
    check_history,
    check_route,
    check_trajectory,
)

FRONT_WIDE: Final = "front_wide_120"
FRONT_TELE: Final = "front_tele_30"
CAMERAS: Final = (
    FRONT_WIDE,
    FRONT_TELE,
    "front_left",
    "front",
    "front_right",
    "back_left",
    "back",
    "back_right",
)
"""Known cameras: the two of CF-VLA, then the six surround cameras of VLA-World."""
CLIP_FRAMES: Final = 4
CLIP_PERIOD_S: Final = 0.5

Tag = Literal["lead_vehicle", "cut_in", "pedestrian", "lane_change", "turn", "hard_brake"]
TAGS: Final[tuple[Tag, ...]] = (
    "lead_vehicle",
    "cut_in",
    "pedestrian",
    "lane_change",
    "turn",
    "hard_brake",
)

SemanticClass = Literal["sky", "off_road", "road", "vehicle", "pedestrian", "obstacle"]
SEMANTIC_CLASSES: Final[tuple[SemanticClass, ...]] = (
    "sky",
    "off_road",
    "road",
    "vehicle",
    "pedestrian",
    "obstacle",
)
"""What a pixel of a dense target shows; the position in this tuple is the stored value."""

NO_PICTURE: Final = bytes.fromhex(
    "89504e470d0a1a0a0000000d494844520000000100000001080000000"
    "03a7e9b550000000a49444154789c636000000002000148afa4710000000049454e44ae426082"
)
"""A PNG of one black pixel, in clips of cameras that nobody looked through."""

EGO_LENGTH_M: Final = 4.51
EGO_WIDTH_M: Final = 1.85


@dataclass(frozen=True)
class Clip:
    """Four encoded pictures (JPEG, PNG or WebP) of one camera at 2 Hz, oldest first."""

    camera: str
    images: tuple[bytes, ...] = field(repr=False)

    def __post_init__(self) -> None:
        if self.camera not in CAMERAS:
            raise SceneError(f"unknown camera {self.camera!r}; known are {', '.join(CAMERAS)}")
        if len(self.images) != CLIP_FRAMES:
            raise SceneError(f"camera {self.camera} must have {CLIP_FRAMES} frames, got {len(self.images)}")


@dataclass(frozen=True)
class NextFrame:
    """One encoded picture (JPEG, PNG or WebP): what a camera saw `CLIP_PERIOD_S` after the scene."""

    camera: str
    image: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if self.camera not in CAMERAS:
            raise SceneError(f"unknown camera {self.camera!r}; known are {', '.join(CAMERAS)}")


def mirrored_camera(camera: str) -> str:
    """The camera that sees in a mirror what ``camera`` sees: left and right are swapped."""
    sides = {"left": "right", "right": "left"}
    return "_".join(sides.get(part, part) for part in camera.split("_"))


@dataclass(frozen=True, eq=False)
class Scene:
    """One planning instant.

    Attributes:
        scene_id: the caller's name for it.
        clips: one clip per camera, at least one.
        history: float32 [16, 4] ego poses at 10 Hz, the last row is (0, 0, 0, 0).
        route: float32 [20, 2] points every 4 m along the way to go, or None.
        tracks: at most 16 tracked objects, the ego frame now; None where nobody tracks, empty where
            nobody is there.
    """

    scene_id: str
    clips: tuple[Clip, ...]
    history: FloatArray
    route: FloatArray | None = None
    tracks: tuple[Track, ...] | None = None

    def __post_init__(self) -> None:
        cameras = [clip.camera for clip in self.clips]
        if not cameras:
            raise SceneError("a scene needs at least one camera clip")
        if len(set(cameras)) != len(cameras):
            raise SceneError(f"a camera occurs twice: {', '.join(cameras)}")
        object.__setattr__(self, "history", check_history(self.history))
        if self.route is not None:
            object.__setattr__(self, "route", check_route(self.route))
        if self.tracks is not None:
            object.__setattr__(self, "tracks", check_tracks(self.tracks))

    def clip(self, camera: str) -> Clip:
        """The clip of ``camera``; raises `SceneError` where the scene has none."""
        for clip in self.clips:
            if clip.camera == camera:
                return clip
        raise SceneError(f"scene {self.scene_id} has no clip of camera {camera}")

    @property
    def pictures(self) -> tuple[bytes, ...]:
        """Those of all clips, encoded as they are."""
        return tuple(image for clip in self.clips for image in clip.images)

    @property
    def has_pictures(self) -> bool:
        """Whether somebody looked: not every picture is `NO_PICTURE`."""
        return any(picture != NO_PICTURE for picture in self.pictures)


@dataclass(frozen=True, eq=False)
class LaneTrace:
    """Which lane the ego was and will be in, at 10 Hz; row 15 is now.

    Attributes:
        road: int32 [80] id of the road segment within the episode, -1 where unknown.
        lane: int16 [80] lane number on that segment, 0 is the leftmost; -1 where unknown.
        offset_m: float32 [80] distance of the ego to the left of the lane's centre line.
    """

    road: npt.NDArray[np.int32]
    lane: npt.NDArray[np.int16]
    offset_m: FloatArray

    def __post_init__(self) -> None:
        for name in ("road", "lane", "offset_m"):
            if getattr(self, name).shape != (TRACK_STEPS,):
                raise SceneError(f"lane trace: {name} must have shape [80]")


@dataclass(frozen=True, eq=False)
class DenseTarget:
    """What a camera's latest picture shows, pixel by pixel, on a coarser grid.

    Attributes:
        camera: whose picture.
        classes: uint8 [h, w], positions in `SEMANTIC_CLASSES`.
        range_m: float32 [h, w], distance along the camera's axis; 0 where there is nothing (sky).
    """

    camera: str
    classes: npt.NDArray[np.uint8]
    range_m: FloatArray


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """A scene with its future and annotations, for training and evaluation.

    Attributes:
        scene: what a planner is given.
        episode_id: episodes are the unit of independence (bootstrap, splits).
        seed: the simulator's seed; it decides the split.
        future: float32 [64, 4], the expert's trajectory.
        agents: everything within reach, over past and future.
        drivable: closed rings, float32 [k, 2] each, ego frame; a point is on the road when an odd number
            of rings contains it (holes are rings too).
        lane_lines: centre lines of the lanes around, float32 [k, 2] each.
        lane_trace: the ego's lanes over time, or None where unknown.
        tags: what makes the scene difficult.
        dense: per-pixel targets of the latest pictures; may be empty.
        lane_map: what NAVSIM's scores ask of the map; None where nobody knows.
        next_frames: what its cameras, or others, saw half a second later; may be empty.
    """

    scene: Scene
    episode_id: str
    seed: int
    future: FloatArray
    agents: tuple[Agent, ...] = ()
    drivable: tuple[FloatArray, ...] = ()
    lane_lines: tuple[FloatArray, ...] = ()
    lane_trace: LaneTrace | None = None
    tags: frozenset[Tag] = frozenset()
    dense: tuple[DenseTarget, ...] = ()
    lane_map: LaneMap | None = None
    next_frames: tuple[NextFrame, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "future", check_trajectory(self.future))
        cameras = [frame.camera for frame in self.next_frames]
        if len(set(cameras)) != len(cameras):
            raise SceneError(f"a camera has two next frames: {', '.join(cameras)}")
        unknown = set(self.tags) - set(TAGS)
        if unknown:
            raise SceneError(f"unknown tags: {', '.join(sorted(unknown))}")

    def given(self, *, route: bool, tracks: bool = False) -> Scene:
        """The scene as a planner is given it.

        Args:
            route: with its route, where it has one; without it otherwise.
            tracks: with what a perfect tracker would tell of the agents; without any tracks otherwise.
        """
        return replace(
            self.scene,
            route=self.scene.route if route else None,
            tracks=tracks_of(self.agents) if tracks else None,
        )

    def at_speed(self, times: float) -> LabelledScene:
        """The same scene for an ego that came the same way at so many times its speed."""
        return replace(self, scene=replace(self.scene, history=at_speed(self.scene.history, times)))

    @property
    def split(self) -> Literal["train", "validation", "test"]:
        """By simulator seed: train < 500000 <= validation < 600000 <= test < 700000."""
        return split_of_seed(self.seed)


def split_of_seed(seed: int) -> Literal["train", "validation", "test"]:
    """The split a simulator seed belongs to; raises `SceneError` for seeds that are held back."""
    if not 0 <= seed < 700_000:
        raise SceneError(f"seed {seed} is not in use: seeds lie in 0..699999")
    if seed < 500_000:
        return "train"
    return "validation" if seed < 600_000 else "test"
