"""Running a recipe: from scenes and a checkpoint to the next checkpoint, resumable after a kill."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from torch import nn

from looktwice.model.driving.scene import LabelledScene
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
from looktwice.model.network.visual_codes import load_visual_codes
from looktwice.model.network.vla_settings import NANO_SETTINGS
from looktwice.model.training.examples import Examples
from looktwice.model.training.open_loop_validation import open_loop
from looktwice.model.training.recipe_checks import TrainingFiles, check_checkpoint, check_files, check_vision
from looktwice.model.training.recipes import Recipe
from looktwice.model.training.run_settings import RunSettings
from looktwice.model.training.trainer import LearnerTrainer, inherit_log
from looktwice.model.training.training_data import TrainingData
from looktwice.model.training.training_setup import set_up, vision_parts


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

    Raises:
        FeedbackFileError: ``failures`` is missing, damaged, or of another version.
        ValueError: the recipe wants reflections and there are none, or the other way round, or they are on
            other scenes, or on plans made with tracks where ``source`` takes none; it learns from pictures or
            judges draws, and no scene can be learned from so; it takes no failures, and
            there are some, or they are on other scenes; it teaches pictures, and there are no codes for those
            that scenes bring; it teaches sketches, and ``source`` has none; only one of ``source`` and
            ``vision_source`` writes sketches.
    """
    files = TrainingFiles(reflections, failures)
    loaded = load(source)
    check_files(recipe, loaded, files)
    check_checkpoint(recipe, loaded)
    loaded = _with_trained_parts(recipe, loaded, refining=failures is not None)
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
    data = TrainingData.read(recipe, loaded, scenes, settings.cache, files)
    if recipe.sketched:
        assert loaded.model.sketch_books is not None, "which write sketches"
        # Older checkpoints sketch in mixtures too wide to be copied.
        loaded.model.sketch_books.fill(loaded.codec)
    held_out = None
    if validation and recipe.goal in ("facts", "read"):
        held_out = Examples.from_scenes(validation, loaded.settings.cameras)
    setup = set_up(recipe, loaded, data, settings, held_out)
    validate = setup.validate
    if validation and recipe.goal == "respond" and recipe.pictures:
        validate = partial(open_loop, loaded, validation, list(recipe.tasks), settings.draws)
    trainer = LearnerTrainer(
        setup.learner,
        recipe,
        f"{len(stages) + 1} {recipe.name}",
        setup.dataset,
        setup.collate,
        target,
        sampler=setup.sampler,
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
            details={"stages": [*stages, data.describe(recipe)]},
            visual_codes=loaded.visual_codes,
        )
    # gloo's threads drop what they gathered a moment later, and need the interpreter for it: a process that
    # ends before that is aborted. So nobody ends before the checkpoint is written.
    trainer.accelerator.wait_for_everyone()


def _with_trained_parts(recipe: Recipe, loaded: Loaded, *, refining: bool) -> Loaded:
    """A checkpoint with the formats that a recipe teaches, and the parts of the network that it trains."""
    wanted = [*recipe.tasks, *([recipe.attempting] if refining and recipe.attempting is not None else [])]
    if new := [task for task in wanted if task not in loaded.settings.formats]:
        loaded = with_formats(loaded, new, seed=recipe.seed)
    if recipe.goal == "fine" and not loaded.settings.fine_vision:
        loaded = with_fine_vision(loaded, seed=recipe.seed)
    if recipe.goal == "judge" and not loaded.settings.second_sketch:
        loaded = with_second_sketches(loaded, seed=recipe.seed)
    codes, told = NANO_SETTINGS.sketch_tokens, loaded.settings.sketch_tokens
    # Older checkpoints sketch in fewer codes, so that looks lead a little beside where they should.
    if (recipe.goal == "read" and not told) or (recipe.sketched and 0 < told < codes):
        loaded = with_sketches(loaded, codes, seed=recipe.seed)
    return loaded


def _workers(recipe: Recipe, settings: RunSettings) -> int:
    """Processes that make batches of a recipe's examples."""
    if recipe.goal != "ground":
        return settings.workers
    return max(settings.workers, 1) if settings.device.type == "cpu" else 0


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
