"""`looktwice train`: run a recipe, or create an untrained checkpoint to start from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import typer
from typer.core import TyperArgument, TyperCommand

from looktwice.model.bundled import CHECKPOINT as BUNDLED_CHECKPOINT
from looktwice.service.cli.options import folder_along, reported_errors
from looktwice.service.cli.progress import progress_on_stderr

_RECIPES: Final = (
    "create, {}; respond: a format of any family; branch: when to look twice, learned alone; "
    "ladder: from create to counterfactual, with a data set of own plans round by round, and the table; "
    "blind, teacher: the small planners of the tables, without pictures; "
    "visual-codes: pictures as codes, for models that imagine; "
    "composer: gives these codes what was seen half a second before."
)


class TrainCommand(TyperCommand):
    """`looktwice train`: its help names the recipes that there are, and imports them for that alone."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help, as click asks for it."""
        from looktwice.model.training.recipes import NANO

        [recipe] = [each for each in self.params if isinstance(each, TyperArgument)]
        recipe.help = _RECIPES.format(", ".join(NANO))
        super().format_help(ctx, formatter)


def train(
    context: typer.Context,
    recipe: str,
    scenes: Annotated[Path, typer.Option(help="Training scenes: a file or a folder.")],
    target: Annotated[Path, typer.Option("--to", help="Checkpoint folder to write.")],
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Checkpoint folder to start from, or one that comes along; of a ladder one that writes "
            "meta-actions, for composer one that imagines, or codes alone; for create a stock Qwen2.5-VL, "
            "which is expanded.",
            callback=lambda source: source and folder_along(source),
        ),
    ] = None,
    vision_from: Annotated[Path | None, typer.Option(help="Checkpoint whose vision tower is taken.")] = None,
    reflections: Annotated[
        Path | None,
        typer.Option(
            help="A build's reflections, for counterfactual, multi-round and, without a critic, for sketched "
            "and branch."
        ),
    ] = None,
    failures: Annotated[
        Path | None,
        typer.Option(
            help="File that `looktwice failures` wrote: elf-sft learns to refine, too, and elf-rl takes "
            "every second scene from those whose answers are wrong."
        ),
    ] = None,
    visual_codes: Annotated[
        Path | None,
        typer.Option(
            help="Folder that visual-codes made, for world-pretrain and world-sft; the checkpoint keeps them."
        ),
    ] = None,
    validation: Annotated[
        Path | None, typer.Option(help="Scenes to report errors on while training.")
    ] = None,
    validation_scenes: Annotated[int, typer.Option(help="How many of them.", min=1)] = 96,
    cache: Annotated[Path, typer.Option(help="Folder for scenes brought into arrays.")] = Path("data/cache"),
    paper: Annotated[bool, typer.Option(help="The paper's recipe, for a pretrained backbone.")] = False,
    steps: Annotated[
        int | None, typer.Option(help="Instead of the recipe's; fewer warm up for less.", min=1)
    ] = None,
    batch_size: Annotated[int | None, typer.Option(help="Instead of the recipe's.", min=1)] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Instead of the recipe's.")] = None,
    vision_rate: Annotated[
        float | None, typer.Option(help="The vision tower's, relative; 0 leaves it as it is.", min=0)
    ] = None,
    misread_share: Annotated[
        float | None,
        typer.Option(
            help="read-scene: share of the scenes without pictures that are misread as pictures would be, "
            "instead of all; 0: what is read is trusted.",
            min=0,
            max=1,
        ),
    ] = None,
    refine_below: Annotated[
        float | None,
        typer.Option(
            help="elf-rl: refine the worst draw of a scene where it scores less, instead of 0.8; 0: nothing.",
            min=0,
            max=1,
        ),
    ] = None,
    refine_by: Annotated[
        Literal["teacher", "rule"] | None,
        typer.Option(
            help="elf-rl: by the teacher's sections, as the recipe says, or by the verdict with what the "
            "expert did."
        ),
    ] = None,
    format_name: Annotated[
        str | None, typer.Option("--format", help="respond: the format to teach, by its family's name.")
    ] = None,
    weigh: Annotated[
        list[str] | None,
        typer.Option(
            help="respond: SECTION=WEIGHT of a section's tokens in the loss, instead of 1; again for more."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of order and initialisation.")] = 0,
    threads: Annotated[int | None, typer.Option(help="CPU threads.", min=1)] = None,
    bf16: Annotated[
        bool | None, typer.Option(help="Mixed precision; by default where the machine is fast at it.")
    ] = None,
    compiled: Annotated[bool, typer.Option(help="Compile the decoder; pays on long runs.")] = False,
    gpu: Annotated[bool, typer.Option(help="Use the accelerators that are there.")] = False,
    workers: Annotated[
        int,
        typer.Option(
            help="Processes that prepare batches beside the training; worth as many as there are idle cores.",
            min=0,
        ),
    ] = 0,
    rounds: Annotated[
        int, typer.Option(help="teacher: rounds of driving by itself and learning from it.", min=0)
    ] = 0,
    round_episodes: Annotated[int, typer.Option(help="teacher: episodes of a round.", min=1)] = 200,
    test: Annotated[Path | None, typer.Option(help="ladder: scenes for its table.")] = None,
    roll_out: Annotated[
        list[Path] | None,
        typer.Option(
            help="ladder: file or folder of those among --scenes that plans are made for and followed in, "
            "generated and with their manifest; again for more. All of them if not given."
        ),
    ] = None,
    every: Annotated[int, typer.Option(help="ladder: roll out every so many-th scene.", min=1)] = 6,
    processes: Annotated[
        int, typer.Option(help="ladder: that train together; as many follow plans, or --workers.", min=1)
    ] = 1,
) -> None:
    """Train a checkpoint by a recipe; started again after a kill, it goes on where it was."""
    from dataclasses import replace

    import torch

    from looktwice.model.driving.scene_store import count_scenes, read_scenes
    from looktwice.model.evaluation.curves import training_curves
    from looktwice.model.network.allocator import keep_freed_memory
    from looktwice.model.network.card import LOG_FILE
    from looktwice.model.network.precision import bfloat16_is_fast
    from looktwice.model.network.small_planner import DRIVING_KINDS
    from looktwice.model.training.branch import NAME as BRANCH
    from looktwice.model.training.branch import train_branch
    from looktwice.model.training.composer import train_composer
    from looktwice.model.training.first_checkpoint import create
    from looktwice.model.training.recipes import (
        COMPOSER,
        NANO,
        PAPER,
        RESPOND,
        VISUAL_CODES,
        lasting,
        refining_with,
        responding,
    )
    from looktwice.model.training.run import run
    from looktwice.model.training.run_settings import RunSettings
    from looktwice.model.training.small import SmallSettings
    from looktwice.model.training.visual_codes import train_visual_codes
    from looktwice.service.cli.ladder import LadderScenes, climb
    from looktwice.service.cli.small_rounds import train_small_in_rounds

    if threads is not None:
        torch.set_num_threads(threads)
    with reported_errors():
        if recipe == "create":
            figures = create(scenes, cache, target, source, seed=seed)
            _tell({f"codec {name}": value for name, value in figures.items()})
            return
        if recipe in DRIVING_KINDS:
            _refuse_others(context, recipe, "steps seed validation rounds round_episodes")
            codec_from = source or BUNDLED_CHECKPOINT
            settings = SmallSettings(seed=seed, steps=steps or SmallSettings.steps)
            train_small_in_rounds(
                recipe, scenes, codec_from, target, settings, validation, rounds, round_episodes
            )
            return
        mixed = bfloat16_is_fast("cuda" if gpu else "cpu") if bf16 is None else bf16
        run_settings = RunSettings(cache, bf16=mixed, compiled=compiled, use_cpu=not gpu, workers=workers)
        if recipe == BRANCH:
            _refuse_others(context, recipe, "reflections cache bf16 workers")
            if source is None:
                raise ValueError("give the checkpoint to start from: --from FOLDER")
            with progress_on_stderr() as progress:
                reading = progress.add_task("prompts", total=None)

                def show(done: int, total: int) -> None:
                    progress.update(reading, completed=done, total=total)

                told_apart = train_branch(scenes, source, target, reflections, run_settings, show)
            _tell(told_apart)
            return
        if recipe == "ladder":
            if test is None:
                raise ValueError("give the scenes for the table: --test FOLDER")
            if paper and source is None:
                raise ValueError(
                    "the paper's recipes begin with a model that writes meta-actions: --from FOLDER"
                )
            options = _options(context, but=_OF_LADDERS)
            of_ladder = LadderScenes(scenes, test, tuple(roll_out or ()))
            following = max(processes, workers)
            climb(target, of_ladder, source, options, every=every, processes=processes, workers=following)
            return
        recipes = {each.name: each for each in (VISUAL_CODES, COMPOSER)} | dict(PAPER if paper else NANO)
        if recipe == RESPOND:
            if format_name is None:
                raise ValueError("give the format to teach: --format NAME")
            if paper:
                raise ValueError(f"{recipe} takes no --paper: no paper tells how other formats are taught")
            recipes[RESPOND] = responding(format_name, _weights(weigh or ()))
        elif format_name is not None or weigh:
            raise ValueError(f"{recipe} takes no --format and no --weigh: it has its own")
        if recipe not in recipes:
            known = ", ".join(["create", RESPOND, BRANCH, "ladder", *DRIVING_KINDS, *recipes])
            raise ValueError(f"unknown recipe {recipe!r}; known are {known}")
        chosen = recipes[recipe]
        chosen = replace(
            chosen if steps is None else lasting(chosen, steps),
            batch_size=batch_size or chosen.batch_size,
            learning_rate=learning_rate or chosen.learning_rate,
            vision_rate=chosen.vision_rate if vision_rate is None else vision_rate,
            misread_share=chosen.misread_share if misread_share is None else misread_share,
            seed=seed,
        )
        if recipe == VISUAL_CODES.name and source is not None:
            raise ValueError("codes of pictures start from nothing: leave --from out")
        if recipe != VISUAL_CODES.name and source is None:
            raise ValueError("give the checkpoint to start from: --from FOLDER")
        if chosen.goal == "code":
            # Convolutions are faster in float32 on CPUs, even where matrices are not.
            how: dict[str, bool] = {"bf16": bf16 or False, "use_cpu": not gpu}
            _tell(
                train_visual_codes(chosen, scenes, target, validation, **how)
                if source is None
                else train_composer(chosen, scenes, source, target, validation, **how)
            )
            training_curves(target / LOG_FILE, target / "curves.png")
            return
        assert source is not None
        if refine_below is not None:
            chosen = refining_with(chosen, threshold=refine_below)
        if refine_by is not None:
            chosen = refining_with(chosen, feedback=refine_by)
        held_out = []
        if validation is not None:
            every = max(1, count_scenes(validation) // validation_scenes)
            held_out = list(islice(read_scenes(validation, dense=False), 0, every * validation_scenes, every))
        keep_freed_memory()
        run(
            chosen,
            scenes,
            source,
            target,
            run_settings,
            held_out,
            vision_from,
            reflections,
            visual_codes,
            failures,
        )
        training_curves(target / LOG_FILE, target / "curves.png")


def _weights(given: Sequence[str]) -> dict[str, float]:
    """What ``SECTION=WEIGHT`` says, by section; raises ValueError for what says something else."""
    weights = {}
    for each in given:
        section, _, weight = each.partition("=")
        try:
            weights[section] = float(weight)
        except ValueError:
            raise ValueError(f"--weigh takes SECTION=WEIGHT, not {each!r}") from None
        if not 0 <= weights[section] < math.inf:
            raise ValueError(f"--weigh {each}: a weight is 0 or more")
    return weights


def _tell(figures: Mapping[str, float]) -> None:
    for name, value in figures.items():
        typer.echo(f"{name} {value:.3f}")


_OF_LADDERS: Final = ("recipe", "scenes", "target", "source", "test", "roll_out", "every", "processes")
_ALWAYS: Final = ("recipe", "scenes", "target", "source", "threads")


def _refuse_others(context: typer.Context, recipe: str, taken: str) -> None:
    """Raise ValueError for options that a recipe would ignore; ``taken`` names its own."""
    others = [each for each in _options(context, (*_ALWAYS, *taken.split())) if each.startswith("--")]
    if others:
        raise ValueError(f"{recipe} takes no {', '.join(others)}")


def _options(context: typer.Context, but: Sequence[str]) -> list[str]:
    """The options that were given on the command line, as they are given again."""
    given = []
    for parameter in context.command.params:
        name, value = parameter.name or "", context.params.get(parameter.name or "")
        given_where = context.get_parameter_source(name)
        if name in but or given_where is None or given_where.name != "COMMANDLINE":
            continue
        option = parameter.opts[0]
        if isinstance(value, bool):
            given.append(option if value else parameter.secondary_opts[0])
        else:
            given += [option, str(value)]
    return given
