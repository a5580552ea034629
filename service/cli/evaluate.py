"""`looktwice evaluate`: the open-loop table of a checkpoint over labelled scenes."""

from __future__ import annotations

import asyncio
import json
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from looktwice.service.cli.engines import Device, EngineName, Formats, Rows, VllmArguments, make_engine
from looktwice.service.cli.options import (
    DEFAULT_CHECKPOINT,
    DEFAULT_SCENES,
    Checkpoint,
    Json,
    ScenePath,
    SmallPlanners,
    reported_errors,
    small_names,
)
from looktwice.service.cli.progress import progress_on_stderr

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence

    from looktwice.model.driving.scene import LabelledScene
    from looktwice.model.driving.trajectory import FloatArray
    from looktwice.model.engines.engine import Controls, Draw, Engine
    from looktwice.model.evaluation.failures_report import FailuresReport
    from looktwice.model.evaluation.imagination import ImaginationReport
    from looktwice.model.evaluation.ladder import LadderReport
    from looktwice.model.evaluation.open_loop import SceneResult
    from looktwice.model.evaluation.report import EvaluationReport
    from looktwice.model.evaluation.variants import Variant
    from looktwice.model.network.small_planner import SmallPlanner

_Found = TypeVar("_Found")


def evaluate(
    scenes: ScenePath = DEFAULT_SCENES,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    limit: Annotated[int | None, typer.Option(help="Scenes to evaluate on, evenly chosen.", min=1)] = None,
    n: Annotated[int, typer.Option(help="Draws per scene.", min=1)] = 6,
    temperature: Annotated[float, typer.Option(help="Of sampling.", min=0, max=2)] = 1.0,
    think_threshold: Annotated[
        float | None,
        typer.Option(help="Think when the think probability exceeds it, instead of by chance.", min=0, max=1),
    ] = None,
    numbers: Annotated[
        Literal["least_error", "drawn"],
        typer.Option(help="Times of plans: of least expected error, or drawn as words are."),
    ] = "least_error",
    codes: Annotated[
        Literal["least_error", "drawn"],
        typer.Option(help="Trajectory codes: of least expected error, or drawn as words are."),
    ] = "least_error",
    bind: Annotated[
        bool, typer.Option("--bind", help="Begin only trajectories that do what their plan says.")
    ] = False,
    reasons: Annotated[
        Literal["in_view", "any"],
        typer.Option(help="What reflections in phrases may state: what has a reason in view, or anything."),
    ] = "in_view",
    rows: Rows = 96,
    engine: EngineName = "torch",
    format: Formats = None,
    device: Device = "cpu",
    vllm_arguments: VllmArguments = "{}",
    preset: Annotated[
        Literal["standard", "ladder", "imagination", "failures"],
        typer.Option(
            help="ladder: what thinking brings, checkpoint by checkpoint. imagination: waypoints with and "
            "without a picture of the next half second, and how good the pictures are. failures: scores of "
            "each --stage, and what refining by feedback brings."
        ),
    ] = "standard",
    ladder: Annotated[
        Path | None, typer.Option(help="Folder of the ladder's checkpoints; --checkpoint counts among them.")
    ] = None,
    stage: Annotated[
        list[str] | None,
        typer.Option(
            help="failures: NAME=FOLDER of a checkpoint, or FOLDER; one for each stage, in the order of "
            "learning. --checkpoint alone if not given."
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(help="failures: plan each scene with so many seeds.", min=1)] = 1,
    sweep: Annotated[
        int, typer.Option(help="Scenes for the ladder's temperatures, evenly chosen.", min=1)
    ] = 240,
    plots: Annotated[
        Path | None, typer.Option(help="Folder for the ladder's or imagination's pictures.")
    ] = None,
    per_scene: Annotated[
        Path | None, typer.Option(help="Parquet file for every scene's measures in every row of the ladder.")
    ] = None,
    keep: Annotated[
        Path | None,
        typer.Option(help="SQLite file that keeps all draws: started again, it goes on where it was."),
    ] = None,
    small: SmallPlanners = None,
    perception: Annotated[
        bool, typer.Option("--perception", help="How well pictures are read, fact by fact, and nothing else.")
    ] = False,
    gate_scenes: Annotated[
        Path | None,
        typer.Option(
            help="perception: scenes for small planners to learn on, from read and from true facts."
        ),
    ] = None,
    gate_steps: Annotated[
        int, typer.Option(help="perception: training steps of those planners.", min=1)
    ] = 8000,
    outcomes: Annotated[
        bool,
        typer.Option(
            "--outcomes",
            help="What second looks bring when plans are followed in the simulator; nothing else.",
        ),
    ] = False,
    workers: Annotated[int, typer.Option(help="outcomes: processes that follow plans.", min=1)] = 2,
    as_json: Json = False,
) -> None:
    """Evaluate open loop: baselines, with and without route, expert plans given, images shuffled."""
    with reported_errors():
        from looktwice.model.driving.scene_store import count_scenes, read_scenes
        from looktwice.model.engines.engine import Controls
        from looktwice.model.evaluation.draw_store import DrawStore

        controls = Controls(
            n=n,
            temperature=temperature,
            think_threshold=think_threshold,
            numbers=numbers,
            codes=codes,
            bind=bind,
            reasons=reasons,
        )
        labelled = list(evenly(read_scenes(scenes, dense=False), count_scenes(scenes), limit))
        if perception:
            from looktwice.service.cli.perception import tell_perception

            told_as, text = tell_perception(checkpoint, labelled, gate_scenes, gate_steps, quiet=as_json)
            typer.echo(json.dumps(told_as) if as_json else text)
            return

        def engine_of(folder: Path) -> Engine:
            made = make_engine(
                folder, rows, name=engine, device=device, vllm_arguments=vllm_arguments, formats=format
            )
            return made if keep is None else DrawStore(made, keep)

        if outcomes:
            told_as, text = _outcomes(
                scenes, labelled, engine_of(checkpoint), controls, rows, workers, keep, quiet=as_json
            )
            typer.echo(json.dumps(told_as) if as_json else text)
            return

        report: EvaluationReport | LadderReport | ImaginationReport | FailuresReport
        if preset == "ladder":
            report = _ladder(
                labelled,
                engine_of,
                checkpoint,
                ladder,
                controls,
                rows,
                sweep,
                plots,
                per_scene,
                quiet=as_json,
            )
        elif preset == "imagination":
            report = _imagination(
                labelled, engine_of(checkpoint), checkpoint, controls, rows, plots, quiet=as_json
            )
        elif preset == "failures":
            from looktwice.service.cli.evaluate_failures import evaluate_stages, stages_named

            stages = stages_named(stage or [str(checkpoint)])
            report = evaluate_stages(labelled, engine_of, stages, controls, seeds, rows, quiet=as_json)
        else:
            from looktwice.model.evaluation.report import evaluate_checkpoint
            from looktwice.model.evaluation.variants import standard_variants

            made = engine_of(checkpoint)
            variants = standard_variants(made.card.formats, controls, made.card.inputs)
            planners = _small_planners(small or ())
            evaluate = partial(evaluate_checkpoint, planners=planners)
            run = run_started(evaluate, labelled, made, variants, n, rows, quiet=as_json)
            report = asyncio.run(run)
        typer.echo(json.dumps(report.to_json()) if as_json else str(report))


def _outcomes(
    folder: Path,
    scenes: Sequence[LabelledScene],
    engine: Engine,
    controls: Controls,
    rows: int,
    workers: int,
    keep: Path | None,
    *,
    quiet: bool,
) -> tuple[dict[str, Any], str]:
    """What comes of first plans and of second looks, as JSON and as text."""
    from looktwice.clients.metadrive.outcomes import Moment, redriver, setting_of
    from looktwice.model.evaluation.report import evaluate_variants
    from looktwice.model.families.registry import family_named
    from looktwice.service.cli.outcomes import follow_pairs, outcome_pairs

    # What cannot be followed is refused before anything is planned.
    setting = setting_of(folder)
    redriver(setting, None)
    for each in scenes:
        Moment.of(each)
    format = next((each for each in engine.card.formats if family_named(each).looks_twice), None)
    if format is None:
        raise ValueError(f"{engine.card.name} writes no plans that could be looked at twice")
    pairs = outcome_pairs(format, controls, engine.card.inputs)
    variants = [variant for pair in pairs for variant in (pair.never, pair.adaptive)]
    draws: dict[str, dict[str, Sequence[Draw]]] = {variant.name: {} for variant in variants}

    def keep_draws(variant: Variant, labelled: LabelledScene, of: Sequence[Draw]) -> None:
        draws[variant.name][labelled.scene.scene_id] = of

    evaluate = partial(evaluate_variants, on_draws=keep_draws)
    asyncio.run(run_started(evaluate, scenes, engine, variants, controls.n, rows, quiet=quiet))
    file = None if keep is None else keep.with_name(f"{keep.name}.outcomes")
    tables = follow_pairs(pairs, scenes, draws, setting, workers, file, quiet=quiet)
    told_as = {"second_looks": [{"given": given} | table.to_json() for given, table in tables.items()]}
    return told_as, "\n\n".join(f"given the {given}:\n{table}" for given, table in tables.items())


def _small_planners(folders: Sequence[Path]) -> dict[str, Callable[[LabelledScene], FloatArray]]:
    """How small planners plan, by their names; scenes need a route."""
    from looktwice.model.network.small_planner import load_small

    def plans_by(planner: SmallPlanner, labelled: LabelledScene) -> FloatArray:
        trajectory: FloatArray = planner.plan([labelled.given(route=True, tracks=True)])[0]
        return trajectory

    planners = [load_small(folder) for folder in folders]
    names = small_names([planner.kind for planner in planners], folders)
    return {name: partial(plans_by, planner) for name, planner in zip(names, planners, strict=True)}


def evenly(scenes: Iterable[LabelledScene], count: int, limit: int | None) -> Iterator[LabelledScene]:
    """So many of the ``count`` scenes, or all, evenly chosen."""
    every = max(1, count // limit) if limit else 1
    return islice(scenes, 0, limit and every * limit, every)


def _ladder(
    scenes: Sequence[LabelledScene],
    engine_of: Callable[[Path], Engine],
    checkpoint: Path,
    folder: Path | None,
    controls: Controls,
    rows: int,
    sweep: int,
    plots: Path | None,
    per_scene: Path | None,
    *,
    quiet: bool,
) -> LadderReport:
    """Climb the ladder: every checkpoint in turn, the last round's with all temperatures and thresholds."""
    from looktwice.model.evaluation import ladder_plots
    from looktwice.model.evaluation.ladder import (
        COUNTERFACTUAL,
        LADDER,
        ROUND_2,
        TEMPERATURES,
        THRESHOLDS,
        ladder_report,
        ladder_variants,
        temperature_variants,
        threshold_results,
        threshold_variants,
        write_scenes,
    )
    from looktwice.model.evaluation.report import evaluate_variants

    entries = (
        {} if folder is None else {entry: folder / entry for entry in LADDER if (folder / entry).is_dir()}
    )
    if folder is not None and not entries:
        raise ValueError(f"{folder} holds no ladder: none of {', '.join(LADDER)} is there")
    entries.setdefault(COUNTERFACTUAL, checkpoint)
    shown = ROUND_2 if ROUND_2 in entries else COUNTERFACTUAL
    results: dict[Variant, list[SceneResult]] = {}
    for entry, path in entries.items():
        draws: dict[tuple[str, str], Sequence[Draw]] = {}

        def keep(variant: Variant, labelled: LabelledScene, of: Sequence[Draw], draws: Any = draws) -> None:
            draws[variant.name, labelled.scene.scene_id] = of

        variants = [each for route in (False, True) for each in ladder_variants(entry, controls, route=route)]
        derived = [each for each in variants if each.controls.think_threshold is not None]
        planned = [each for each in variants if each not in derived]
        evaluate = partial(evaluate_variants, on_draws=keep)
        found = asyncio.run(
            run_started(evaluate, scenes, engine_of(path), planned, controls.n, rows, quiet=quiet)
        )
        found |= threshold_results(entry, derived, scenes, draws)
        results |= {variant: found[variant] for variant in variants}
        if entry == shown:
            results |= threshold_results(entry, threshold_variants(entry, controls), scenes, draws)
            swept = list(evenly(scenes, len(scenes), sweep))
            variants = temperature_variants(entry, controls)
            run = run_started(
                evaluate_variants, swept, engine_of(path), variants, controls.n, rows, quiet=quiet
            )
            results |= asyncio.run(run)
    report = ladder_report(results)
    if per_scene is not None:
        write_scenes(results, per_scene)
    if plots is not None:
        plots.mkdir(parents=True, exist_ok=True)
        row_of = {row.name: row for row in report.report.rows if row.subgroup is None}
        ladder_plots.difficulty_plot(
            report.difficulty[f"{shown}, adaptive"], plots / "thinking-by-difficulty.png"
        )
        ladder_plots.temperature_plot(
            [(value, row_of[f"{shown}, temperature {value:g}"]) for value in TEMPERATURES],
            plots / "thinking-by-temperature.png",
        )
        ladder_plots.threshold_plot(
            [(value, row_of[f"{shown}, threshold {value:g}"]) for value in THRESHOLDS],
            plots / "risk-and-compute.png",
        )
    return report


def _imagination(
    scenes: Sequence[LabelledScene],
    engine: Engine,
    checkpoint: Path,
    controls: Controls,
    rows: int,
    plots: Path | None,
    *,
    quiet: bool,
) -> ImaginationReport:
    """What a checkpoint plans with and without imagining, and what its pictures are worth."""
    from looktwice.model.driving.images import encode_png, tiled
    from looktwice.model.driving.whole_files import written_whole
    from looktwice.model.evaluation.imagination import evaluate_imagination, imagination_variants
    from looktwice.model.network.checkpoint import load

    loaded = load(checkpoint)
    variants = imagination_variants(loaded, scenes, controls)
    evaluate = partial(evaluate_imagination, loaded=loaded)
    report = asyncio.run(run_started(evaluate, scenes, engine, variants, controls.n, rows, quiet=quiet))
    if plots is not None:
        with written_whole(plots / "imagined.png") as temporary:
            temporary.write_bytes(encode_png(tiled(report.shown)))
    return report


async def run_started(
    evaluate: Callable[..., Awaitable[_Found]],
    scenes: Sequence[LabelledScene],
    engine: Engine,
    variants: Sequence[Variant],
    n: int,
    rows: int,
    *,
    quiet: bool,
) -> _Found:
    """What ``evaluate`` makes of an engine that runs meanwhile.

    Raises:
        EngineError, RequestError: the engine's.
        ValueError: the scenes do not allow a variant, told before the engine starts.
    """
    from looktwice.model.evaluation.variants import check_variants

    check_variants(scenes, variants)
    await engine.start()
    try:
        with progress_on_stderr(quiet=quiet) as progress:
            task = progress.add_task("scenes", total=len(scenes) * len(variants))
            return await evaluate(
                engine,
                scenes,
                variants,
                concurrency=max(1, rows // n) + 1,
                on_result=lambda variant, _: progress.update(task, advance=1, description=variant.name),
            )
    finally:
        await engine.stop()
