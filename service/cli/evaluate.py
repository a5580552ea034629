"""`looktwice evaluate`: the open-loop table of a checkpoint over labelled scenes."""

from __future__ import annotations

import asyncio
import json
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.options import DEFAULT_CHECKPOINT, DEFAULT_SCENES, Checkpoint, Json, ScenePath, told

if TYPE_CHECKING:
    from collections.abc import Sequence

    from model.driving.scene import LabelledScene
    from model.evaluation.bootstrap import Comparison
    from model.evaluation.open_loop import SceneResult
    from model.evaluation.table import Row

    Results = dict[str, list[SceneResult]]


def evaluate(
    scenes: ScenePath = DEFAULT_SCENES,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    limit: Annotated[int | None, typer.Option(help="Scenes to evaluate on, evenly chosen.", min=1)] = None,
    n: Annotated[int, typer.Option(help="Draws per scene.", min=1)] = 6,
    rows: Annotated[int, typer.Option(help="Draws decoded at once.", min=1)] = 96,
    as_json: Json = False,
) -> None:
    """Evaluate open loop: baselines, with and without route, expert plans given, images shuffled."""
    with told():
        from model.driving.scene_store import count_scenes, read_scenes

        count = count_scenes(scenes)
        every = max(1, count // limit) if limit else 1
        labelled = list(islice(read_scenes(scenes, dense=False), 0, limit and every * limit, every))
        table, comparisons = asyncio.run(_evaluate(labelled, checkpoint, n, rows, quiet=as_json))
        from model.evaluation.table import format_table, to_json

        if as_json:
            typer.echo(json.dumps(to_json(table, comparisons)))
        else:
            typer.echo(format_table(table, comparisons))


async def _evaluate(
    scenes: Sequence[LabelledScene], checkpoint: Path, n: int, rows: int, *, quiet: bool
) -> tuple[list[Row], list[Comparison]]:
    from rich.console import Console
    from rich.progress import Progress

    from model.engines.torch.engine import TorchEngine, TorchSettings
    from model.evaluation.open_loop import evaluate_baselines
    from model.evaluation.table import Row
    from model.evaluation.variants import evaluate_engine, standard_variants

    baselines = evaluate_baselines(scenes)
    table = [Row.from_results(name, results) for name, results in baselines.items()]
    engine = TorchEngine(checkpoint, TorchSettings(rows=rows))
    await engine.start()
    results: Results = {}
    try:
        # Progress goes to stderr, so that stdout holds nothing but the table.
        with Progress(console=Console(stderr=True, quiet=quiet)) as progress:
            for variant in standard_variants(engine.card.formats, n=n):
                task = progress.add_task(variant.name, total=len(scenes))
                results[variant.name] = await evaluate_engine(
                    engine,
                    scenes,
                    variant,
                    concurrency=max(1, rows // n) + 1,
                    on_result=lambda _, task=task: progress.advance(task),  # type: ignore[misc]
                )
                about = {"n": n, "route": variant.route, "thinking": variant.controls.thinking}
                table.append(Row.from_results(variant.name, results[variant.name], **about))
                close = [result for result in results[variant.name] if result.lead_close]
                if close:
                    subgroup = "lead within 20 m"
                    table.append(Row.from_results(variant.name, close, subgroup=subgroup, **about))
    finally:
        await engine.stop()
    return table, _comparisons(results, min(baselines.values(), key=_mean_ade))


def _mean_ade(results: Sequence[SceneResult]) -> float:
    return sum(result.min_ade_m for result in results) / len(results)


def _comparisons(results: Results, best_baseline: list[SceneResult]) -> list[Comparison]:
    """What the table is read for, each as a ratio of minADE with its interval."""
    from model.evaluation.bootstrap import compare

    comparisons = []
    for suffix in ("", " + route"):
        plan = results.get(f"meta-act{suffix}")
        if plan is None:
            continue
        expert, shuffled = results[f"meta-act{suffix}, expert plan"], results[f"meta-act{suffix}, shuffled images"]
        comparisons += [
            compare(f"meta-act{suffix} : best kinematic baseline", plan, best_baseline),
            compare(f"expert plan given : free{suffix}", expert, plan),
            compare(f"images shuffled : own{suffix}", shuffled, plan),
        ]
        own_close = [result for result in plan if result.lead_close]
        shuffled_close = [result for result in shuffled if result.lead_close]
        if own_close:
            name = f"images shuffled : own{suffix} [lead within 20 m]"
            comparisons.append(compare(name, shuffled_close, own_close))
        if direct := results.get(f"traj-only{suffix}"):
            comparisons.append(compare(f"meta-act{suffix} : traj-only{suffix}", plan, direct))
    return comparisons
