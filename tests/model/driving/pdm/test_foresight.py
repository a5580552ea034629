"""The world ahead, of what a planner is told: objects go on, and every plan in it can be judged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from transformers import AutoTokenizer

from looktwice.clients.wire import MAX_FEEDBACK_CHARACTERS
from looktwice.model.bundled import CHECKPOINT
from looktwice.model.driving.agents import AGENT_KINDS
from looktwice.model.driving.pdm.foresight import world_ahead
from looktwice.model.driving.pdm.judging import judged_plans
from looktwice.model.driving.pdm.rule_teacher import rule_sections
from looktwice.model.driving.pdm.scoring import COLLISIONS, Others, score
from looktwice.model.driving.pdm.world import Array, World
from looktwice.model.driving.tracks import Track
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.families.elf_vla.inputs import WITH_ATTEMPT
from looktwice.model.families.family import Attempt, Situation
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.network.vocabulary import Vocabulary

CAR = Track(20.0, 3.0, 0.0, 5.0, 4.5, 1.9, "vehicle")


def history(speed_ms: float) -> FloatArray:
    rows = np.zeros((16, 4), np.float32)
    rows[:, 0] = speed_ms * 0.1 * np.arange(-15, 1)
    return rows


def straight(speed_ms: float) -> Array:
    plan = np.zeros((8, 3))
    plan[:, 0] = 0.5 * speed_ms * np.arange(1, 9)
    return plan


def test_objects_go_on_along_their_headings() -> None:
    tracks = (
        CAR,
        replace(CAR, heading_rad=np.pi / 2, speed_ms=-2.0),
        replace(CAR, kind="cone", speed_ms=0.0),
    )
    world = world_ahead(history(8.0), None, tracks)
    assert world.tracks is not None
    ahead, reversing, cone = world.tracks
    assert [each.track_id for each in world.tracks] == ["0", "1", "2"]
    np.testing.assert_allclose(ahead.poses[[0, 40, 50]], [[20, 3, 0], [40, 3, 0], [45, 3, 0]])
    np.testing.assert_allclose(reversing.poses[40], [20, -5, np.pi / 2])
    assert reversing.first_speed_mps == 2.0
    assert (ahead.is_agent, cone.is_agent, cone.is_stopped) == (True, False, True)
    assert (world.lanes, world.drivable, world.lights, world.centreline) == (None, None, None, None)


def test_the_route_is_the_line_that_progress_is_told_along() -> None:
    route = np.stack([4.0 * np.arange(1, 21), np.zeros(20)], axis=1).astype(np.float32)
    found = score(world_ahead(history(8.0), route, ()), straight(8.0)[None], "v1.1", centre=True)
    assert found.progress_m == pytest.approx([32.0], abs=0.1)
    assert found.missing == ("drivable_area_compliance", "ego_progress")


def test_whom_the_ego_touches_beside_it_is_its_fault_only_in_a_careful_world() -> None:
    beside = Track(-0.5, 3.0, -0.1, 8.1, 4.5, 1.9, "vehicle")
    world = world_ahead(history(8.0), None, (beside,))
    plan = straight(8.0)[None]
    careful, usual = (
        score(each, plan, "v1.1", centre=True) for each in (world, replace(world, careful=False))
    )
    assert careful.sub_scores[COLLISIONS] == [0.0]
    assert careful.failures[COLLISIONS].other == [0]
    unknown = usual.sub_scores[COLLISIONS]
    assert unknown is not None
    assert np.isnan(unknown)
    # Who drives into the ego from behind is at fault himself.
    behind = world_ahead(history(8.0), None, (Track(-12.0, 0.0, 0.0, 14.0, 4.5, 1.9, "vehicle"),))
    assert score(behind, straight(8.0)[None], "v1.1", centre=True).sub_scores[COLLISIONS] == [1.0]


NUMBERS = st.floats(-1, 1)
TRACKS = st.lists(
    st.builds(
        lambda x, y, heading, speed, kind: Track(40 * x, 5 * y, 3 * heading, 15 * speed, 4.5, 1.9, kind),
        *[NUMBERS] * 4,
        st.sampled_from(AGENT_KINDS),
    ),
    max_size=16,
)
PLANS = st.lists(st.tuples(st.floats(-5, 20), st.floats(-4, 4), NUMBERS), min_size=8, max_size=8)


def judged(world: World, steps: list[tuple[float, float, float]]) -> Any:
    plan = np.array(steps)
    plan[:, :2] = np.cumsum(plan[:, :2], axis=0)
    found = score(world, plan[None], "v1.1", centre=True)
    return judged_plans(world, plan[None], found, Others(), threshold=1.0, centre=True)[0]


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    """That of the shipped checkpoint."""
    return Vocabulary(AutoTokenizer.from_pretrained(CHECKPOINT))


@pytest.fixture(scope="module")
def prompt(vocabulary: Vocabulary) -> CompiledFormat:
    """The words of ELF-VLA's prompt in it."""
    return CompiledFormat(WITH_ATTEMPT.format, vocabulary)


@settings(max_examples=50)
@given(tracks=TRACKS, steps=PLANS, speed_ms=st.floats(0, 20))
def test_every_plan_can_be_judged_and_what_is_said_of_it_fits_the_prompt(
    vocabulary: Vocabulary,
    prompt: CompiledFormat,
    tracks: list[Track],
    steps: list[tuple[float, float, float]],
    speed_ms: float,
) -> None:
    found = judged(world_ahead(history(speed_ms), None, tracks), steps)
    assert 0.0 <= found.score <= 1.0
    feedback = str(rule_sections(found))
    assert len(feedback) <= MAX_FEEDBACK_CHARACTERS
    attempt = Attempt(np.zeros((8, 4), np.float32), feedback)
    tokens = prompt.render(WITH_ATTEMPT.values(Situation(history(speed_ms), None, attempt)))
    told = vocabulary.decode([token.id for token in tokens if token.section == "feedback"])
    plain = feedback.replace("\u00b2", "2").replace("\u00b3", "3")
    assert told.split() == plain.replace("<feedback>\n", "<feedback>").replace("\n</", "</").split()
