from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.lane_map import LaneArea, LaneMap
from looktwice.model.driving.pdm.labelled import plans_of, states_of
from looktwice.model.driving.pdm.scoring import (
    COLLISIONS,
    DIRECTION,
    EXTENDED_COMFORT,
    LANE_KEEPING,
    LIGHTS,
    PROGRESS,
)
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.evaluation.open_loop import EXPERT
from looktwice.model.evaluation.scores import SceneScore, ScoreRow, by_scene, expert_path, score_table
from tests.model.driving.drives import MIDDLES_S, agent, labelled_scene, rectangle

LANE_MAP = LaneMap(
    (
        LaneArea(1, rectangle(-50, -1.75, 150, 1.75), True),
        LaneArea(2, rectangle(-50, 1.75, 150, 5.25), False),
    ),
    (),
    np.array([[-20.0, 0.0], [140.0, 0.0]]),
    has_lights=False,
)


def braking_for_a_wall(name: str, episode: str) -> LabelledScene:
    """The expert brakes from 10 m/s for a car that stands 25 m ahead; constant velocity hits it."""
    speed = np.clip(10.0 - 2.4 * np.clip(MIDDLES_S, 0, None), 0, None)
    scene = labelled_scene(speed, scene_id=name, episode_id=episode, agents=(agent(32, 0),))
    return replace(scene, lane_map=LANE_MAP)


def cruising(name: str, episode: str) -> LabelledScene:
    return replace(labelled_scene(10.0, scene_id=name, episode_id=episode), lane_map=LANE_MAP)


def test_the_expert_comes_before_constant_velocity_and_nothing_is_missing() -> None:
    scenes = [braking_for_a_wall("a-0015", "a"), cruising("b-0015", "b")]
    table = score_table(scenes, {})
    rows = {row.name: row for row in table.rows["v2.2"]}
    expert, constant = rows[EXPERT], rows["constant velocity"]
    assert expert.missing == constant.missing == {}
    assert expert.sub_scores[COLLISIONS] == 1
    assert constant.sub_scores[COLLISIONS] == 0.5
    assert expert.score is not None
    assert constant.score is not None
    assert expert.score > constant.score
    assert constant.score == pytest.approx(0.5, abs=0.01)
    low, high = constant.intervals["score"]
    assert low == pytest.approx(0, abs=0.01)
    assert high == pytest.approx(1, abs=0.01)
    assert (expert.scenes, expert.episodes, table.without_lights) == (2, 2, 2)
    assert {row.sub_scores.get(LIGHTS, 1.0) for row in rows.values()} == {1.0}


def test_scenes_without_a_lane_map_are_partial_by_name() -> None:
    bare = [replace(cruising("a-0015", "a"), lane_map=None), cruising("b-0015", "b")]
    table = score_table(bare, {})
    row = table.rows["v2.2"][0]
    assert row.score is None
    assert "score" not in row.intervals
    assert row.partial_score == pytest.approx(1)
    assert row.missing == {DIRECTION: 1, LIGHTS: 1, LANE_KEEPING: 1}
    assert table.rows["v1.1"][0].score == pytest.approx(1)
    told = table.to_json()
    assert told["epdms"][0]["missing"][LIGHTS] == 1
    assert told["epdms"][0]["score"] is None
    assert told["scenes_without_lights"] == 1
    assert "* expert is partial: driving_direction_compliance is missing in 1 scenes" in str(table)
    assert "1.000*" in str(table)


def shifted(labelled: LabelledScene, left_m: float) -> FloatArray:
    moved = labelled.future.copy()
    moved[:, 1] += left_m * np.clip(np.arange(64) / 15, 0, 1)
    return moved


def test_extended_comfort_of_known_trajectories_needs_the_scene_before() -> None:
    scenes = [cruising("a-0015", "a"), cruising("a-0020", "a"), cruising("b-0025", "b")]
    same = {scene.scene.scene_id: scene.future for scene in scenes}
    (row,) = (row for row in score_table(scenes, {"kept": by_scene(scenes, same)}).rows["v2.2"][-1:])
    assert row.missing == {EXTENDED_COMFORT: 2}
    assert row.sub_scores[EXTENDED_COMFORT] == 1
    swerving = same | {"a-0015": shifted(scenes[0], 3.0)}
    (row,) = (row for row in score_table(scenes, {"swerves": by_scene(scenes, swerving)}).rows["v2.2"][-1:])
    assert row.sub_scores[EXTENDED_COMFORT] == 0


def test_what_the_expert_fails_at_is_forgiven_on_request() -> None:
    scene = cruising("a-0015", "a")
    scene = replace(scene, future=shifted(scene, 3.4))
    strict, kind = (score_table([scene], {}, forgive=forgive).rows["v2.2"][0] for forgive in (False, True))
    assert strict.sub_scores[LANE_KEEPING] == 0
    assert kind.sub_scores[LANE_KEEPING] == 1
    assert strict.sub_scores[PROGRESS] == 1


def test_the_experts_earlier_plan_is_what_it_drove() -> None:
    scene = labelled_scene(10.0 + 0.5 * MIDDLES_S)
    trajectory, before = expert_path(scene)
    assert before is not None
    now = states_of(scene.scene.history, plans_of(trajectory))
    # In the frame of half a second ago the same moment lies as much farther as was driven since.
    apart = before[5:, 0] - now[:36, 0]
    assert apart == pytest.approx(np.full(36, -float(scene.scene.history[10, 0])), abs=0.2)


def test_rows_are_means_over_scenes_and_need_some() -> None:
    names = dict.fromkeys(("no_at_fault_collisions", "drivable_area_compliance"), 1.0)
    subs = {**names, PROGRESS: 0.5, "time_to_collision": 1.0, "comfort": None}
    scores = [
        SceneScore("1", "a", subs, None, 0.75),
        SceneScore("2", "b", {**subs, "comfort": 1.0}, 0.8, 0.8),
    ]
    row = ScoreRow.of("x", "v1.1", scores)
    assert row.score is None
    assert row.partial_score == pytest.approx(0.775)
    assert row.sub_scores["comfort"] == 1
    assert row.missing == {"comfort": 1}
    with pytest.raises(ValueError, match="x: there are no scenes"):
        ScoreRow.of("x", "v1.1", [])
