"""A recorded drive, whatever it was read from, and the scenes in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.cameras import CameraSpec
from looktwice.model.driving.scene import CLIP_FRAMES, CLIP_PERIOD_S, Clip, LabelledScene, Scene
from looktwice.model.driving.trajectory import (
    FUTURE_STEPS,
    HISTORY_STEPS,
    ROUTE_POINTS,
    ROUTE_SPACING_M,
    STEP_S,
    FloatArray,
    to_ego_frame,
)

_LONGEST_GAP_S: Final = 0.25
"""Between poses: over more nobody knows how the car moved."""

Array = npt.NDArray[np.float64]


class RecordingError(ValueError):
    """Files that are no recording; the text says what is missing."""


class Eye(Protocol):
    """What stands for one of the model's cameras."""

    @property
    def spec(self) -> CameraSpec:
        """The camera that it stands for."""

    def at(self, moment_s: float) -> bytes | None:
        """Its picture as JPEG; None where nothing was taken near that moment; raises `RecordingError`."""

    def doubts(self) -> list[str]:
        """What makes it unlike that camera, for people; raises `RecordingError`."""


@dataclass(frozen=True, eq=False)
class Recording:
    """A drive.

    Attributes:
        name: what its scenes are named after.
        times_s: [n], ascending.
        poses: [n, 4], x, y, z in m and heading in rad, unwrapped, in any frame that is fixed to the world.
        eyes: one for each camera of the model.
    """

    name: str
    times_s: Array
    poses: Array
    eyes: tuple[Eye, ...]

    def at(self, times_s: Array) -> Array:
        """Poses [k, 4] at times within the recording, between those that are known."""
        return np.stack([np.interp(times_s, self.times_s, column) for column in self.poses.T], axis=1)

    def doubts(self) -> list[str]:
        """What makes its pictures unlike those that the model knows, for people."""
        return [doubt for eye in self.eyes for doubt in eye.doubts()]

    def scenes(self, *, stride_s: float = 0.5, route: bool = False) -> Iterator[LabelledScene]:
        """A scene every so often, wherever there are pictures, 1.5 s of past and 6.4 s of future.

        Args:
            stride_s: seconds from scene to scene.
            route: take the way that was driven for the route, where 80 m of it are known.
        """
        first_s, last_s = self.times_s[0], self.times_s[-1]
        now_s = first_s + (HISTORY_STEPS - 1) * STEP_S
        while now_s + FUTURE_STEPS * STEP_S <= last_s:
            if (scene := self._scene(float(now_s), route=route)) is not None:
                yield scene
            now_s += stride_s

    def _scene(self, now_s: float, *, route: bool) -> LabelledScene | None:
        if not self._is_known(now_s - (HISTORY_STEPS - 1) * STEP_S, now_s + FUTURE_STEPS * STEP_S):
            return None
        clips = []
        for eye in self.eyes:
            moments = now_s + CLIP_PERIOD_S * np.arange(1 - CLIP_FRAMES, 1)
            pictures = [picture for moment in moments if (picture := eye.at(float(moment))) is not None]
            if len(pictures) < CLIP_FRAMES:
                return None
            clips.append(Clip(eye.spec.name, tuple(pictures)))
        steps = np.arange(1 - HISTORY_STEPS, FUTURE_STEPS + 1)
        world = self.at(np.asarray(now_s + STEP_S * steps, np.float64))
        moved = to_ego_frame(world, world[HISTORY_STEPS - 1]).astype(np.float32)
        way = self._way(now_s) if route else None
        scene = Scene(f"{self.name}-{now_s:.2f}", tuple(clips), moved[:HISTORY_STEPS], way)
        return LabelledScene(scene, self.name, seed=0, future=moved[HISTORY_STEPS:])

    def _is_known(self, begin_s: float, end_s: float) -> bool:
        """Whether no two poses that lie next to each other in this time, or just around it, are far apart."""
        first = max(int(np.searchsorted(self.times_s, begin_s, "right")) - 1, 0)
        last = int(np.searchsorted(self.times_s, end_s))
        return bool(np.diff(self.times_s[first : last + 1]).max() <= _LONGEST_GAP_S)

    def _way(self, now_s: float) -> FloatArray | None:
        """Points every 4 m along what was driven from now on, in the ego frame.

        None where the recording ends before, or does not know how the car moved.
        """
        times_s = np.concatenate([[now_s], self.times_s[self.times_s > now_s]])
        holes = np.flatnonzero(np.diff(times_s) > _LONGEST_GAP_S)
        ahead = self.at(times_s[: holes[0] + 1] if len(holes) else times_s)
        driven = to_ego_frame(ahead, ahead[0])[:, :2]
        along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(driven, axis=0), axis=1))])
        wanted_m = ROUTE_SPACING_M * np.arange(1, ROUTE_POINTS + 1)
        if along_m[-1] < wanted_m[-1]:
            return None
        return np.stack([np.interp(wanted_m, along_m, column) for column in driven.T], 1).astype(np.float32)
