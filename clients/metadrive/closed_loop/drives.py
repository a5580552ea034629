"""Closed loop: a car in the simulator that drives by somebody's trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from looktwice.clients.metadrive.closed_loop.pilots import Pilot, Planned
from looktwice.clients.metadrive.drawing.rig import RenderedPicture, Rig
from looktwice.clients.metadrive.drawing.stage import Stage
from looktwice.clients.metadrive.result_store import ResultStore
from looktwice.clients.metadrive.scenes.annotate import route_ahead
from looktwice.clients.metadrive.scenes.simulated_tracks import tracks_at
from looktwice.clients.metadrive.scenes.windows import PICTURE_STEPS, blank_clips, history_at
from looktwice.clients.metadrive.world.actors import STEP_S, Body
from looktwice.clients.metadrive.world.episode import EpisodeWorld, make_world
from looktwice.clients.metadrive.world.episode_log import EpisodeLog
from looktwice.clients.metadrive.world.fork import kind_of
from looktwice.clients.metadrive.world.hazards import USUAL, HazardMix
from looktwice.clients.metadrive.world.roads import Array
from looktwice.clients.metadrive.world.tracking import FreeVehicle, world_trajectory
from looktwice.model.driving.cameras import FRONT_CAMERAS, CameraSpec
from looktwice.model.driving.scene import CLIP_FRAMES, Clip, Scene

TAKE_OVER: Final = PICTURE_STEPS * (CLIP_FRAMES - 1)
"""The expert drives so many steps, until there are clips and a history."""
EXPERT: Final = "expert"
LOST_STEPS: Final = 20
"""Off the road for two seconds, an episode ends."""

Ended = Literal["time", "route_end", "collision", "off_road"]


@dataclass(frozen=True)
class DriveConfig:
    """How an episode is driven.

    Attributes:
        duration_s: at most.
        replan_s: seconds between plans, a multiple of 0.5.
        hazards: that wait along the route.
    """

    duration_s: float = 30.0
    replan_s: float = 0.5
    hazards: HazardMix = USUAL


@dataclass(frozen=True)
class Drive:
    """How an episode went for a driver.

    Attributes:
        seed: of the episode.
        ended: how it ended.
        driven_m: along the route, from where the driver took over.
        hit: what it collided with, if it did.
        off_road: whether it ever left the road.
        jerk_ms3: 95th percentile of the absolute jerk along the way.
        lateral_ms2: 95th percentile of the absolute sideways acceleration.
        plans, thought, late: how many plans were made, the share of draws that thought, plans that came
            behind their deadline.
        milliseconds: that plans took, in the middle.
    """

    seed: int
    ended: Ended
    driven_m: float
    off_road: bool
    jerk_ms3: float
    lateral_ms2: float
    plans: int = 0
    thought: float | None = None
    late: int = 0
    milliseconds: float | None = None
    hit: str | None = None


@dataclass(frozen=True, eq=False)
class Shot:
    """A moment for a film: what was seen, and what is to be done."""

    driver: str
    log: EpisodeLog
    step: int
    pictures: Sequence[RenderedPicture]
    planned: Planned | None


@dataclass
class _Plans:
    made: list[Planned] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        if not self.made:
            return {}
        rates = [planned.think_rate for planned in self.made if planned.think_rate is not None]
        return {
            "plans": len(self.made),
            "thought": float(np.mean(rates)) if rates else None,
            "late": sum(planned.late for planned in self.made),
            "milliseconds": float(np.median([planned.milliseconds for planned in self.made])),
        }


def drive(
    seed: int,
    pilot: Pilot | None,
    rig: Rig | None,
    config: DriveConfig = DriveConfig(),
    on_shot: Callable[[Shot], None] | None = None,
    on_plan: Callable[[EpisodeWorld, Scene], None] | None = None,
    look: bool = False,
) -> Drive:
    """Drive one episode; the world around is the same for every driver until it has to react to it.

    Args:
        seed: of the episode.
        pilot: who plans; None for the expert.
        rig: of cameras; None where nobody looks. Rendering is what takes the time.
        config: see there.
        on_shot: told every moment with pictures.
        on_plan: told every moment at which the pilot plans, and what it sees then.
        look: take pictures although the pilot does without.

    Raises:
        MapError: no map fits the seed.
        PlannerError: the pilot's service does not answer.
    """
    world = make_world(seed, config.duration_s, hazards=config.hazards)
    stage = None
    if look or on_shot is not None or (pilot is not None and pilot.needs_pictures):
        if rig is None:
            raise ValueError("pictures are wanted, and there is no rig to take them")
        stage = Stage(world.live, rig)
    plans, shots = _Plans(), dict[int, list[RenderedPicture]]()
    way: Array | None = None
    planned_at, outside, left_road = 0, 0, False
    every = round(config.replan_s / STEP_S)
    try:
        near = world.remember()
        began_m = world.ego.progress
        while not world.ended and outside < LOST_STEPS:
            step = world.now
            if step % PICTURE_STEPS == 0 and stage is not None:
                shots[step] = stage.shoot(step)
            if step == TAKE_OVER:
                began_m = world.ego.progress
                if pilot is not None:
                    world.ego = FreeVehicle.from_rails(world.ego)
            if pilot is not None and step >= TAKE_OVER and (step - TAKE_OVER) % every == 0:
                scene = _scene(world, step, shots, FRONT_CAMERAS if rig is None else rig.specs)
                if on_plan is not None:
                    on_plan(world, scene)
                plans.made.append(pilot.plan(scene))
                way = world_trajectory(world.live.ego[step], plans.made[-1].trajectory)
                planned_at = step
            if step >= TAKE_OVER and world.is_off_road:
                left_road = True
                # The expert is on rails: it finds back.
                outside += pilot is not None
            else:
                outside = 0
            if on_shot is not None and step in shots:
                name = EXPERT if pilot is None else pilot.name
                on_shot(Shot(name, world.live, step, shots[step], plans.made[-1] if plans.made else None))
            shots.pop(step - TAKE_OVER, None)
            world.move(near, _driver(world, way, (step - planned_at) * STEP_S))
            near = world.remember()
    finally:
        if stage is not None:
            stage.close()
    ended: Ended = "off_road" if outside >= LOST_STEPS else world.outcome
    return Drive(
        seed,
        ended,
        max(0.0, world.ego.progress - began_m),
        left_road,
        *_comfort(world.log().ego[TAKE_OVER:]),
        **plans.summary(),
        hit=None if world.hit is None else kind_of(world.hit),
    )


def _driver(world: EpisodeWorld, way: Array | None, age_s: float) -> Callable[[list[Body]], None]:
    ego = world.ego
    if way is None or not isinstance(ego, FreeVehicle):
        return world.drive_as_expert
    return lambda _: ego.follow(way, age_s, world.live.road_map)


def _scene(
    world: EpisodeWorld, step: int, shots: dict[int, list[RenderedPicture]], cameras: Sequence[CameraSpec]
) -> Scene:
    """What the car sees now; nothing of the world but through its cameras, its motion and its way."""
    times = [step - PICTURE_STEPS * k for k in reversed(range(CLIP_FRAMES))]
    clips = blank_clips(cameras)
    if shots:
        clips = tuple(
            Clip(spec.name, tuple(shots[at][index].jpeg for at in times))
            for index, spec in enumerate(cameras)
        )
    log = world.live
    name = f"{log.seed:06d}-{step:04d}"
    return Scene(name, clips, history_at(log, step), route_ahead(log, step), tracks_at(log, step))


def _comfort(ego: Array) -> tuple[float, float]:
    """95th percentiles of jerk and of sideways acceleration over a track (x, y, heading, speed)."""
    if len(ego) < 4:
        return 0.0, 0.0
    acceleration = np.diff(ego[:, 3]) / STEP_S
    turning = np.diff(np.unwrap(ego[:, 2])) / STEP_S
    sideways = np.abs(turning * ego[1:, 3])
    jerk = np.abs(np.diff(acceleration)) / STEP_S
    return float(np.percentile(jerk, 95)), float(np.percentile(sideways, 95))


def drive_store(file: Path) -> ResultStore[Drive]:
    """Drives of whole episodes."""
    return ResultStore(file, "drive", asdict, lambda told: Drive(**told))
