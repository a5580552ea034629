from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from looktwice.model.driving.scene import Agent, LabelledScene
from looktwice.model.driving.view import Surroundings, View
from looktwice.model.driving.view import view_of as view_of_scene
from tests.service.scenes import labelled


def agent(x: float, y: float, *, speed: float = 0.0, kind: Any = "vehicle", number: int = 1) -> Agent:
    """Something that is at (x, y) now and moves along x at a speed over ground."""
    poses = np.zeros((80, 3), np.float32)
    poses[:, 0] = x + speed * 0.1 * (np.arange(80) - 15)
    poses[:, 1] = y
    return Agent(number, kind, 4.5, 1.9, 1.6, poses)


def scene(*agents: Agent, bend: float = 0.0) -> LabelledScene:
    """A road that goes straight on for 15 m and then bends by so much."""
    angles = np.where(np.arange(60) < 15, 0.0, bend)
    line = np.stack([np.cos(angles), np.sin(angles)], axis=1).cumsum(axis=0).astype(np.float32)
    made = labelled("made-up")
    return replace(made, scene=replace(made.scene, route=None), agents=agents, lane_lines=(line,))


def view_of(made: LabelledScene) -> View:
    return view_of_scene(made.scene, Surroundings.of(made))


def test_places_are_told_from_the_own_lane() -> None:
    view = view_of(
        scene(
            agent(30, 0.4, number=1),
            agent(12, 3.4, number=2),
            agent(14, -3.6, number=3),
            agent(18, -8.0, number=4),
        )
    )
    assert [sight.place for sight in view.sights] == [
        "the left lane",
        "the right lane",
        "the right side",
        "my lane",
    ]
    assert view.sights[-1].ahead_m == pytest.approx(30 - (4.51 + 4.5) / 2)


def test_the_own_lane_may_bend() -> None:
    view = view_of(scene(agent(15 + 20 * np.cos(0.5), 20 * np.sin(0.5)), bend=0.5))
    assert (view.bend, round(view.bend_m)) == ("left", 14)
    assert [sight.place for sight in view.sights] == ["my lane"]
    assert view_of(scene(bend=-0.5)).bend == "right"
    assert view_of(scene(bend=0.1)).bend is None


def test_the_way_to_go_is_the_own_lane_where_it_is_known() -> None:
    made = scene(agent(15 + 20 * np.cos(0.5), 20 * np.sin(0.5)))
    assert [sight.place for sight in view_of(made).sights] == ["the left side"]
    angles = np.where(np.arange(1, 21) * 4 < 15, 0.0, 0.5)
    route = (4 * np.stack([np.cos(angles), np.sin(angles)], axis=1)).cumsum(axis=0).astype(np.float32)
    view = view_of(replace(made, scene=replace(made.scene, route=route)))
    assert view.bend == "left"
    assert [sight.place for sight in view.sights] == ["my lane"]


def test_speeds_are_those_over_ground() -> None:
    assert view_of(scene(agent(20, 0, speed=7.0))).sights[0].speed_ms == pytest.approx(7.0, abs=1e-4)


def test_what_no_camera_shows_is_not_told() -> None:
    behind, beside, far = agent(-10, 0), agent(2.4, 20, number=2), agent(120, 0, number=3)
    small_and_far = agent(60, 1, kind="cone", number=4)
    assert view_of(scene(behind, beside, far, small_and_far)).sights == ()
    hidden = (agent(15, 0), agent(40, 0.2, kind="pedestrian", number=2))
    assert [sight.kind for sight in view_of(scene(*hidden)).sights] == ["vehicle"]


def test_the_future_changes_nothing() -> None:
    one = scene(agent(25, 0, speed=5.0), agent(20, 3.4, number=2), bend=0.4)
    moved = []
    for each in one.agents:
        poses = each.poses.copy()
        poses[16:] = np.nan
        moved.append(replace(each, poses=poses))
    later = replace(one, agents=tuple(moved), future=one.future * np.float32(0.5))
    assert view_of(later) == view_of(one)
