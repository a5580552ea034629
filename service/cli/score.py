"""`looktwice score`: what trajectories, or planners over scenes, are worth by NAVSIM's rules."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from looktwice.service.cli.engines import Device, EngineName, Formats, Rows, VllmArguments, make_engine
from looktwice.service.cli.evaluate import evenly, run_started
from looktwice.service.cli.options import DEFAULT_SCENES, Json, OptionalCheckpoint, ScenePath, reported_errors

if TYPE_CHECKING:
    from collections.abc import Sequence

    from looktwice.model.driving.scene import LabelledScene
    from looktwice.model.driving.trajectory import FloatArray
    from looktwice.model.engines.engine import Controls, Draw, Engine
    from looktwice.model.evaluation.variants import Variant


def score(
    what: Annotated[
        Path,
        typer.Argument(
            help="A body of POST /v1/score in JSON, - for standard input; or a scene file or folder, whose "
            "expert, baselines and checkpoint are scored."
        ),
    ],
    scenes: ScenePath = DEFAULT_SCENES,
    checkpoint: OptionalCheckpoint = None,
    limit: Annotated[int | None, typer.Option(help="Scenes to score, evenly chosen.", min=1)] = None,
    n: Annotated[int, typer.Option(help="Draws per scene; the agreed one is scored.", min=1)] = 6,
    route: Annotated[bool, typer.Option(help="Give the checkpoint the scene's route.")] = True,
    forgive: Annotated[
        bool, typer.Option("--forgive", help="Forgive what the expert fails at too, as NAVSIM's EPDMS does.")
    ] = False,
    rows: Rows = 96,
    engine: EngineName = "torch",
    format: Formats = None,
    device: Device = "cpu",
    vllm_arguments: VllmArguments = "{}",
    as_json: Json = False,
) -> None:
    """Score a request's trajectories, or planners over scenes; docs/scoring.md tells how."""
    with reported_errors():
        if what.is_dir() or what.suffix == ".parquet":
            from looktwice.model.driving.scene_store import count_scenes, read_scenes
            from looktwice.model.engines.engine import Controls
            from looktwice.model.evaluation.scores import by_scene, score_table

            labelled = list(evenly(read_scenes(what, dense=False), count_scenes(what), limit))
            planners = {}
            if checkpoint is not None:
                made = make_engine(
                    checkpoint,
                    rows,
                    name=engine,
                    device=device,
                    vllm_arguments=vllm_arguments,
                    formats=format,
                )
                agreed = _agreed_draws(made, labelled, Controls(n=n), rows, route=route, quiet=as_json)
                planners[made.card.name] = by_scene(labelled, agreed)
            table = score_table(labelled, planners, forgive=forgive)
            typer.echo(json.dumps(table.to_json()) if as_json else str(table))
            return
        _score_request(what, scenes, as_json=as_json)


def _agreed_draws(
    engine: Engine,
    scenes: Sequence[LabelledScene],
    controls: Controls,
    rows: int,
    *,
    route: bool,
    quiet: bool,
) -> dict[str, FloatArray]:
    """The trajectory of the draw to drive, [8 or 64, 4] as scores take it, by scene id."""
    from functools import partial

    import numpy as np

    from looktwice.model.driving.trajectory import agreed
    from looktwice.model.evaluation.report import evaluate_variants
    from looktwice.model.evaluation.variants import Variant

    found: dict[str, FloatArray] = {}

    def keep(_: Variant, labelled: LabelledScene, draws: Sequence[Draw]) -> None:
        trajectories = np.stack([draw.at_10_hz for draw in draws])
        found[labelled.scene.scene_id] = draws[agreed(trajectories)].scored

    variants = [Variant(engine.card.name, engine.card.formats[0], controls, route=route)]
    evaluate = partial(evaluate_variants, on_draws=keep)
    asyncio.run(run_started(evaluate, scenes, engine, variants, controls.n, rows, quiet=quiet))
    return found


def _score_request(request: Path, scenes: Path, *, as_json: bool) -> None:
    from looktwice.clients.wire_scores import ScoreRequest
    from looktwice.service.http.problem_documents import validated
    from looktwice.service.problems import ProblemError
    from looktwice.service.scenes.bundled import BundledScenes
    from looktwice.service.scoring.request_scores import scored

    text = sys.stdin.read() if str(request) == "-" else request.read_text()
    try:
        asked = validated(ScoreRequest, json.loads(text))
        found = scored(asked, BundledScenes(scenes), "command-line")
    except ProblemError as error:
        raise ValueError(f"{error.kind.title}: {error.detail}") from error
    if as_json:
        typer.echo(found.model_dump_json())
        return
    against = "nothing" if found.against is None else found.against
    missing = f"; missing: {', '.join(found.missing)}" if found.missing else ""
    typer.echo(f"{found.version}, progress against {against}{missing}")
    for number, each in enumerate(found.scores):
        value = each.partial_score if each.score is None else each.score
        kind = "partial" if each.score is None else "score"
        typer.echo(f"{number:4} {kind} {'-' if value is None else f'{value:.4f}'}")
        for failure in each.failures:
            parts = [f"     {failure.time_s:.1f} s {failure.sub_score}", failure.what]
            parts.append(f"with {failure.other_id}" if failure.other_id is not None else "")
            parts.append(f"{failure.distance_m:.2f} m" if failure.distance_m is not None else "")
            typer.echo(" ".join(part for part in parts if part))
