from __future__ import annotations

import pytest

from looktwice.model.driving.phrases import PhraseError
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.reflection_store import LabelledReflection
from looktwice.model.driving.scene import FRONT_WIDE
from looktwice.model.families.family import Counterfactual
from looktwice.model.training.examples import Examples
from looktwice.model.training.reflections import mirrored, place_reflections
from tests.model.training.scenes import training_scene

PLAN = parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")
EXAMPLES = Examples.from_scenes((training_scene(k) for k in range(3)), (FRONT_WIDE,))


def reflection(scene_id: str, text: str) -> LabelledReflection:
    return LabelledReflection(
        scene_id,
        PLAN,
        text,
        PLAN,
        "brake",
        False,
        True,
        False,
        "key",
        "nano",
        "1",
        "rules",
        "1",
        1,
        "2026-01-01",
    )


def test_reflections_find_their_examples_in_plain_punctuation() -> None:
    found = place_reflections(
        EXAMPLES,
        [reflection(str(EXAMPLES.scene_id[2]), "The car\u2019s brake lights\u2026 I \u201cwait\u201d.")],
    )
    assert found.examples.tolist() == [2]
    assert found.reflections[0].thinking == 'The car\'s brake lights... I "wait".'
    assert not found.reflections[0].judged
    assert found.reflections[0].mend == "brake"
    assert found.told.tolist() == [[True, False]]


def test_a_mirrored_reflection_says_the_other_side() -> None:
    plans = [parse_plan(f"- lane\n  - 0.0s-6.4s: {side} Lane Change\n") for side in ("Left", "Right")]
    text = (
        "There is room in the {} lane. "
        "Going on like this would get me stuck, so I should move to the {} lane."
    )
    left, right = (
        Counterfactual(PLAN, text.format(side, side), plan, "the expert's way", judged=False)
        for side, plan in zip(("left", "right"), plans, strict=True)
    )
    assert mirrored(left) == right
    assert mirrored(Counterfactual(plans[0], "")) == Counterfactual(plans[1], "")
    with pytest.raises(PhraseError):
        mirrored(Counterfactual(PLAN, "I should slow down."))


def test_scenes_that_share_an_id_are_not_taken_for_each_other() -> None:
    twice = Examples.concatenate([EXAMPLES, EXAMPLES])
    with pytest.raises(ValueError, match="2 scenes have that id"):
        place_reflections(twice, [reflection(str(EXAMPLES.scene_id[2]), "")])


def test_a_reflection_on_an_unknown_scene_is_refused() -> None:
    with pytest.raises(ValueError, match="scene nowhere, which is not among"):
        place_reflections(EXAMPLES, [reflection("nowhere", "")])
