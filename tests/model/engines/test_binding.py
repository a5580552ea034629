from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.agreement import trajectory_iou
from looktwice.model.driving.labeller import label_plan
from looktwice.model.driving.plan import WORDS, MetaAction, Plan, parse_plan, plan_from_bins
from looktwice.model.engines.binding import BOUND_IOU, Binding, first_codes
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.formats.cursor import Token
from looktwice.model.network.checkpoint import Loaded
from tests.checkpoints import noisy_scene
from tests.model.engines.decoding import decode, request
from tests.model.engines.reference import reference_draws

KEEP = Plan(
    longitudinal=(MetaAction(0, 64, "Keep Speed"),),
    lateral=(MetaAction(0, 64, "Straight"),),
    lane=(MetaAction(0, 64, "Keep Lane"),),
)
SLOW = Plan(longitudinal=(MetaAction(0, 64, "Decelerate"),), lateral=KEEP.lateral)


def done(*plans: Plan) -> np.ndarray[tuple[int, ...], np.dtype[np.int8]]:
    """What trajectories carry out, which tell no lanes."""
    return np.stack([Plan(longitudinal=each.longitudinal, lateral=each.lateral).bins() for each in plans])


def test_only_what_agrees_with_the_plan_remains() -> None:
    assert first_codes(KEEP, done(KEEP, SLOW, KEEP)).tolist() == [True, False, True]
    assert first_codes(SLOW, done(KEEP, SLOW, KEEP)).tolist() == [False, True, False]


def test_where_nothing_agrees_the_best_remain() -> None:
    assert BOUND_IOU > 1 / 3
    turns = Plan(longitudinal=SLOW.longitudinal, lateral=(MetaAction(0, 64, "Left Turn"),))
    assert first_codes(KEEP, done(SLOW, turns, SLOW)).tolist() == [True, False, True]


def test_a_plan_that_no_trajectory_can_tell_of_leaves_all() -> None:
    assert first_codes(Plan(lane=KEEP.lane), done(KEEP, SLOW)).all()
    assert first_codes(Plan(), done(KEEP, SLOW)).all()


@given(st.lists(st.integers(0, 4), min_size=64, max_size=64), st.integers(1, 8))
def test_something_always_remains(words: list[int], count: int) -> None:
    plan = Plan(longitudinal=plan_from_bins(np.array([words, [-1] * 64, [-1] * 64])).longitudinal)
    every = [
        Plan(longitudinal=(MetaAction(0, 64, word),), lateral=KEEP.lateral) for word in WORDS["longitudinal"]
    ]
    left = first_codes(plan, done(*(every * 2)[:count]))
    assert left.shape == (count,)
    assert left.any()


def test_codes_are_read_with_the_scenes_own_history(exact: Loaded) -> None:
    history = noisy_scene(1).history
    binding = Binding(history, exact.codec, exact.vocabulary)
    first = np.asarray(exact.vocabulary.code_ids(0))
    written = [Token(token, "plan") for token in exact.vocabulary.encode(str(KEEP))]
    left = binding.leaves(first, written, CF_VLA.plans)
    assert left is not None
    ious = [trajectory_iou(KEEP, each, history) or 0.0 for each in exact.codec.first_trajectories(history)]
    assert left.tolist() == [iou >= min(BOUND_IOU, max(ious)) for iou in ious]
    # The plan that counts is the last one.
    best = label_plan(exact.codec.first_trajectories(history)[3], history, None)
    revised = [Token(token, "revised_plan") for token in exact.vocabulary.encode(str(best))]
    again = binding.leaves(first, [*written, *revised], CF_VLA.plans)
    assert again is not None
    assert again[3]


def test_other_tokens_are_left_alone(exact: Loaded) -> None:
    binding = Binding(noisy_scene(1).history, exact.codec, exact.vocabulary)
    written = [Token(token, "plan") for token in exact.vocabulary.encode(str(KEEP))]
    assert binding.leaves(np.asarray(exact.vocabulary.code_ids(1)), written, CF_VLA.plans) is None
    assert binding.leaves(np.array([1, 2, 3]), written, CF_VLA.plans) is None
    assert binding.leaves(np.asarray(exact.vocabulary.code_ids(0)), [], CF_VLA.plans) is None


@pytest.mark.usefixtures("inference")
def test_a_bound_request_decodes_as_the_reference_does(exact: Loaded) -> None:
    mixed = [
        request("bound", 0, n=3, bind=True, thinking="never"),
        request("looked", 1, n=2, bind=True, thinking="always", seed=5),
        request("free", 0, n=3, thinking="never"),
        request("bare", 2, "traj_only", n=2, bind=True),
    ]
    draws = decode(Decoder(Runner(exact, 16)), *mixed)
    for asked in mixed:
        for expected in reference_draws(exact, asked):
            draw = draws[asked.request_id, expected.index]
            assert (draw.text, draw.codes) == (expected.text, expected.codes)
    history = mixed[0].scene.history
    binding = Binding(history, exact.codec, exact.vocabulary)
    first = np.asarray(exact.vocabulary.code_ids(0))
    for index in range(3):
        draw = draws["bound", index]
        written = [Token(token, "plan") for token in exact.vocabulary.encode(str(draw.plan))]
        left = binding.leaves(first, written, CF_VLA.plans)
        assert left is not None
        assert left[draw.codes[0]]
        assert parse_plan(str(draw.plan)) == draw.plan
    assert any(draws["bound", index].codes != draws["free", index].codes for index in range(3))
