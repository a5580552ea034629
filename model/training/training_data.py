"""What a recipe learns from: scenes as arrays, and what files say of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.feedback_store import read_feedback
from looktwice.model.driving.reflection_store import read_reflections
from looktwice.model.families.registry import family_named
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.training.attempts import PlacedAttempts, fails, place_attempts
from looktwice.model.training.examples import Examples, load_examples
from looktwice.model.training.recipe_checks import (
    TrainingFiles,
    check_pictures,
    check_reflections,
    taught_by,
)
from looktwice.model.training.recipes import Recipe
from looktwice.model.training.reflections import PlacedReflections, place_reflections


@dataclass(frozen=True)
class TrainingData:
    """What a recipe learns from.

    Attributes:
        scenes: file or folder they came from.
        examples: the scenes as arrays.
        taught: (examples,), which of them the recipe learns from.
        reflections: verified plans, by example.
        attempts: a model's own answers with feedback, to be refined, by example.
        failed: (examples,), in which of them a model's own answers are wrong.
    """

    scenes: Path
    examples: Examples
    taught: npt.NDArray[np.bool_]
    reflections: PlacedReflections | None
    attempts: PlacedAttempts | None
    failed: npt.NDArray[np.bool_] | None

    @classmethod
    def read(
        cls, recipe: Recipe, loaded: Loaded, scenes: Path, cache: Path, files: TrainingFiles
    ) -> TrainingData:
        """Read what ``recipe`` teaches ``loaded``; the files themselves were checked before.

        Raises:
            FeedbackFileError: one is missing, damaged, or of another version.
            ValueError: no scene can be learned from so, or a file is on other scenes.
        """
        examples = load_examples(scenes, cache, loaded.settings.cameras)
        check_pictures(recipe, examples, loaded)
        taught = taught_by(recipe, examples)
        reflections = attempts = failed = None
        if files.reflections is not None:
            reflections = place_reflections(examples, read_reflections(files.reflections))
            check_reflections(files.reflections, reflections, loaded)
        if files.failures is not None:
            feedback = read_feedback(files.failures)
            if recipe.attempting is not None:
                attempts = place_attempts(examples, feedback, family_named(recipe.attempting).times_s, taught)
            if recipe.outcome is not None:
                failed = fails(examples, feedback)
        return cls(scenes, examples, taught, reflections, attempts, failed)

    def describe(self, recipe: Recipe) -> Mapping[str, Any]:
        """What a model card tells of the recipe, and of what it learned from."""
        told = {field.name: getattr(recipe, field.name) for field in fields(recipe)}
        told |= {"tasks": dict(recipe.tasks), "weights": dict(recipe.weights)}
        told["outcome"] = None if recipe.outcome is None else asdict(recipe.outcome)
        if self.reflections is not None:
            thought = sum(bool(each.thinking) for each in self.reflections.reflections)
            right = len(self.reflections.reflections) - thought
            told |= {"reflections_count": thought, "right_plans_count": right}
        if self.attempts is not None:
            right = sum(each.correct for each in self.attempts.attempts)
            told |= {"failures_count": len(self.attempts.attempts) - right, "right_answers_count": right}
        if self.failed is not None:
            told |= {"failed_scenes_count": int(self.failed.sum())}
        episodes = len(np.unique(self.examples.episode[self.taught]))
        return told | {"examples": int(self.taught.sum()), "episodes": episodes}
