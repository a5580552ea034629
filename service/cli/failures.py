"""`looktwice failures`: a served model's own responses, judged, with feedback on each; it resumes."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from looktwice.service.cli.build import AtOnce, Every, Folder, GiveUp, Limit, MaxErrorRate, RetryDead, Scenes
from looktwice.service.cli.options import Json, reported_errors
from looktwice.service.cli.stages import do_jobs, report_run, run_stage, scenes_in

if TYPE_CHECKING:
    from looktwice.clients.labelling.feedback_set import FeedbackSample, Inference
    from looktwice.clients.labelling.ledger import Ledger, StageRun
    from looktwice.clients.labelling.pipeline import StageLimits, Tally


def failures(
    folder: Folder,
    scenes: Scenes,
    to: Annotated[
        Path | None, typer.Option(help="Parquet file to write.", show_default="FOLDER/feedback.parquet")
    ] = None,
    service: Annotated[str, typer.Option(help="URL of a running service.")] = "http://127.0.0.1:8000",
    n: Annotated[int, typer.Option(help="Draws of a scene.", min=1, max=64)] = 2,
    temperature: Annotated[float, typer.Option(help="Of sampling.", min=0, max=2)] = 1.0,
    top_p: Annotated[float, typer.Option(help="Nucleus mass.", min=0.01, max=1)] = 1.0,
    seed: Annotated[int, typer.Option(help="Of the draws, and of the choice among them.", min=0)] = 0,
    route: Annotated[bool, typer.Option(help="Tell the model the route.")] = True,
    tracks: Annotated[bool, typer.Option(help="Tell the model the tracks of the agents around.")] = False,
    format: Annotated[
        str | None, typer.Option(help="Response format; the checkpoint's first one if not given.")
    ] = None,
    threshold: Annotated[float, typer.Option(help="Score of a correct response.", min=0, max=1)] = 0.8,
    correct: Annotated[int, typer.Option(help="Most correct responses that get feedback.", min=0)] = 4000,
    wrong: Annotated[int, typer.Option(help="Most wrong responses that get feedback.", min=0)] = 4000,
    at_once: AtOnce = 16,
    give_up_after: GiveUp = 300.0,
    max_error_rate: MaxErrorRate = 0.1,
    retry_dead: RetryDead = False,
    every: Every = 1,
    limit: Limit = None,
    as_json: Json = False,
) -> None:
    """Infer, score, sample correct and wrong responses, have feedback written: docs/feedback.md."""
    from looktwice.clients.labelling.feedback_set import FeedbackSample, Inference, rows, sampled
    from looktwice.clients.labelling.ledger import Ledger
    from looktwice.clients.labelling.pipeline import StageLimits
    from looktwice.model.driving.feedback_store import write_feedback

    inference = Inference(n, temperature, top_p, seed, route=route, tracks=tracks, format=format)
    limits = StageLimits(at_once, give_up_after, max_error_rate, limit)
    with reported_errors():
        sample = FeedbackSample(threshold, correct, wrong, seed)
        inferred, tally = run_stage(
            folder,
            lambda ledger: _infer(ledger, scenes, service, inference, limits, every, retry_dead, as_json),
            dry=False,
        )
        if not as_json:
            report_run(inferred, tally, as_json)
        written, feedback_tally = run_stage(
            folder,
            lambda ledger: _write(ledger, scenes, inferred, inference, sample, limits, retry_dead, as_json),
            dry=False,
        )
        path = to or folder / "feedback.parquet"
        with Ledger(folder) as ledger:
            found = list(rows(ledger, inferred, written, sampled(ledger, inferred, sample)))
            count = write_feedback(path, found)
        more: dict[str, Any] = {
            "inferred": tally.done + tally.earlier,
            "inference_dead": tally.dead,
            "correct": sum(row.correct for row in found),
            "wrong": count - sum(row.correct for row in found),
            "file": str(path),
        }
        report_run(written, feedback_tally, as_json, **more)


async def _infer(
    ledger: Ledger,
    scenes: Path,
    service: str,
    inference: Inference,
    limits: StageLimits,
    every: int,
    retry_dead: bool,
    quiet: bool,
) -> tuple[StageRun, Tally]:
    from looktwice.clients.labelling.feedback_set import infer, inference_config
    from looktwice.clients.labelling.rollout import RETRY_POLICY, jobs, served_model
    from looktwice.clients.planner import Access, AsyncPlannerClient

    async with AsyncPlannerClient(service, RETRY_POLICY, access=Access.from_environment()) as planner:
        model = await served_model(planner, limits.give_up_after_s)
        run = ledger.run("inference", inference_config(model, inference))
        if retry_dead:
            ledger.forget_dead(run)
        return run, await do_jobs(
            ledger,
            run,
            islice(jobs(run, scenes, lambda _: None), 0, None, every),
            lambda job: infer(planner, job.subject, model, inference),
            limits,
            total=-(-scenes_in(scenes) // every),
            quiet=quiet,
        )


async def _write(
    ledger: Ledger,
    scenes: Path,
    inferred: StageRun,
    inference: Inference,
    sample: FeedbackSample,
    limits: StageLimits,
    retry_dead: bool,
    quiet: bool,
) -> tuple[StageRun, Tally]:
    from looktwice.clients.labelling.feedback_set import feedback_config, feedback_jobs, sampled, writer
    from looktwice.clients.labelling.teachers.feedback_teacher import FeedbackTeacher
    from looktwice.service.operations.settings import TeacherSettings

    set_teacher = TeacherSettings().teacher()
    teacher = set_teacher if isinstance(set_teacher, FeedbackTeacher) else None
    try:
        run = ledger.run("feedback", feedback_config(inferred, teacher, sample.threshold))
        if retry_dead:
            ledger.forget_dead(run)
        chosen = sampled(ledger, inferred, sample)
        return run, await do_jobs(
            ledger,
            run,
            feedback_jobs(ledger, inferred, run, chosen, scenes),
            writer(ledger, run, teacher, inference.version, sample.threshold),
            limits,
            total=sum(map(len, chosen.values())),
            quiet=quiet,
        )
    finally:
        await set_teacher.close()
