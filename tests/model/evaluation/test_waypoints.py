from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.trajectory import TEN_HZ_S, THREE_SECONDS_S
from looktwice.model.evaluation.waypoints import WaypointScene, action_scores, waypoints_of
from looktwice.model.families.family import Actions
from tests.model.driving.drives import agent, labelled_scene


def test_a_scenes_figures_are_means_over_its_draws() -> None:
    labelled = labelled_scene(10.0)
    expert = waypoints_of(labelled.future, TEN_HZ_S)
    away_m = np.arange(1.0, 7.0)[:, None] * [0.0, 1.0]
    # One draw is the expert's, the other goes aside by a metre more at each waypoint.
    told = WaypointScene(labelled).measured(np.stack([expert, expert + away_m]))
    uniad, st_p3 = told["UniAD"], told["ST-P3"]
    assert (uniad.l2_1s_m, uniad.l2_2s_m, uniad.l2_3s_m) == pytest.approx((1.0, 2.0, 3.0))
    assert (st_p3.l2_1s_m, st_p3.l2_2s_m, st_p3.l2_3s_m) == pytest.approx((0.75, 1.25, 1.75))
    assert (uniad.l2_m, st_p3.l2_m) == pytest.approx((2.0, 1.25))
    assert (uniad.scene_id, uniad.episode_id) == (labelled.scene.scene_id, labelled.episode_id)


def test_pedestrians_collide_by_one_protocol_alone() -> None:
    labelled = labelled_scene(10.0, agents=(agent(20.0, 8.0, kind="pedestrian"),))
    told = WaypointScene(labelled).measured(np.full((1, 6, 2), (20.0, 8.0)))
    assert told["ST-P3"].collision_rate == 1.0
    assert told["UniAD"].collision_rate == 0.0


def test_short_trajectories_have_no_last_waypoint() -> None:
    with pytest.raises(ValueError, match="no waypoint at 3 s"):
        waypoints_of(np.zeros((5, 4), np.float32), THREE_SECONDS_S[:5])


def test_actions_are_scored_word_by_word() -> None:
    scenes = [
        replace(labelled_scene(speed, scene_id=str(speed), episode_id=f"e{speed % 2}"), seed=int(speed))
        for speed in (1.0, 2.0, 3.0, 14.0)
    ]
    actions = Actions((("slow", "fast", "back"),), lambda way: ("slow" if way[9, 0] < 5 else "fast",))
    said = {
        "1.0": [("slow",), ("slow",)],
        "2.0": [("slow",), ("fast",)],
        "3.0": [("fast",), ("fast",)],
        "14.0": [("fast",), ("fast",)],
    }
    slow, fast, back = action_scores(actions, scenes, said)
    assert (slow.action, slow.true, slow.said, slow.both) == ("slow", 6, 3, 3)
    assert slow.f1 == pytest.approx(2 * 3 / (6 + 3))
    assert (fast.true, fast.said, fast.both) == (2, 5, 2)
    assert fast.f1 == pytest.approx(2 * 2 / 7)
    assert slow.f1 is not None
    assert slow.interval is not None
    assert slow.interval[0] <= slow.f1 <= slow.interval[1]
    # Nobody does it and nobody says so.
    assert (back.f1, back.interval) == (None, None)
