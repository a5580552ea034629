"""Labelled scenes cut out of an episode."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import shapely
import shapely.affinity

from looktwice.clients.metadrive.drawing.rig import RenderedPicture, Rig
from looktwice.clients.metadrive.drawing.stage import Stage
from looktwice.clients.metadrive.scenes.annotate import Tagger, dense_target, route_ahead, to_ego
from looktwice.clients.metadrive.scenes.lane_maps import LaneMaps
from looktwice.clients.metadrive.world.episode_log import EpisodeLog, lights_on
from looktwice.clients.metadrive.world.roads import Array
from looktwice.model.driving.cameras import FRONT_CAMERAS, CameraSpec
from looktwice.model.driving.lane_map import LaneMap
from looktwice.model.driving.metrics import collides, leaves_road
from looktwice.model.driving.scene import (
    CLIP_FRAMES,
    CLIP_PERIOD_S,
    NO_PICTURE,
    Agent,
    Clip,
    DenseTarget,
    LabelledScene,
    LaneTrace,
    NextFrame,
    Scene,
    Tag,
)
from looktwice.model.driving.trajectory import FUTURE_STEPS, HISTORY_STEPS, STEP_S, FloatArray, to_ego_frame

PICTURE_STEPS: Final = round(CLIP_PERIOD_S / STEP_S)
AGENT_REACH_M: Final = 80.0
ROAD_REACH_M: Final = 165.0
"""Beyond what can be driven in 6.4 s at 80 km/h."""
LANE_REACH_M: Final = 80.0
_LANE_POINT_STEP: Final = 3
_SIMPLIFY_M: Final = 0.06


def window_steps(log: EpisodeLog, stride_s: float) -> range:
    """The steps with a whole past and a whole future; a collision at the end is in nobody's future."""
    first = HISTORY_STEPS - 1
    last = len(log.ego) - FUTURE_STEPS - (1 if log.outcome != "collision" else 10)
    return range(first, max(last, first), stride_steps(stride_s))


def stride_steps(stride_s: float) -> int:
    """Steps from scene to scene: whole pictures, and at least one."""
    return max(PICTURE_STEPS, round(stride_s / STEP_S / PICTURE_STEPS) * PICTURE_STEPS)


def labelled_scenes(
    log: EpisodeLog, rig: Rig, stride_s: float, with_dense: bool = True, *, with_next: bool = False
) -> Iterator[LabelledScene]:
    """Render and annotate the windows of ``log`` whose future does not collide, leave the road or stray.

    Args:
        log: the episode.
        rig: its cameras.
        stride_s: seconds from scene to scene.
        with_dense: also tell what each pixel shows.
        with_next: also tell what every camera sees half a second later.
    """
    moments = ((step, _Moment(log, step)) for step in window_steps(log, stride_s))
    usable = [(step, moment) for step, moment in moments if moment.is_safe]
    if not usable:
        return
    stage = Stage(log, rig)
    tagger = Tagger(log)
    lane_maps = LaneMaps(log)
    shots: dict[int, list[RenderedPicture]] = {}
    try:
        for step, moment in usable:
            wanted = [step - PICTURE_STEPS * k for k in reversed(range(CLIP_FRAMES))]
            later = [step + PICTURE_STEPS] if with_next else []
            for at in (*wanted, *later):
                if at not in shots:
                    shots[at] = stage.shoot(at)
            for old in [at for at in shots if at < wanted[0]]:
                del shots[old]
            clips = tuple(
                Clip(spec.name, tuple(shots[at][index].jpeg for at in wanted))
                for index, spec in enumerate(rig.specs)
            )
            dense: tuple[DenseTarget, ...] = ()
            if with_dense:
                dense = tuple(
                    dense_target(spec, picture.depth_m, log, step, moment.area)
                    for spec, picture in zip(rig.specs, shots[step], strict=True)
                )
            next_frames = tuple(NextFrame(each.camera, each.jpeg) for at in later for each in shots[at])
            yield moment.labelled(clips, tagger.tags(step), lane_maps.at(step), dense, next_frames)
    finally:
        stage.close()


