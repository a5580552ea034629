"""Whether a recipe can learn from what it is given, before anything is trained."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from looktwice.model.families.registry import family_named
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.training.examples import Examples
from looktwice.model.training.recipes import Recipe
from looktwice.model.training.reflections import PlacedReflections


@dataclass(frozen=True)
class TrainingFiles:
    """Files that a recipe may ask for beside scenes.

    Attributes:
        reflections: a build's verified plans.
        failures: a model's own answers with feedback.
    """

    reflections: Path | None = None
    failures: Path | None = None


def check_files(recipe: Recipe, loaded: Loaded, files: TrainingFiles) -> None:
    """Raise ValueError unless a recipe is given the files that it learns from, and no others."""
    # What second sketches change is learned from all scenes, and no reflection of a build tells it.
    told = recipe.sketched and loaded.settings.second_sketch
    if (files.reflections is None) != (recipe.reflections is None or told):
        wants = "needs reflections" if files.reflections is None else "takes no reflections"
        why = f": {loaded.card.name} tells in the prompt what else might be driven" if told else ""
        raise ValueError(f"recipe {recipe.name} {wants}{why}")
    refines = recipe.outcome is not None and recipe.outcome.refining is not None
    if files.failures is not None and recipe.attempting is None and not refines:
        raise ValueError(f"recipe {recipe.name} takes no failures")


def check_checkpoint(recipe: Recipe, loaded: Loaded) -> None:
    """Raise ValueError unless a checkpoint has what a recipe builds on: sketches, or refinements."""
    if recipe.goal == "judge" and not loaded.settings.sketch_tokens:
        raise ValueError(f"recipe {recipe.name} judges sketches, and {loaded.card.name} writes none")
    if recipe.goal == "judge" and not (loaded.settings.with_tracks and loaded.settings.scene_tokens):
        raise ValueError(
            f"recipe {recipe.name} judges what two small planners sketch, by pictures and with tracks, and "
            f"{loaded.card.name} has one of them"
        )
    if recipe.sketched and not loaded.settings.sketch_tokens:
        raise ValueError(f"recipe {recipe.name} teaches sketches, and {loaded.card.name} has none")
    refining = None if recipe.outcome is None else recipe.outcome.refining
    if refining is None or refining.threshold == 0:
        return
    if refining.format not in loaded.settings.formats:
        raise ValueError(
            f"recipe {recipe.name} refines what fails, and {loaded.card.name} does not write "
            f"{refining.format}: `looktwice train elf-sft --failures` teaches it"
        )


def check_vision(source: Path, loaded: Loaded, vision_source: Path, vision: Loaded) -> None:
    """Raise ValueError unless the decoder of one checkpoint can read what the other one sees."""
    if loaded.settings.fine_vision and not vision.settings.fine_vision:
        raise ValueError(
            f"{source} has convolutions beside its tower and {vision_source} has none: "
            "`looktwice train fine-vision` gives it some"
        )
    if vision.settings.intent_tokens != loaded.settings.intent_tokens:
        raise ValueError(
            f"{source} has {loaded.settings.intent_tokens} tokens of an intent and {vision_source} "
            f"{vision.settings.intent_tokens}: `looktwice train read-scene` gives sketches to one "
            "without, and `looktwice train critic` second ones"
        )


def check_reflections(reflections: Path, placed: PlacedReflections, loaded: Loaded) -> None:
    """Raise ValueError if reflections begin with plans that a checkpoint cannot have made."""
    if placed.told[:, 1].any() and not loaded.settings.with_tracks:
        raise ValueError(f"{reflections} has plans made with tracks, which {loaded.card.name} cannot be told")


def check_pictures(recipe: Recipe, examples: Examples, loaded: Loaded) -> None:
    """Raise ValueError unless pictures that a recipe teaches are there, and can be written as codes."""
    if not recipe.picture_share:
        return
    known = [bool(examples.next_cameras(index)) for index in range(len(examples))]
    if recipe.picture_share == 1 and not all(known):
        raise ValueError(
            f"recipe {recipe.name} teaches pictures half a second ahead, and {known.count(False)} scenes "
            "bring none: `looktwice scenes generate --next-frames` makes such scenes"
        )
    if any(known) and loaded.visual_codes is None:
        raise ValueError(
            f"recipe {recipe.name} teaches pictures, and {loaded.card.name} has no codes for them: "
            "--visual-codes names the folder that `looktwice train visual-codes` made"
        )


def taught_by(recipe: Recipe, examples: Examples) -> npt.NDArray[np.bool_]:
    """Which examples tell all that a recipe's responses say, bool [N]; raises ValueError where none does."""
    taught = np.ones(len(examples), np.bool_)
    for task in recipe.tasks:
        for part in family_named(task).lesson_needs:
            taught &= examples.tell(part)
    if not taught.any():
        raise ValueError(f"no scene tells what recipe {recipe.name} teaches: all lack agents, lanes or road")
    return taught
