from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.agreement import (
    FOLLOWS_IOU,
    PARTS,
    agreement,
    reason_and_change,
    reason_and_view,
    trajectory_iou,
)
from looktwice.model.driving.labeller import expert_plan, label_plan
from looktwice.model.driving.phrases import (
    NOTHING,
    Bend,
    Clear,
    Cue,
    Junction,
    Room,
    Statement,
    Straight,
    Thing,
    consequences,
    head_of,
)
from looktwice.model.driving.plan import MetaAction, Plan
from looktwice.model.driving.view import Sight, View
from tests.model.driving.drives import MIDDLES_S, labelled_scene

STEADY = labelled_scene(10.0)
BRAKING = labelled_scene(10.0 - 1.2 * np.maximum(MIDDLES_S, 0))
KEEP, SLOW = expert_plan(STEADY), expert_plan(BRAKING)
BRAKE = "A van stands in my lane, so I should slow down."


def test_a_trajectory_is_held_against_what_it_carries_out() -> None:
    assert trajectory_iou(KEEP, STEADY.future, STEADY.scene.history) == 1.0
    other = trajectory_iou(KEEP, BRAKING.future, BRAKING.scene.history)
    assert other is not None
    assert other < FOLLOWS_IOU


def test_tracks_that_a_trajectory_does_not_tell_do_not_count() -> None:
    changing = replace(KEEP, lane=(MetaAction(0, 64, "Left Lane Change"),))
    assert trajectory_iou(changing, STEADY.future, STEADY.scene.history) == 1.0
    lateral = Plan(lateral=KEEP.lateral)
    assert trajectory_iou(lateral, BRAKING.future, BRAKING.scene.history) == 1.0
    for nothing in (None, Plan(), Plan(lane=changing.lane)):
        assert trajectory_iou(nothing, STEADY.future, STEADY.scene.history) is None


def test_a_reasoning_is_held_against_what_changes() -> None:
    assert reason_and_change(BRAKE, KEEP, SLOW) is True
    assert reason_and_change(BRAKE, SLOW, KEEP) is False
    # It asks for another plan, and the plan stays; or it asks for nothing.
    assert reason_and_change(BRAKE, KEEP, KEEP) is False
    assert reason_and_change("My lane is clear, and the plan fits.", KEEP, KEEP) is None


def test_a_reasoning_is_held_against_the_view() -> None:
    ahead = View(10.0, (Sight("vehicle", 20.0, "my lane", 0.0),), None, 0.0)
    assert reason_and_view(BRAKE, ahead) is True
    assert reason_and_view(BRAKE, replace(ahead, sights=())) is False
    assert reason_and_view("I should slow down.", ahead) is None


def test_a_reasoning_in_phrases_is_held_against_what_changes_by_its_facts() -> None:
    slower = str(Statement(Thing("vehicle", "my lane", 20, "standing"), "too close", "slower"))
    assert reason_and_change(slower, KEEP, SLOW) is True
    assert reason_and_change(slower, KEEP, KEEP) is False
    turned = replace(SLOW, lateral=(MetaAction(0, 64, "Left Turn"),))
    assert reason_and_change(slower, KEEP, turned) is False  # no turn is stated
    assert reason_and_change(NOTHING, KEEP, KEEP) is True
    assert reason_and_change(NOTHING, KEEP, SLOW) is False


VAN = Sight("vehicle", 22.0, "my lane", 0.0)
COMES = Sight("vehicle", 40.0, "the left lane", -9.0)
BUSY = View(10.0, (VAN, COMES), "left", 30.0, frozenset({"right"}), frozenset({"left", "right"}))


@pytest.mark.parametrize(
    ("cue", "shown"),
    [
        (Thing("vehicle", "my lane", 20), True),
        (Thing("vehicle", "my lane", 20, "standing"), True),
        (Thing("vehicle", "my lane", 20, "slower"), True),
        (Thing("vehicle", "my lane", 20, "braking"), False),
        (Thing("vehicle", "my lane", 40), False),
        (Thing("vehicle", "the right lane", 20), False),
        (Thing("barrier", "my lane", 20), False),
        (Thing("vehicle", "oncoming", 40), True),
        (Thing("vehicle", "oncoming", 20), False),
        (Bend("left"), True),
        (Bend("left", 30), True),
        (Bend("left", 60), False),
        (Bend("right"), False),
        (Straight(), False),
        (Junction("right"), True),
        (Junction("left"), False),
        (Clear(), False),
        (Room("right"), True),
        (Room("left"), False),
    ],
)
def test_a_cue_is_in_view_or_not(cue: Cue, shown: bool) -> None:
    consequence, (correction, *_) = next(iter(consequences(head_of(cue)).items()))
    assert reason_and_view(str(Statement(cue, consequence, correction)), BUSY) is shown


def test_every_cue_must_be_in_view() -> None:
    seen, unseen = (
        Statement(Thing("vehicle", "my lane", metres), "too close", "slower") for metres in (20, 60)
    )
    turn = Statement(Junction("right"), "wrong way", "right")
    assert reason_and_view(f"{seen} {turn}", BUSY) is True
    assert reason_and_view(f"{unseen} {turn}", BUSY) is False
    assert reason_and_view(NOTHING, BUSY) is None


def test_all_that_disagrees_is_told() -> None:
    history = BRAKING.scene.history
    good = agreement(KEEP, BRAKE, SLOW, BRAKING.future, history)
    assert (good.consistent, good.disagreements) == (True, ())
    bad = agreement(SLOW, BRAKE, KEEP, BRAKING.future, history)
    assert (bad.consistent, bad.disagreements) == (False, PARTS)
    half = agreement(KEEP, BRAKE, SLOW, STEADY.future, STEADY.scene.history)
    assert (half.consistent, half.disagreements) == (False, ("plan_trajectory",))


def test_without_words_there_is_nothing_to_say() -> None:
    bare = agreement(None, None, None, STEADY.future, STEADY.scene.history)
    assert (bare.consistent, bare.disagreements) == (None, ())
    direct = agreement(KEEP, None, None, STEADY.future, STEADY.scene.history)
    assert direct.consistent
    assert direct.agreeing == {"plan_trajectory"}


@given(
    st.lists(st.floats(-3, 3), min_size=4, max_size=4),
    st.sampled_from([KEEP, SLOW, KEEP.mirrored(), Plan(lateral=(MetaAction(0, 64, "Left Turn"),))]),
)
def test_what_a_trajectory_carries_out_agrees_with_it(jerks: list[float], plan: Plan) -> None:
    speed = np.maximum(0.0, 8.0 + np.interp(MIDDLES_S, (0, 2, 4, 6), np.cumsum(jerks)) * (MIDDLES_S > 0))
    made = labelled_scene(speed)
    history = made.scene.history
    iou = trajectory_iou(plan, made.future, history)
    assert iou is not None
    assert 0 <= iou <= 1
    assert trajectory_iou(label_plan(made.future, history, None), made.future, history) == pytest.approx(1)
