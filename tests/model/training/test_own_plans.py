from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from looktwice.model.driving.labeller import label_plan
from looktwice.model.driving.mends import mended
from looktwice.model.driving.phrases import NOTHING
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.driving.trajectory import POSE_MIRROR, FloatArray, retimed
from looktwice.model.families.cf_vla.targets import NANO_WEIGHTS, PAPER_WEIGHTS
from looktwice.model.families.family import Counterfactual
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.network.vla_settings import NANO_SETTINGS
from looktwice.model.training.examples import Examples
from looktwice.model.training.own_plans import OwnPlans
from looktwice.model.training.response_targets import Target
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.sampler import Item
from looktwice.model.training.vision_cache import open_vision
from tests.model.training.scenes import training_scene

BRAKES = (
    "A slower vehicle is in my lane some 20 metres ahead. "
    "Going on like this would bring me too close, so I should brake and stop."
)
MOVES = (
    "There is room in the left lane. "
    "Going on like this would get me stuck, so I should move to the left lane."
)
EXAMPLES = Examples.from_scenes((training_scene(index) for index in range(8)), (FRONT_WIDE, FRONT_TELE))


@pytest.fixture(scope="module")
def loaded(resampling_checkpoint: Path) -> Loaded:
    return load(resampling_checkpoint)


@pytest.fixture(scope="module")
def own_plans(loaded: Loaded, tmp_path_factory: pytest.TempPathFactory) -> OwnPlans:
    vision = open_vision(loaded, EXAMPLES, tmp_path_factory.mktemp("vision"), mirrored=True)
    return OwnPlans(loaded.model, EXAMPLES, vision)


def dataset(loaded: Loaded, **how: Any) -> ResponseDataset:
    """All examples, with pictures."""
    parts = (EXAMPLES, loaded.codec, loaded.inputs, loaded.vocabulary)
    return ResponseDataset(*parts, **{"weights": NANO_WEIGHTS, "pictures": True, **how})


@pytest.mark.parametrize("tracks", [False, True])
@pytest.mark.parametrize("mirror", [False, True])
def test_own_plans_are_near_what_was_learned(own_plans: OwnPlans, tracks: bool, mirror: bool) -> None:
    random = np.random.default_rng(0)
    right = []
    for index in range(len(EXAMPLES)):
        expert = EXAMPLES.plan(index).mirrored() if mirror else EXAMPLES.plan(index)
        drawn = [own_plans.draw(index, random, mirror=mirror, route=True, tracks=tracks) for _ in range(10)]
        right.append(np.mean([each.bins() == expert.bins() for each in drawn]))
    assert np.mean(right) > 0.8


def test_where_experts_differ_own_plans_differ(loaded: Loaded) -> None:
    twins = Examples.from_scenes((training_scene(1) for _ in range(2)), (FRONT_WIDE, FRONT_TELE))
    keeps, waits = (
        parse_plan(f"- longitudinal\n  - 0.0s-6.4s: {word}\n").bins() for word in ("Keep Speed", "Wait")
    )
    own_plans = OwnPlans(loaded.model, replace(twins, plan_bins=np.stack([keeps, waits])), None)
    random = np.random.default_rng(0)
    drawn = [own_plans.draw(0, random, mirror=False, route=True, tracks=True) for _ in range(40)]
    words = Counter(action.word for plan in drawn for action in plan.longitudinal or ())
    assert min(words["Keep Speed"], words["Wait"]) >= 8
    assert words["Keep Speed"] + words["Wait"] >= 36
    segments = [len(plan.longitudinal or ()) for plan in drawn]
    assert np.mean(segments) < 4, "in doubt as a whole, not tick by tick"


def test_a_reader_of_tracks_alone_plans_from_tracks_alone(loaded: Loaded) -> None:
    own_plans = OwnPlans(loaded.model, EXAMPLES, None)
    with pytest.raises(KeyError):
        own_plans.draw(0, np.random.default_rng(0), mirror=False, route=True, tracks=False)


