"""Running a recipe: from scenes and a checkpoint to the next checkpoint, resumable after a kill."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.utils.data import Dataset, Subset

from looktwice.model.driving.feedback_store import read_feedback
from looktwice.model.driving.followed_store import read_followed
from looktwice.model.driving.reflection_store import read_reflections
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.families.registry import family_named
from looktwice.model.network.attention import MATMUL_ATTENTION
from looktwice.model.network.card import LOG_FILE
from looktwice.model.network.checkpoint import (
    Loaded,
    load,
    save,
    with_fine_vision,
    with_formats,
    with_second_sketches,
    with_sketches,
    with_visual_codes,
)
from looktwice.model.network.intent import IntentReader
from looktwice.model.network.visual_codes import load_visual_codes
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.network.vla_settings import NANO_SETTINGS
from looktwice.model.training.attempts import PlacedAttempts, fails, half_failed, place_attempts
from looktwice.model.training.batches import collate, stacked
from looktwice.model.training.critics import (
    CriticLearner,
    PlacedVerdicts,
    VerdictDataset,
    place_verdicts,
    told_apart,
)
from looktwice.model.training.dense import DENSE_SHAPE
from looktwice.model.training.examples import Examples, load_examples
from looktwice.model.training.fact_reading import FactDataset, FactLearner, reading_errors
from looktwice.model.training.fine_looks import FineDataset, FineLearner
from looktwice.model.training.grounding import (
    GroundingDataset,
    GroundingLearner,
    collate_grounding,
    looked_at,
)
from looktwice.model.training.intents import (
    IntentDataset,
    IntentLearner,
    Source,
    read_errors,
    read_facts,
)
from looktwice.model.training.learner import ResponseLearner
from looktwice.model.training.looks import LookLearner
from looktwice.model.training.open_loop_validation import open_loop
from looktwice.model.training.outcome.outcome_learner import OutcomeLearner, ScenePlaces, collate_places
from looktwice.model.training.own_plans import OwnPlans
from looktwice.model.training.recipe_checks import (
    check_checkpoint,
    check_files,
    check_pictures,
    check_reflections,
    check_vision,
    taught_by,
)
from looktwice.model.training.recipes import Recipe
from looktwice.model.training.reflections import PlacedReflections, place_reflections
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.sampler import TaskSampler
from looktwice.model.training.trainer import LearnerTrainer, Validate, inherit_log
from looktwice.model.training.vision_cache import VisionCache, open_vision


@dataclass(frozen=True)
class RunSettings:
    """How a recipe is run, apart from what decides its outcome.

    Attributes:
        cache: folder for scenes brought into arrays.
        validate_every, save_every: steps.
        draws: per scene in validation.
        bf16: mixed precision.
        compiled: compile the decoder; pays after a few hundred steps.
        use_cpu: stay off accelerators.
        workers: processes that make examples into batches beside the training. Grounding on CPUs has at
            least one: decoding pictures for the tower takes a third of a step there. On an accelerator
            they decode all pictures before it begins.
    """

    cache: Path
    validate_every: int = 500
    save_every: int = 250
    draws: int = 6
    bf16: bool = True
    compiled: bool = False
    use_cpu: bool = True
    workers: int = 0

    @property
    def device(self) -> torch.device:
        """Where to train; of several processes each has a device of its own."""
        if self.use_cpu or not torch.cuda.is_available():
            return torch.device("cpu")
        return torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))


def run(
    recipe: Recipe,
    scenes: Path,
    source: Path,
    target: Path,
    settings: RunSettings,
    validation: Sequence[LabelledScene] = (),
    vision_source: Path | None = None,
    reflections: Path | None = None,
    visual_codes: Path | None = None,
    failures: Path | None = None,
    followed: Sequence[Path] = (),
) -> None:
    """Train ``source`` by a recipe and write the outcome to ``target``, weights in bfloat16.

    State is kept in ``target/state`` while the run lasts: started again after a kill, it goes on from there.
    The log begins with those of the checkpoints it came from, so it tells the whole history.

    Args:
        recipe: what to do.
        scenes: training scenes, a file or folder.
        source: the checkpoint to start from; formats of the recipe that it does not write are added to its.
        target: the checkpoint to write.
        settings: see there.
        validation: scenes to report open-loop errors on while training with pictures.
        vision_source: a checkpoint whose vision tower replaces the source's; so the tower can be grounded
            while another process trains the language.
        reflections: file of the reflections that the recipe asks for.
        visual_codes: folder of codes of pictures, which the checkpoint gets; without it, it keeps its own.
        failures: file of a model's own answers with feedback: ``elf-sft`` learns to refine them, and
            ``elf-rl`` takes every second scene from those in which they are wrong.
        followed: files of trajectories that were followed, which ``critic`` learns from.

    Raises:
        FeedbackFileError: ``failures`` is missing, damaged, or of another version.
        FollowedFileError: one of ``followed`` is.
        ValueError: the recipe wants reflections and there are none, or the other way round, or they are on
            other scenes, or on plans made with tracks where ``source`` takes none; it learns from pictures or
            judges draws, and no scene can be learned from so; it takes no failures, and
            there are some, or they are on other scenes; it teaches pictures, and there are no codes for those
            that scenes bring; it teaches sketches, and ``source`` has none; only one of ``source`` and
            ``vision_source`` writes sketches.
    """
    loaded = load(source)
    check_files(recipe, loaded, reflections=reflections, failures=failures, followed=followed)
    check_checkpoint(recipe, loaded)
    refining = [recipe.attempting] if failures is not None and recipe.attempting is not None else []
    if new := [task for task in (*recipe.tasks, *refining) if task not in loaded.settings.formats]:
        loaded = with_formats(loaded, new, seed=recipe.seed)
    if recipe.goal == "fine" and not loaded.settings.fine_vision:
        loaded = with_fine_vision(loaded, seed=recipe.seed)
    if recipe.goal == "judge" and not loaded.settings.second_sketch:
        loaded = with_second_sketches(loaded, seed=recipe.seed)
    if recipe.goal == "read" and not loaded.settings.sketch_tokens:
        loaded = with_sketches(loaded, NANO_SETTINGS.sketch_tokens, seed=recipe.seed)
    if visual_codes is not None:
        loaded = with_visual_codes(loaded, load_visual_codes(visual_codes))
    stages = list(loaded.card.details.get("stages", []))
    if vision_source is not None:
        vision = load(vision_source)
        if vision.settings.fine_vision and not loaded.settings.fine_vision:
            loaded = with_fine_vision(loaded, seed=recipe.seed)
        check_vision(source, loaded, vision_source, vision)
        for mine, theirs in zip(vision_parts(loaded.model), vision_parts(vision.model), strict=True):
            mine.load_state_dict(theirs.state_dict())
        stages += [stage for stage in vision.card.details.get("stages", []) if stage not in stages]
    network: nn.Module = loaded.model
    network.to(settings.device).train()
    loaded.model.set_attn_implementation(MATMUL_ATTENTION)
    torch.manual_seed(recipe.seed)
    examples = load_examples(scenes, settings.cache, loaded.settings.cameras)
    check_pictures(recipe, examples, loaded)
    if recipe.sketched:
        assert loaded.model.sketch_books is not None, "which write sketches"
        # Older checkpoints sketch in mixtures too wide to be copied.
        loaded.model.sketch_books.fill(loaded.codec)
    validate: Validate | None = None
    if recipe.goal == "respond" and recipe.pictures and validation:
        validate = partial(open_loop, loaded, validation, list(recipe.tasks), settings.draws)
    taught = taught_by(recipe, examples)
    on_examples = None
    if reflections is not None:
        on_examples = place_reflections(examples, read_reflections(reflections))
        check_reflections(reflections, on_examples, loaded)
    tried = None
    if failures is not None and recipe.attempting is not None:
        times_s = family_named(recipe.attempting).times_s
        tried = place_attempts(examples, read_feedback(failures), times_s, taught)
    failed = None
    if failures is not None and recipe.outcome is not None:
        failed = fails(examples, read_feedback(failures))
    judged = place_verdicts(examples, chain.from_iterable(map(read_followed, followed))) if followed else None
    learner, dataset, sampler, collator = _prepare(
        recipe, loaded, scenes, examples, taught, on_examples, tried, failed, judged, settings
    )
    if isinstance(learner, IntentLearner | FactLearner) and validation:
        held_out = Examples.from_scenes(validation, loaded.settings.cameras)
        held_out_seen = None
        if recipe.pictures:
            held_out_seen = open_vision(
                loaded,
                held_out,
                settings.cache,
                mirrored=False,
                bf16=settings.bf16,
                workers=settings.workers,
            )
        validate = _reading(learner, loaded, held_out, held_out_seen)
    if isinstance(learner, CriticLearner):
        assert isinstance(dataset, Subset)
        assert isinstance(dataset.dataset, VerdictDataset)
        _, left_out = dataset.dataset.split()
        validate = partial(told_apart, learner, dataset.dataset, left_out) if left_out else None
    trainer = LearnerTrainer(
        learner,
        recipe,
        f"{len(stages) + 1} {recipe.name}",
        dataset,
        collator,
        target,
        sampler=sampler,
        validate=validate,
        validate_every=settings.validate_every,
        save_every=settings.save_every,
        bf16=settings.bf16,
        use_cpu=settings.use_cpu,
        workers=_workers(recipe, settings),
    )
    if trainer.is_world_process_zero():
        inherit_log(target / LOG_FILE, [source, *([vision_source] if vision_source else [])])
    trainer.train(resume_from_checkpoint=last_whole_state(target / "state"))
    if trainer.is_world_process_zero():
        loaded.model.train(False)
        save(
            target,
            loaded.model,
            loaded.vocabulary,
            loaded.codec,
            dtype=torch.bfloat16,
            details={"stages": [*stages, _about(recipe, examples, taught, on_examples, tried, failed)]},
            visual_codes=loaded.visual_codes,
        )
    # gloo's threads drop what they gathered a moment later, and need the interpreter for it: a process that
    # ends before that is aborted. So nobody ends before the checkpoint is written.
    trainer.accelerator.wait_for_everyone()


def _reading(
    learner: IntentLearner | FactLearner, loaded: Loaded, held_out: Examples, seen: VisionCache | None
) -> Validate:
    """How well held-out scenes are read, or planned from what is read in them."""
    if isinstance(learner, FactLearner):
        assert seen is not None, "facts are read from pictures"
        return partial(reading_errors, learner, held_out, seen)
    read = None if seen is None else read_facts(loaded.model, held_out, seen)
    return partial(read_errors, learner, held_out, read)


def _workers(recipe: Recipe, settings: RunSettings) -> int:
    """Processes that make batches of a recipe's examples."""
    if recipe.goal != "ground":
        return settings.workers
    return max(settings.workers, 1) if settings.device.type == "cpu" else 0


