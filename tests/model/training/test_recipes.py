from __future__ import annotations

import pytest

from looktwice.model.families.family import FamilyError
from looktwice.model.training.recipes import NANO, lasting, responding


def test_a_shorter_recipe_warms_up_for_less_and_a_longer_one_as_long() -> None:
    recipe = NANO["sketched"]
    shorter, longer = lasting(recipe, recipe.steps // 5), lasting(recipe, 5 * recipe.steps)
    assert (shorter.steps, shorter.warmup_steps) == (recipe.steps // 5, recipe.warmup_steps // 5)
    assert (longer.steps, longer.warmup_steps) == (5 * recipe.steps, recipe.warmup_steps)


def test_any_format_can_be_taught_with_weights_of_its_sections() -> None:
    recipe = responding("traj_only", {"trajectory": 3.0})
    assert recipe.tasks == {"traj_only": 1.0}
    assert recipe.weights["trajectory"] == 3.0
    assert set(recipe.weights.values()) <= {1.0, 3.0}


def test_what_cannot_be_taught_is_refused_by_name() -> None:
    with pytest.raises(FamilyError, match="no model family 'no_such'"):
        responding("no_such", {})
    with pytest.raises(ValueError, match="no section 'plan'; it has"):
        responding("traj_only", {"plan": 1.0})
    with pytest.raises(ValueError, match="scenes alone teach no responses"):
        responding("elf_vla_refine", {})
