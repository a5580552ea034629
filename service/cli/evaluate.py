"""`looktwice evaluate`: the open-loop table of a checkpoint over labelled scenes."""

from __future__ import annotations

import asyncio
import json
from itertools import islice
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.engines import Device, EngineName, Rows, VllmArguments, make_engine
from service.cli.options import DEFAULT_CHECKPOINT, DEFAULT_SCENES, Checkpoint, Json, ScenePath, told

if TYPE_CHECKING:
    from collections.abc import Sequence

    from model.driving.scene import LabelledScene
    from model.engines.engine import Engine
    from model.evaluation.report import Report


def evaluate(
    scenes: ScenePath = DEFAULT_SCENES,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    limit: Annotated[int | None, typer.Option(help="Scenes to evaluate on, evenly chosen.", min=1)] = None,
    n: Annotated[int, typer.Option(help="Draws per scene.", min=1)] = 6,
    rows: Rows = 96,
    engine: EngineName = "torch",
    device: Device = "cpu",
    vllm_arguments: VllmArguments = "{}",
    as_json: Json = False,
) -> None:
    """Evaluate open loop: baselines, with and without route, expert plans given, images shuffled."""
    with told():
        from model.driving.scene_store import count_scenes, read_scenes

        count = count_scenes(scenes)
        every = max(1, count // limit) if limit else 1
        labelled = list(islice(read_scenes(scenes, dense=False), 0, limit and every * limit, every))
        made = make_engine(checkpoint, rows, name=engine, device=device, vllm_arguments=vllm_arguments)
        report = asyncio.run(_evaluate(labelled, made, n, rows, quiet=as_json))
        typer.echo(json.dumps(report.to_json()) if as_json else str(report))


async def _evaluate(
    scenes: Sequence[LabelledScene], engine: Engine, n: int, rows: int, *, quiet: bool
) -> Report:
    from rich.console import Console
    from rich.progress import Progress

    from model.evaluation.report import evaluate_checkpoint
    from model.evaluation.variants import standard_variants

    await engine.start()
    try:
        variants = standard_variants(engine.card.formats, n=n)
        # Progress goes to stderr, so that stdout holds nothing but the table.
        with Progress(console=Console(stderr=True, quiet=quiet)) as progress:
            task = progress.add_task("scenes", total=len(scenes) * len(variants))
            return await evaluate_checkpoint(
                engine,
                scenes,
                variants,
                concurrency=max(1, rows // n) + 1,
                on_result=lambda variant, _: progress.update(task, advance=1, description=variant.name),
            )
    finally:
        await engine.stop()
