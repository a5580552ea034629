"""Scenes, what is known about them, and plans, as `looktwice.clients.wire` carries them."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from looktwice.clients import wire
from looktwice.model.driving.plan import GROUPS, TICKS, MetaAction, Plan, PlanError
from looktwice.model.driving.scene import Agent, Scene, Track


def wire_scene(scene: Scene, decimals: int | None = None) -> wire.Scene:
    """A scene; numbers rounded to so many ``decimals``, or as they are."""
    return wire.Scene(
        scene_id=scene.scene_id,
        clips=[
            wire.Clip(
                camera=cast(wire.Camera, clip.camera),
                images=[base64.b64encode(image).decode() for image in clip.images],
            )
            for clip in scene.clips
        ],
        history=rows(scene.history, decimals),
        route=None if scene.route is None else rows(scene.route, decimals),
        tracks=None if scene.tracks is None else wire_tracks(scene.tracks, decimals),
    )


def wire_tracks(tracks: Sequence[Track], decimals: int | None = None) -> list[wire.Track]:
    """Tracks of objects; numbers rounded to so many ``decimals``, or as they are."""
    return [
        wire.Track(
            **{
                name: value if decimals is None else round(value, decimals)
                for name in ("x_m", "y_m", "heading_rad", "speed_ms", "length_m", "width_m")
                for value in (getattr(track, name),)
            },
            kind=track.kind,
            lights=sorted(track.lights),
        )
        for track in tracks
    ]


def wire_plan(plan: Plan) -> wire.Plan:
    """A plan, in both its forms."""
    tracks = {
        group: [
            wire.MetaAction(start_s=action.start / 10, end_s=action.end / 10, word=action.word)
            for action in track
        ]
        for group, track in plan.tracks()
    }
    return wire.Plan(text=str(plan), tracks=wire.Tracks(**tracks))


def plan_of_tracks(tracks: wire.Tracks) -> Plan:
    """The plan that ``tracks`` tell; raises `PlanError`."""
    told = {
        group: tuple(MetaAction(_tick(action.start_s), _tick(action.end_s), action.word) for action in track)
        for group in GROUPS
        if (track := getattr(tracks, group)) is not None
    }
    if not told:
        raise PlanError("the plan has no tracks")
    return Plan(**told)


def with_pictures(document: Any, change: Callable[[Any], Any]) -> Any:
    """A request's document with ``change`` made to every picture; what is no picture is as it was."""
    if isinstance(document, dict):
        return {
            key: [change(picture) for picture in value]
            if key == "images" and isinstance(value, list)
            else with_pictures(value, change)
            for key, value in document.items()
        }
    if isinstance(document, list):
        return [with_pictures(value, change) for value in document]
    return document


def wire_agents(agents: Sequence[Agent], decimals: int | None = None) -> list[wire.Agent]:
    """Agents; poses are null where they are absent."""
    return [
        wire.Agent(
            agent_id=agent.agent_id,
            kind=agent.kind,
            length_m=agent.length_m,
            width_m=agent.width_m,
            poses=[row if np.isfinite(row).all() else None for row in rows(agent.poses, decimals)],
            lights=sorted(agent.lights),
        )
        for agent in agents
    ]


def rows(array: npt.NDArray[np.floating], decimals: int | None = None) -> list[list[float]]:
    """A table of numbers as lists."""
    values = array.astype(float)
    return cast("list[list[float]]", (values if decimals is None else values.round(decimals)).tolist())


def _tick(seconds: float) -> int:
    tick = round(10 * seconds) if abs(seconds) <= 10 * TICKS else -1
    if abs(10 * seconds - tick) > 1e-6:
        raise PlanError(f"{seconds} s is not on the 0.1 s grid")
    return tick