@pytest.mark.parametrize("tracks", [False, True])
def test_sketched_trajectories_are_those_that_the_prompt_tells(
    loaded: Loaded, own_plans: OwnPlans, tracks: bool
) -> None:
    """Behind the expert's plan, of which nothing is taught, the trajectory stays the expert's."""
    item = Item(1, "cf_vla", True, tracks=tracks)
    data = {sketched: dataset(loaded, own_plans=own_plans, sketched=sketched) for sketched in (False, True)}

    def errors_m(sketched: bool, asked: Item) -> FloatArray:
        """How far the first codes leave the trajectory of each response, [responses, codes]."""
        found: FloatArray = data[sketched][asked].code_errors_m[:, 0]
        return found

    def apart_m(asked: Item) -> FloatArray:
        """How far they leave the sketch."""
        vector = own_plans.sketch(1, mirror=asked.mirror, route=asked.route, tracks=tracks)
        apart: FloatArray = np.linalg.norm(loaded.codec.books[0] - vector, axis=1) / 8  # of 64 poses
        return apart

    def written(response: Target) -> str:
        return loaded.vocabulary.decode(response.ids)

    expert = errors_m(False, item)[0]
    assert np.abs(apart_m(item) - expert).max() > 0.1
    sketch = own_plans.sketch(1, mirror=False, route=True, tracks=tracks)
    [driven] = loaded.codec.trajectories(EXAMPLES.history[1:2], sketch[None])
    words = label_plan(driven, EXAMPLES.history[1], None)
    led_to_expert = []
    for _ in range(20):
        sample = data[True][item]
        first, second = sample.code_errors_m[:, 0]
        np.testing.assert_allclose(first, apart_m(item), atol=1e-3)
        copied = sample.code_shares[0].max(axis=1) == 1
        assert copied[: NANO_SETTINGS.sketch_tokens].all(), "a sketch's codes are not drawn"
        assert f"Meta Actions:\n{words}" in written(sample.responses[0])
        led_to_expert.append(bool(np.abs(second - expert).max() < 1e-3))
        if led_to_expert[-1]:
            assert f"Meta Actions:\n{EXAMPLES.plan(1)}" in written(sample.responses[1])
        else:
            np.testing.assert_allclose(second, apart_m(item), atol=1e-3)
    assert 0 < sum(led_to_expert) < 20
    for asked in (replace(item, task="traj_only"), replace(item, task="traj_only", mirror=True, route=False)):
        np.testing.assert_allclose(errors_m(True, asked)[0], apart_m(asked), atol=1e-3)
    # The prompt of a blurred history sketches otherwise.
    blurred = replace(item, task="traj_only", blur=True)
    np.testing.assert_array_equal(errors_m(True, blurred), errors_m(False, blurred))


def test_behind_an_own_plan_nothing_but_the_trajectory_is_taught(loaded: Loaded, own_plans: OwnPlans) -> None:
    def data(plans: OwnPlans | None) -> ResponseDataset:
        return dataset(loaded, weights=PAPER_WEIGHTS, own_plans=plans)

    def taught(response: Target) -> str:
        ids = [id for id, weight in zip(response.ids, response.weights, strict=True) if weight > 0]
        return loaded.vocabulary.decode(ids)

    behind = data(own_plans)
    [alone] = data(None)[Item(1, "cf_vla", True, tracks=True)].responses
    expert, own = behind[Item(1, "cf_vla", True, tracks=True)].responses
    assert taught(expert).startswith("Meta Actions:")
    assert taught(alone).startswith("Meta Actions:")
    assert taught(own).startswith("\n<|traj_future_start|>")
    [at_once] = behind[Item(1, "traj_only", True, tracks=True)].responses
    assert len(at_once.ids) < len(own.ids)


@pytest.mark.parametrize("mirror", [False, True])
def test_behind_a_second_look_the_sketch_is_mended(loaded: Loaded, own_plans: OwnPlans, mirror: bool) -> None:
    first, moves, waits, both = (
        parse_plan(f"- longitudinal\n  - 0.0s-6.4s: {pace}\n- lane\n  - 0.0s-6.4s: {lane}\n")
        for pace, lane in itertools.product(("Keep Speed", "Wait"), ("Keep Lane", "Left Lane Change"))
    )
    data = dataset(
        loaded,
        own_plans=own_plans,
        sketched=True,
        reflections=[
            Counterfactual(first, ""),
            Counterfactual(first, NOTHING, first),
            Counterfactual(first, BRAKES, waits, "brake hard"),
            Counterfactual(first, MOVES, moves, "the expert's way"),
            Counterfactual(first, f"{BRAKES} {MOVES}", both, "the expert's"),
        ],
    )
    sample = data[Item(1, "cf_vla", True, (0, 1, 2, 3, 4), tracks=True, mirror=mirror)]
    seen = POSE_MIRROR if mirror else np.ones_like(POSE_MIRROR)
    history, expert = EXAMPLES.history[1] * seen, EXAMPLES.future[1] * seen
    vector = own_plans.sketch(1, mirror=mirror, route=True, tracks=True)
    [sketch] = loaded.codec.trajectories(history[None], vector[None])
    assert np.abs(sketch - expert).max() > 1, "they can be told apart"
    ways = (sketch, sketch, mended("brake hard", sketch, expert, history), retimed(expert, sketch), expert)
    for way, errors_m, target in zip(ways, sample.code_errors_m[:, 0], sample.responses, strict=True):
        [wanted] = loaded.codec.vectors(history[None], way[None])
        apart_m = np.linalg.norm(loaded.codec.books[0] - wanted, axis=1) / 8  # of 64 poses
        np.testing.assert_allclose(errors_m, apart_m, atol=0.02)
        assert target.weights[-2] > 0, "where it leads is taught"