def unpictured_scenes(log: EpisodeLog, stride_s: float) -> Iterator[LabelledScene]:
    """As `labelled_scenes`, without pictures: nothing is rendered."""
    lane_maps, clips = LaneMaps(log), blank_clips(FRONT_CAMERAS)
    for step in window_steps(log, stride_s):
        labelled = labelled_scene(log, step, clips, lane_maps.at(step))
        if labelled is not None:
            yield labelled


def blank_clips(cameras: Sequence[CameraSpec]) -> tuple[Clip, ...]:
    """Clips of cameras that nobody looked through."""
    return tuple(Clip(spec.name, (NO_PICTURE,) * CLIP_FRAMES) for spec in cameras)


def labelled_scene(
    log: EpisodeLog, step: int, clips: tuple[Clip, ...], lane_map: LaneMap
) -> LabelledScene | None:
    """The moment at ``step`` with what happened around it, without dense targets.

    Args:
        log: with at least 1.6 s before the step and 6.4 s behind it.
        step: whose scene is wanted.
        clips: what was seen then.
        lane_map: of that moment.

    Returns:
        None where the future collides, leaves the road or strays.
    """
    moment = _Moment(log, step)
    return moment.labelled(clips, Tagger(log).tags(step), lane_map) if moment.is_safe else None


def taught_scene(log: EpisodeLog, step: int, clips: tuple[Clip, ...], future: FloatArray) -> LabelledScene:
    """The moment at ``step`` of an episode that still goes on, with a future [64, 4] that somebody plans.

    What the others will do is not known yet, and the road is left out: such a scene tells who is around now,
    and teaches what to do about them. Nothing can be scored in it.
    """
    name = f"{log.seed:06d}"
    scene = Scene(f"{name}-{step:04d}", clips, history_at(log, step), route_ahead(log, step))
    return LabelledScene(scene, name, log.seed, future, tuple(_agents_until(log, step)))


def _agents_until(log: EpisodeLog, step: int) -> Iterator[Agent]:
    ego, past = log.ego[step], slice(step - HISTORY_STEPS + 1, step + 1)
    for actor in log.actors:
        track = actor.poses[past]
        if not math.hypot(*(track[-1, :2] - ego[:2])) < AGENT_REACH_M:
            continue
        poses = np.full((HISTORY_STEPS + FUTURE_STEPS, 3), np.nan)
        poses[:HISTORY_STEPS, :2], poses[:HISTORY_STEPS, 2] = to_ego(track[:, :2], ego), track[:, 2] - ego[2]
        lights = lights_on(int(actor.lights[step]))
        yield Agent(actor.actor_id, actor.kind, *actor.size, poses.astype(np.float32), lights)


def history_at(log: EpisodeLog, step: int) -> FloatArray:
    """The ego's last 1.6 s at ``step``, float32 [16, 4]."""
    return _seen_from(log.ego[step - HISTORY_STEPS + 1 : step + 1], HISTORY_STEPS - 1)


def _seen_from(track: Array, present: int) -> FloatArray:
    """A track of the ego (x, y, heading, speed) as poses [t, 4], seen from the one at ``present``."""
    poses = np.zeros((len(track), 4))
    poses[:, :2], poses[:, 3] = track[:, :2], track[:, 2]
    seen = to_ego_frame(poses, poses[present])
    seen[:, 3] = np.unwrap(seen[:, 3])
    seen[:, 3] -= seen[present, 3]
    return seen.astype(np.float32)


