"""Plans that are followed: the expert's holds, and others fail at what they are made to fail at."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from looktwice.clients.metadrive.generation.blocks import GENERATOR_VERSION, GenerateConfig
from looktwice.clients.metadrive.outcomes.replayed_worlds import (
    EpisodeSetting,
    FollowTask,
    Moment,
    ReplayError,
    outcomes_of_episode,
    replayed,
    setting_of,
)
from looktwice.clients.metadrive.outcomes.verdicts import judged, outcomes_at
from looktwice.clients.metadrive.simulator import described
from looktwice.clients.metadrive.world.episode import EpisodeWorld
from looktwice.clients.metadrive.world.fork import Forked, fork_expert
from looktwice.model.driving.outcome import FailureName, Outcome
from looktwice.model.driving.scene_store import MANIFEST
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray, constant_velocity
from tests.clients.metadrive.conftest import DURATION_S, SEED, Filmed
from tests.clients.metadrive.test_fork import driven

SETTING = EpisodeSetting(DURATION_S, drifts=False, lapses=False)


def moments(filmed: Filmed) -> list[Moment]:
    return [Moment.of(labelled) for labelled in filmed.scenes]


def straight(speed_ms: float, sideways_ms: float = 0.0) -> FloatArray:
    trajectory = np.zeros((FUTURE_STEPS, 4), np.float32)
    trajectory[:, 0] = 0.1 * speed_ms * np.arange(1, FUTURE_STEPS + 1)
    trajectory[:, 1] = 0.1 * sideways_ms * np.arange(1, FUTURE_STEPS + 1)
    return trajectory


def test_the_expert_s_own_plans_hold_at_every_stored_scene(filmed: Filmed) -> None:
    asked = [FollowTask(moment, [moment.future]) for moment in moments(filmed)]
    found = dict(outcomes_of_episode(SEED, SETTING, asked))
    assert list(found) == [task.moment.scene_id for task in asked]
    for outcomes in found.values():
        assert not isinstance(outcomes, ReplayError)
        assert outcomes.expert.holds
        assert outcomes.plans[0].holds
        assert outcomes.plans[0].progress == pytest.approx(1.0, abs=0.1)


def test_plans_fail_at_what_they_do() -> None:
    world = driven(60)
    speed = float(world.live.ego[world.now, 3])
    brakes, aside, dashes = outcomes_at(
        world, [straight(0.0), straight(speed, sideways_ms=4.0), straight(2.0 * speed)]
    ).plans
    assert "behind" in brakes.fails
    assert brakes.behind_m > 5.0
    assert {"off_road", "off_route"} & set(aside.fails)
    assert dashes.fails
    assert not dashes.holds


def test_an_outcome_does_not_depend_on_the_other_plans() -> None:
    world = driven(60)
    plans = [straight(speed) for speed in (0.0, 8.0)]
    together = outcomes_at(world, plans).plans
    alone = tuple(outcomes_at(world, [plan]).plans[0] for plan in plans)
    assert together == alone


def test_where_a_plan_fails_the_first_other_trajectory_that_holds_is_found() -> None:
    world = driven(60)
    own = fork_expert(world).trajectory
    stands, aside = straight(0.0), straight(8.0, sideways_ms=4.0)
    found = outcomes_at(
        world,
        [stands, own, stands, stands],
        [[aside, own, own], [own], [aside], []],
    )
    assert found.better == (1, None, None, None)
    assert outcomes_at(world, [stands]).better == (None,), "nothing else was asked for"


def forked(**changed: Any) -> Forked:
    speeds_ms, log = np.full(FUTURE_STEPS, 10.0, np.float32), driven(0).log()
    steady = Forked(straight(10.0), speeds_ms, 64.0, None, None, None, None, log)
    return replace(steady, **changed)


def jerky() -> Forked:
    speeds = np.where(np.arange(FUTURE_STEPS) // 5 % 2, 8.0, 12.0).astype(np.float32)
    trajectory = straight(0.0)
    trajectory[:, 0] = 0.1 * np.cumsum(speeds)
    return forked(trajectory=trajectory, speeds_ms=speeds)


@pytest.mark.parametrize(
    ("followed", "expert_m", "fails"),
    [
        (forked(), 64.0, ()),
        (forked(), 79.0, ()),
        (forked(), 81.0, ("behind",)),
        (forked(driven_m=1.0), 5.5, ()),
        (forked(driven_m=1.0), 6.5, ("behind",)),
        (forked(), 52.0, ()),
        (forked(), 51.0, ("ahead",)),
        (forked(driven_m=4.5), 0.0, ()),
        (forked(driven_m=5.5), 0.0, ("ahead",)),
        (forked(driven_m=0.0), -7.5, ()),
        (forked(driven_m=-7.6), -7.5, ()),
        (forked(driven_m=-13.0), -7.5, ("behind",)),
        (forked(driven_m=5.5), -7.5, ("ahead",)),
        (forked(collided_s=2.1, hit="standing vehicle", driven_m=20.0), 64.0, ("collision",)),
        (forked(off_road_s=3.0, off_route_s=2.5), 64.0, ("off_road", "off_route")),
        (jerky(), 64.0, ("comfort",)),
    ],
)
def test_thresholds(followed: Forked, expert_m: float, fails: tuple[FailureName, ...]) -> None:
    outcome = judged(followed, expert_m, needs_comfort=True)
    assert outcome.fails == fails
    assert outcome.holds is (not fails)
    assert Outcome.from_json(json.loads(json.dumps(outcome.to_json()))) == outcome


def test_where_the_expert_is_not_comfortable_nobody_must_be() -> None:
    outcome = judged(jerky(), 64.0, needs_comfort=False)
    assert outcome.holds
    assert outcome.uncomfortable is not None
    assert outcome.uncomfortable_s is not None


def test_an_episode_made_again_is_the_stored_one_to_the_last_bit(filmed: Filmed) -> None:
    for moment, world in replayed(SEED, SETTING, moments(filmed)):
        assert isinstance(world, EpisodeWorld)
        np.testing.assert_array_equal(fork_expert(world).trajectory, moment.future)


def test_what_is_not_the_stored_scene_s_world_is_refused_by_name(filmed: Filmed) -> None:
    (first, *_) = moments(filmed)
    moved = replace(first, history=first.history + np.float32(0.1))
    elsewhere = replace(first, future=first.future * np.float32(1.1))
    late = replace(first, step=5000)
    for wrong, why in ((moved, "otherwise"), (elsewhere, "otherwise"), (late, "ended before")):
        ((name, refused),) = outcomes_of_episode(SEED, SETTING, [FollowTask(wrong, [])])
        assert name == first.scene_id
        assert isinstance(refused, ReplayError)
        assert why in str(refused)
        assert first.scene_id in str(refused)
    other = replace(SETTING, drifts=True)
    last = moments(filmed)[-1]
    task = FollowTask(last, [constant_velocity(last.history)])
    ((_, refused),) = outcomes_of_episode(SEED + 1, other, [task])
    assert isinstance(refused, ReplayError)


def test_a_scene_that_was_imported_is_refused(filmed: Filmed) -> None:
    labelled = filmed.scenes[0]
    imported = replace(labelled, scene=replace(labelled.scene, scene_id="drive-17"))
    with pytest.raises(ReplayError, match="drive-17"):
        Moment.of(imported)
    with pytest.raises(ReplayError, match="000002-"):
        Moment.of(replace(labelled, seed=3))


def test_a_folder_tells_how_its_episodes_were_set(tmp_path: Path) -> None:
    with pytest.raises(ReplayError, match="imported and bundled ones have none"):
        setting_of(tmp_path)
    config = asdict(GenerateConfig(duration_s=20.0, lapses=True))
    good = {"generator_version": GENERATOR_VERSION, "simulator": described(), "config": config}

    def written(**changed: Any) -> Path:
        (tmp_path / MANIFEST).write_text(json.dumps(good | changed))
        return tmp_path

    assert setting_of(written()) == EpisodeSetting(20.0, drifts=False, lapses=True)
    assert setting_of(tmp_path / "scenes-000000-000019.parquet").lapses
    del config["drifts"]
    assert not setting_of(written()).drifts, "what a manifest does not name is as it always was"
    for changed, why in (
        ({"generator_version": "0"}, "generator 0"),
        ({"simulator": "metadrive-simulator 0.1"}, "0.1"),
        ({"config": {"wind": 3}}, "wind"),
        ({"config": {"speeds": True}}, "other speeds than were driven"),
        ({"config": None}, "not a manifest"),
    ):
        with pytest.raises(ReplayError, match=why):
            setting_of(written(**changed))
    (tmp_path / MANIFEST).write_text("{")
    with pytest.raises(ReplayError, match="not a manifest"):
        setting_of(tmp_path)
