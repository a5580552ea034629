"""`looktwice feedback`: why the trajectories of a request fail."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from looktwice.service.cli.options import DEFAULT_SCENES, Json, ScenePath, reported_errors


def feedback(
    request: Annotated[
        Path, typer.Argument(help="A body of POST /v1/feedback in JSON, - for standard input.")
    ],
    scenes: ScenePath = DEFAULT_SCENES,
    as_json: Json = False,
) -> None:
    """Say why a request's trajectories fail, as the built-in teacher does; docs/feedback.md tells how."""
    from looktwice.clients.wire_feedback import FeedbackRequest
    from looktwice.service.http.problem_documents import validated
    from looktwice.service.problems import ProblemError
    from looktwice.service.scenes.bundled import BundledScenes
    from looktwice.service.scoring.rule_feedback import answer_feedback

    with reported_errors():
        text = sys.stdin.read() if str(request) == "-" else request.read_text()
        try:
            asked = validated(FeedbackRequest, json.loads(text))
            found = answer_feedback(asked, BundledScenes(scenes), "command-line").response
        except ProblemError as error:
            raise ValueError(f"{error.kind.title}: {error.detail}") from error
        if as_json:
            typer.echo(found.model_dump_json())
            return
        for number, each in enumerate(found.feedback):
            value = each.partial_score if each.score is None else each.score
            verdict = "correct" if each.correct else "wrong"
            typer.echo(
                f"{number}: {each.judged_by} {value:.4f}, {verdict} at {found.threshold:g}\n{each.text}"
            )