class _Moment:
    """One step of an episode seen from the ego."""

    def __init__(self, log: EpisodeLog, step: int) -> None:
        self._log, self._step = log, step
        self._window = slice(step - HISTORY_STEPS + 1, step + FUTURE_STEPS + 1)
        self._ego = log.ego[step]
        seen = _seen_from(log.ego[self._window], HISTORY_STEPS - 1)
        self.history = seen[:HISTORY_STEPS]
        self.future = seen[HISTORY_STEPS:]
        self.area = self._area()
        self.drivable = _rings(self.area)
        self.agents = tuple(self._agents())

    @property
    def is_safe(self) -> bool:
        """Whether the expert's future neither strays nor collides nor leaves the road."""
        if self._log.strays[self._window][HISTORY_STEPS:].any():
            return False
        future = self.future[None]
        return not (collides(future, self.agents, 6.4)[0] or leaves_road(future, self.drivable)[0])

    def labelled(
        self,
        clips: tuple[Clip, ...],
        tags: frozenset[Tag],
        lane_map: LaneMap,
        dense: tuple[DenseTarget, ...] = (),
        next_frames: tuple[NextFrame, ...] = (),
    ) -> LabelledScene:
        """All that is known of the moment."""
        name = f"{self._log.seed:06d}"
        return LabelledScene(
            Scene(f"{name}-{self._step:04d}", clips, self.history, route_ahead(self._log, self._step)),
            name,
            self._log.seed,
            self.future,
            self.agents,
            self.drivable,
            self._lane_lines(),
            self._lane_trace(),
            tags,
            dense,
            lane_map,
            next_frames,
        )

    def _area(self) -> Any:
        x, y, heading, _ = self._ego
        near = shapely.clip_by_rect(
            self._log.road_map.drivable,
            x - ROAD_REACH_M,
            y - ROAD_REACH_M,
            x + ROAD_REACH_M,
            y + ROAD_REACH_M,
        )
        cos, sin = np.cos(heading), np.sin(heading)
        matrix = [cos, sin, -sin, cos, -cos * x - sin * y, sin * x - cos * y]
        return shapely.affinity.affine_transform(near, matrix).simplify(_SIMPLIFY_M)

    def _agents(self) -> Iterator[Agent]:
        ego = self._log.ego[self._window, :2]
        for actor in self._log.actors:
            track = actor.poses[self._window]
            there = np.isfinite(track[:, 0])
            if not there.any() or np.hypot(*(track[there, :2] - ego[there]).T).min() > AGENT_REACH_M:
                continue
            poses = np.full(track.shape, np.nan)
            poses[there, :2] = to_ego(track[there, :2], self._ego)
            poses[there, 2] = np.unwrap(track[there, 2] - self._ego[2])
            lights = lights_on(int(actor.lights[self._step]))
            yield Agent(actor.actor_id, actor.kind, *actor.size, poses.astype(np.float32), lights)

    def _lane_lines(self) -> tuple[FloatArray, ...]:
        lines = []
        for lane in self._log.road_map.lanes:
            points = np.concatenate([lane.centre[::_LANE_POINT_STEP], lane.centre[-1:]])
            seen = to_ego(points, self._ego)
            seen = seen[np.hypot(seen[:, 0], seen[:, 1]) < LANE_REACH_M]
            if len(seen) >= 2:
                lines.append(seen.astype(np.float32))
        return tuple(lines)

    def _lane_trace(self) -> LaneTrace:
        lanes = [self._log.road_map.lanes[lane] for lane in self._log.lanes[self._window]]
        return LaneTrace(
            np.array([lane.road for lane in lanes], np.int32),
            np.array([lane.number for lane in lanes], np.int16),
            self._log.lane_offsets[self._window].astype(np.float32),
        )


def _rings(area: Any) -> tuple[FloatArray, ...]:
    rings = []
    for part in getattr(area, "geoms", [area]):
        if part.geom_type == "Polygon" and not part.is_empty:
            rings += [part.exterior, *part.interiors]
    return tuple(np.asarray(ring.coords, np.float32) for ring in rings)
