"""`looktwice score`: what trajectories are worth by NAVSIM's rules."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import DEFAULT_SCENES, Json, ScenePath, told


def score(
    request: Annotated[
        Path, typer.Argument(help="A body of POST /v1/score in JSON; - reads it from standard input.")
    ],
    scenes: ScenePath = DEFAULT_SCENES,
    as_json: Json = False,
) -> None:
    """Score the trajectories of a request; docs/scoring.md tells what it holds."""
    with told():
        from clients.wire_scores import ScoreRequest
        from service.errors import validated
        from service.problems import ProblemError
        from service.scoring import scored
        from service.views import BundledScenes

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
