from __future__ import annotations

from looktwice.model.training.recipes import NANO, lasting


def test_a_shorter_recipe_warms_up_for_less_and_a_longer_one_as_long() -> None:
    recipe = NANO["sketched"]
    shorter, longer = lasting(recipe, recipe.steps // 5), lasting(recipe, 5 * recipe.steps)
    assert (shorter.steps, shorter.warmup_steps) == (recipe.steps // 5, recipe.warmup_steps // 5)
    assert (longer.steps, longer.warmup_steps) == (5 * recipe.steps, recipe.warmup_steps)