def vision_parts(vla: LookTwiceVla) -> list[nn.Module]:
    """What stands between pictures and the decoder: the tower and, where there are any, what is beside it."""
    return [part for part in (vla.model.visual, vla.fine_vision, vla.resampler) if part is not None]


def small_planners(vla: LookTwiceVla) -> list[IntentReader]:
    """Those whose states stand in the prompt."""
    scene = None if vla.resampler is None else vla.resampler.intent
    return [planner for planner in (vla.track_reader, scene) if planner is not None]


def last_whole_state(folder: Path) -> str | None:
    """The newest training state that was written to its end, or None.

    ``trainer_state.json`` is written last: a folder without it, or with half of it, was cut off by a kill.
    """
    for state in sorted(folder.glob("checkpoint-*"), key=lambda path: -int(path.name.split("-")[1])):
        try:
            json.loads((state / "trainer_state.json").read_text())
        except (OSError, json.JSONDecodeError):
            continue
        return str(state)
    return None


def _prepare(
    recipe: Recipe,
    loaded: Loaded,
    scenes: Path,
    examples: Examples,
    taught: npt.NDArray[np.bool_],
    on_examples: PlacedReflections | None,
    tried: PlacedAttempts | None,
    failed: npt.NDArray[np.bool_] | None,
    judged: PlacedVerdicts | None,
    settings: RunSettings,
) -> tuple[nn.Module, Dataset[Any], TaskSampler | None, Callable[[list[Any]], dict[str, torch.Tensor]]]:
    if recipe.goal == "ground":
        grounding, device = GroundingLearner(loaded.model, loaded.codec, DENSE_SHAPE), settings.device
        if device.type != "cpu":
            looking = LookLearner(grounding, examples, loaded.inputs, device, settings.workers)
            return looking, ScenePlaces(looked_at(examples)), None, collate_places
        looks = GroundingDataset(examples, loaded.inputs, recipe.seed)
        return grounding, Subset(looks, looked_at(examples)), None, collate_grounding
    vision = None
    if recipe.pictures and recipe.vision_rate == 0:
        vision = open_vision(
            loaded,
            examples,
            settings.cache,
            mirrored=recipe.mirror_share > 0,
            fine=recipe.goal != "fine",
            bf16=settings.bf16,
            workers=settings.workers,
        )
    if recipe.goal in ("facts", "fine"):
        assert vision is not None, "facts are read from pictures"
        if not examples.pictured.any():
            raise ValueError(f"recipe {recipe.name} learns from pictures, and no scene has any")
        seen_facts = FactDataset(examples, vision, recipe.route_share, recipe.seed)
        if recipe.goal == "fine":
            close = FineDataset(seen_facts, examples, loaded.inputs)
            return FineLearner(loaded.model), Subset(close, looked_at(examples)), None, stacked
        return FactLearner(loaded.model), Subset(seen_facts, looked_at(examples)), None, stacked
    if recipe.goal == "judge":
        assert vision is not None, "facts are read from pictures"
        assert judged is not None, "critics learn from followed trajectories"
        told = read_facts(loaded.model, examples, vision, recipe.seed, recipe.misread_share)
        verdicts = VerdictDataset(examples, judged, told, recipe.route_share, recipe.seed)
        return CriticLearner(loaded.model), Subset(verdicts, verdicts.split()[0]), None, stacked
    if recipe.goal == "read":
        source: Source = "scene" if recipe.pictures else "tracks"
        reading = IntentLearner(loaded.model, loaded.codec, source)
        read = (
            None
            if vision is None
            else read_facts(loaded.model, examples, vision, recipe.seed, recipe.misread_share)
        )
        return reading, IntentDataset(examples, read, recipe.route_share, recipe.seed), None, stacked
    has_planners = loaded.model.resampler is not None and loaded.model.track_reader is not None
    own_plans = None
    if recipe.own_plans and has_planners:
        own_plans = OwnPlans(loaded.model, examples, vision, recipe.seed)
    responses = ResponseDataset(
        examples,
        loaded.codec,
        loaded.inputs,
        loaded.vocabulary,
        recipe.weights,
        pictures=recipe.pictures,
        vision=vision,
        reflections=() if on_examples is None else on_examples.reflections,
        attempts=() if tried is None else tried.attempts,
        attempting=recipe.attempting,
        own_plans=own_plans,
        sketched=recipe.sketched,
        visual_codes=loaded.visual_codes,
        seed=recipe.seed,
    )
    for part in vision_parts(loaded.model):
        part.requires_grad_(recipe.vision_rate > 0)
    for planner in small_planners(loaded.model):
        # A sketch is its planner's trajectory only while nothing else moves them: the few responses that a
        # decoder learns from would. What the state becomes in the prompt is learned with the decoder.
        planner.requires_grad_(planner.sketch is None)
        planner.tokens.requires_grad_(True)
        if planner.second is not None:
            planner.second.requires_grad_(True)
            planner.second.critic.requires_grad_(False)
    if loaded.model.sketch_books is not None:
        loaded.model.sketch_books.requires_grad_(False)
    learner = ResponseLearner(
        loaded.model,
        loaded.vocabulary,
        loaded.codec,
        error_weight=recipe.error_weight,
        head_weight=recipe.head_weight,
        compiled=settings.compiled,
    )
    if recipe.outcome is not None:
        [task] = recipe.tasks
        judging = OutcomeLearner(
            learner,
            loaded,
            responses,
            list(read_scenes(scenes, dense=False)),
            task,
            recipe.outcome,
            route_share=recipe.route_share,
            tracks_share=recipe.tracks_share if loaded.settings.with_tracks else 0.0,
        )
        # Where nobody knows the road, a draw that leaves it would count as one that holds.
        judged_there = examples.pictured & taught & examples.tell("perceived")
        if not judged_there.any():
            raise ValueError(f"recipe {recipe.name} judges draws, and no scene with pictures tells the road")
        places = np.flatnonzero(judged_there) if failed is None else half_failed(judged_there, failed)
        return judging, ScenePlaces(places.tolist()), None, collate_places
    sampler = TaskSampler(
        examples.has_route,
        recipe.batch_size,
        recipe.tasks,
        recipe.route_share,
        recipe.seed,
        processes=int(os.environ.get("WORLD_SIZE", 1)),
        reflected=np.zeros(0, np.int64) if on_examples is None else on_examples.examples,
        told=None if on_examples is None else on_examples.told,
        reasoning=recipe.reflections == "learned",
        reflecting=responses.reflecting,
        tracks_share=recipe.tracks_share if loaded.settings.with_tracks else 0.0,
        mirror_share=recipe.mirror_share,
        blur_share=recipe.blur_share,
        pictured=examples.pictured,
        taught=taught,
        mirror_reflected=loaded.settings.reflection == "phrases",
        next_cameras=[examples.next_cameras(index) for index in range(len(examples))]
        if recipe.picture_share
        else (),
        picture_share=recipe.picture_share,
        attempted=np.zeros(0, np.int64) if tried is None else tried.examples,
        attempting=recipe.attempting,
    )
    return learner, responses, sampler, collate


def _about(
    recipe: Recipe,
    examples: Examples,
    taught: npt.NDArray[np.bool_],
    on_examples: PlacedReflections | None,
    tried: PlacedAttempts | None,
    failed: npt.NDArray[np.bool_] | None,
) -> Mapping[str, Any]:
    about = {field.name: getattr(recipe, field.name) for field in fields(recipe)}
    about |= {"tasks": dict(recipe.tasks), "weights": dict(recipe.weights)}
    about["outcome"] = None if recipe.outcome is None else asdict(recipe.outcome)
    if on_examples is not None:
        thought = sum(bool(each.thinking) for each in on_examples.reflections)
        about |= {"reflections_count": thought, "right_plans_count": len(on_examples.reflections) - thought}
    if tried is not None:
        right = sum(each.correct for each in tried.attempts)
        about |= {"failures_count": len(tried.attempts) - right, "right_answers_count": right}
    if failed is not None:
        about |= {"failed_scenes_count": int(failed.sum())}
    episodes = len(np.unique(examples.episode[taught]))
    return about | {"examples": int(taught.sum()), "episodes": episodes}
