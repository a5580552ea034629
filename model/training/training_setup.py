"""Who learns by a recipe, from which dataset: one function for each goal."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.utils.data import Dataset, Subset

from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.intent import IntentReader
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.training.attempts import half_failed
from looktwice.model.training.batches import collate, stacked
from looktwice.model.training.critics import CriticLearner, VerdictDataset, told_apart
from looktwice.model.training.dense import DENSE_SHAPE
from looktwice.model.training.examples import Examples
from looktwice.model.training.fact_reading import FactDataset, FactLearner, reading_errors
from looktwice.model.training.fine_looks import FineDataset, FineLearner
from looktwice.model.training.grounding import (
    GroundingDataset,
    GroundingLearner,
    collate_grounding,
    looked_at,
)
from looktwice.model.training.intents import IntentDataset, IntentLearner, read_errors, read_facts
from looktwice.model.training.judged_sketches import judge_sketches
from looktwice.model.training.learner import ResponseLearner
from looktwice.model.training.looks import LookLearner
from looktwice.model.training.outcome.outcome_learner import OutcomeLearner, ScenePlaces, collate_places
from looktwice.model.training.own_plans import OwnPlans
from looktwice.model.training.recipes import Recipe
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.run_settings import RunSettings
from looktwice.model.training.sampler import TaskSampler
from looktwice.model.training.trainer import Validate
from looktwice.model.training.training_data import TrainingData
from looktwice.model.training.vision_cache import VisionCache, open_vision


@dataclass(frozen=True)
class TrainingSetup:
    """What the trainer is given.

    Attributes:
        learner: whose parameters are trained; its outcome is the loss.
        dataset: examples, or their places.
        collate: makes a batch of them.
        sampler: in which order; at random without one.
        validate: tells how well it goes now and then.
    """

    learner: nn.Module
    dataset: Dataset[Any]
    collate: Callable[[list[Any]], dict[str, torch.Tensor]] = stacked
    sampler: TaskSampler | None = None
    validate: Validate | None = None


def set_up(
    recipe: Recipe,
    loaded: Loaded,
    data: TrainingData,
    settings: RunSettings,
    held_out: Examples | None = None,
) -> TrainingSetup:
    """Make what trains ``loaded`` by a recipe.

    Args:
        recipe: what to do.
        loaded: the checkpoint, with all the parts that the recipe trains.
        data: to learn from.
        settings: how it is run.
        held_out: scenes to tell how well facts and sketches are read; responses are validated elsewhere.

    Raises:
        ValueError: no scene can be learned from so.
    """
    if recipe.goal == "ground":
        return _grounding(recipe, loaded, data, settings)
    vision = None
    if recipe.pictures and recipe.vision_rate == 0:
        vision = _cached(
            loaded, data.examples, settings, mirrored=recipe.mirror_share > 0, fine=recipe.goal != "fine"
        )
    if recipe.goal in ("facts", "fine"):
        assert vision is not None, "facts are read from pictures"
        return _reading_facts(recipe, loaded, data, settings, vision, held_out)
    if recipe.goal == "judge":
        assert vision is not None, "facts are read from pictures"
        return _judging(recipe, loaded, data, settings, vision)
    if recipe.goal == "read":
        return _sketching(recipe, loaded, data, settings, vision, held_out)
    return _responding(recipe, loaded, data, settings, vision)


def vision_parts(vla: LookTwiceVla) -> list[nn.Module]:
    """What stands between pictures and the decoder: the tower and, where there are any, what is beside it."""
    return [part for part in (vla.model.visual, vla.fine_vision, vla.resampler) if part is not None]


def small_planners(vla: LookTwiceVla) -> list[IntentReader]:
    """Those whose states stand in the prompt."""
    scene = None if vla.resampler is None else vla.resampler.intent
    return [planner for planner in (vla.track_reader, scene) if planner is not None]


def _cached(
    loaded: Loaded, examples: Examples, settings: RunSettings, *, mirrored: bool, fine: bool = True
) -> VisionCache:
    return open_vision(
        loaded,
        examples,
        settings.cache,
        mirrored=mirrored,
        fine=fine,
        bf16=settings.bf16,
        workers=settings.workers,
    )


def _grounding(recipe: Recipe, loaded: Loaded, data: TrainingData, settings: RunSettings) -> TrainingSetup:
    learner, device = GroundingLearner(loaded.model, loaded.codec, DENSE_SHAPE), settings.device
    places = looked_at(data.examples)
    if device.type != "cpu":
        looking = LookLearner(learner, data.examples, loaded.inputs, device, settings.workers)
        return TrainingSetup(looking, ScenePlaces(places), collate_places)
    dataset = GroundingDataset(data.examples, loaded.inputs, recipe.seed)
    return TrainingSetup(learner, Subset(dataset, places), collate_grounding)


def _reading_facts(
    recipe: Recipe,
    loaded: Loaded,
    data: TrainingData,
    settings: RunSettings,
    vision: VisionCache,
    held_out: Examples | None,
) -> TrainingSetup:
    if not data.examples.pictured.any():
        raise ValueError(f"recipe {recipe.name} learns from pictures, and no scene has any")
    facts, places = (
        FactDataset(data.examples, vision, recipe.route_share, recipe.seed),
        looked_at(data.examples),
    )
    if recipe.goal == "fine":
        close = FineDataset(facts, data.examples, loaded.inputs)
        return TrainingSetup(FineLearner(loaded.model), Subset(close, places))
    learner, validate = FactLearner(loaded.model), None
    if held_out is not None:
        validate = partial(
            reading_errors, learner, held_out, _cached(loaded, held_out, settings, mirrored=False)
        )
    return TrainingSetup(learner, Subset(facts, places), validate=validate)


def _judging(
    recipe: Recipe, loaded: Loaded, data: TrainingData, settings: RunSettings, vision: VisionCache
) -> TrainingSetup:
    read = read_facts(loaded.model, data.examples, vision, recipe.seed, recipe.misread_share)
    judged = judge_sketches(loaded.model, loaded.codec, data.examples, read, data.scenes, settings.workers)
    dataset = VerdictDataset(data.examples, judged, read, recipe.seed)
    learned, left_out = dataset.split()
    learner = CriticLearner(loaded.model)
    validate = partial(told_apart, learner, dataset, left_out) if left_out else None
    return TrainingSetup(learner, Subset(dataset, learned), validate=validate)


def _sketching(
    recipe: Recipe,
    loaded: Loaded,
    data: TrainingData,
    settings: RunSettings,
    vision: VisionCache | None,
    held_out: Examples | None,
) -> TrainingSetup:
    learner = IntentLearner(loaded.model, loaded.codec, "tracks" if vision is None else "scene")
    read = (
        None
        if vision is None
        else read_facts(loaded.model, data.examples, vision, recipe.seed, recipe.misread_share)
    )
    dataset, validate = IntentDataset(data.examples, read, recipe.route_share, recipe.seed), None
    if held_out is not None:
        seen = None if vision is None else _cached(loaded, held_out, settings, mirrored=False)
        read_there = None if seen is None else read_facts(loaded.model, held_out, seen)
        validate = partial(read_errors, learner, held_out, read_there)
    return TrainingSetup(learner, dataset, validate=validate)


def _responding(
    recipe: Recipe, loaded: Loaded, data: TrainingData, settings: RunSettings, vision: VisionCache | None
) -> TrainingSetup:
    own_plans = None
    if recipe.own_plans and loaded.model.resampler is not None and loaded.model.track_reader is not None:
        own_plans = OwnPlans(loaded.model, data.examples, vision, recipe.seed)
    responses = ResponseDataset(
        data.examples,
        loaded.codec,
        loaded.inputs,
        loaded.vocabulary,
        recipe.weights,
        pictures=recipe.pictures,
        vision=vision,
        reflections=() if data.reflections is None else data.reflections.reflections,
        attempts=() if data.attempts is None else data.attempts.attempts,
        attempting=recipe.attempting,
        own_plans=own_plans,
        sketched=recipe.sketched,
        visual_codes=loaded.visual_codes,
        seed=recipe.seed,
    )
    _freeze(loaded.model, vision=recipe.vision_rate == 0)
    learner = ResponseLearner(
        loaded.model,
        loaded.vocabulary,
        loaded.codec,
        error_weight=recipe.error_weight,
        head_weight=recipe.head_weight,
        compiled=settings.compiled,
    )
    if recipe.outcome is not None:
        return _judged_by_outcome(recipe, loaded, data, learner, responses)
    return TrainingSetup(learner, responses, collate, _sampler(recipe, loaded, data, responses))


def _freeze(model: LookTwiceVla, *, vision: bool) -> None:
    """Leave what responses do not teach as it is; the tower too, unless it is trained with them."""
    for part in vision_parts(model):
        part.requires_grad_(not vision)
    for planner in small_planners(model):
        # A sketch is its planner's trajectory only while nothing else moves them: the few responses that a
        # decoder learns from would. What the state becomes in the prompt is learned with the decoder.
        planner.requires_grad_(planner.sketch is None)
        planner.tokens.requires_grad_(True)
        if planner.second is not None:
            planner.second.requires_grad_(True)
            planner.second.critic.requires_grad_(False)
    if model.sketch_books is not None:
        model.sketch_books.requires_grad_(False)


def _judged_by_outcome(
    recipe: Recipe, loaded: Loaded, data: TrainingData, learner: ResponseLearner, responses: ResponseDataset
) -> TrainingSetup:
    assert recipe.outcome is not None, "which says how draws are judged"
    [task] = recipe.tasks
    judging = OutcomeLearner(
        learner,
        loaded,
        responses,
        list(read_scenes(data.scenes, dense=False)),
        task,
        recipe.outcome,
        route_share=recipe.route_share,
        tracks_share=recipe.tracks_share if loaded.settings.with_tracks else 0.0,
    )
    # Where nobody knows the road, a draw that leaves it would count as one that holds.
    judged = data.examples.pictured & data.taught & data.examples.tell("perceived")
    if not judged.any():
        raise ValueError(f"recipe {recipe.name} judges draws, and no scene with pictures tells the road")
    places = np.flatnonzero(judged) if data.failed is None else half_failed(judged, data.failed)
    return TrainingSetup(judging, ScenePlaces(places.tolist()), collate_places)


def _sampler(recipe: Recipe, loaded: Loaded, data: TrainingData, responses: ResponseDataset) -> TaskSampler:
    examples, reflections, attempts = data.examples, data.reflections, data.attempts
    return TaskSampler(
        examples.has_route,
        recipe.batch_size,
        recipe.tasks,
        recipe.route_share,
        recipe.seed,
        processes=int(os.environ.get("WORLD_SIZE", 1)),
        reflected=np.zeros(0, np.int64) if reflections is None else reflections.examples,
        told=None if reflections is None else reflections.told,
        reasoning=recipe.reflections == "learned",
        reflecting=responses.reflecting,
        tracks_share=recipe.tracks_share if loaded.settings.with_tracks else 0.0,
        mirror_share=recipe.mirror_share,
        blur_share=recipe.blur_share,
        pictured=examples.pictured,
        taught=data.taught,
        mirror_reflected=loaded.settings.reflection == "phrases",
        next_cameras=[examples.next_cameras(index) for index in range(len(examples))]
        if recipe.picture_share
        else (),
        picture_share=recipe.picture_share,
        attempted=np.zeros(0, np.int64) if attempts is None else attempts.examples,
        attempting=recipe.attempting,
    )
