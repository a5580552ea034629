"""`looktwice build`: a counterfactual data set from a served model and a teacher; every step resumes."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Iterable, Iterator
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from looktwice.service.cli.options import Json, SmallBy, reported_errors
from looktwice.service.cli.stages import do_jobs, progress_bar, report_run, run_stage, scenes_in

if TYPE_CHECKING:
    from looktwice.clients.labelling.label import LabelTask
    from looktwice.clients.labelling.ledger import Ledger, StageRun
    from looktwice.clients.labelling.pipeline import Job, Tally
    from looktwice.clients.labelling.teachers.openai import OpenAiSettings
    from looktwice.clients.labelling.teachers.teacher import Teacher
    from looktwice.model.driving.reflection_store import LabelledReflection

app = typer.Typer(
    help="Build a counterfactual data set: rollout, outcomes, filter, label, export.", no_args_is_help=True
)

Folder = Annotated[Path, typer.Argument(help="The build: its ledger and what is made of it.")]
Scenes = Annotated[Path, typer.Argument(help="Labelled scenes: a file or a folder.")]
Limit = Annotated[int | None, typer.Option(help="At most so many pieces of work more.", min=1)]
Every = Annotated[int, typer.Option(help="Take every so many-th scene only.", min=1)]
DryRun = Annotated[int, typer.Option(help="Do so many, print what comes of them, keep nothing.", min=0)]
AtOnce = Annotated[int, typer.Option(help="Most requests under way; fewer while the service is busy.", min=1)]
GiveUp = Annotated[float, typer.Option(help="Stop when nothing answers for so many seconds.", min=0)]
MaxErrorRate = Annotated[float, typer.Option(help="Stop when more than this share fails.", min=0, max=1)]
RetryDead = Annotated[bool, typer.Option(help="Do dead letters again.")]
OnRay = Annotated[
    str | None, typer.Option("--ray", help="Address of a Ray cluster to work on; local starts one here.")
]
PlansPerScene = Annotated[int, typer.Option(help="Of the model's own plans, at random.", min=1)]
LabelSeed = Annotated[int, typer.Option("--seed", help="Of that choice, and the teacher's.", min=0)]
RunId = Annotated[str | None, typer.Option("--run", help="Which rollout, where there are several.")]


@app.command()
def rollout(
    folder: Folder,
    scenes: Scenes,
    service: Annotated[str, typer.Option(help="URL of a running service.")] = "http://127.0.0.1:8000",
    n: Annotated[int, typer.Option(help="Draws, free and with the expert's plan.", min=1, max=64)] = 6,
    temperature: Annotated[float, typer.Option(help="Of sampling.", min=0, max=2)] = 1.0,
    top_p: Annotated[float, typer.Option(help="Nucleus mass.", min=0.01, max=1)] = 1.0,
    seed: Annotated[int, typer.Option(help="Of sampling.", min=0)] = 0,
    route: Annotated[bool, typer.Option(help="Tell the model the route.")] = True,
    tracks: Annotated[bool, typer.Option(help="Tell the model the tracks of the agents around.")] = False,
    at_once: AtOnce = 32,
    give_up_after: GiveUp = 300.0,
    max_error_rate: MaxErrorRate = 0.1,
    retry_dead: RetryDead = False,
    every: Every = 1,
    limit: Limit = None,
    dry_run: DryRun = 0,
    on_ray: OnRay = None,
    as_json: Json = False,
) -> None:
    """Roll a served model out over scenes: what it plans alone, and with the expert's plan given."""
    from looktwice.clients.labelling.pipeline import StageLimits
    from looktwice.clients.labelling.rollout import (
        RETRY_POLICY,
        Sampling,
        config_of,
        jobs,
        roll_out,
        served_model,
    )
    from looktwice.clients.planner import Access, AsyncPlannerClient

    sampling, access = Sampling(n, temperature, top_p, seed, route, tracks), Access.from_environment()
    limits = StageLimits(at_once, give_up_after, max_error_rate, dry_run or limit)
    unlabelled: list[str] = []

    async def roll(ledger: Ledger) -> tuple[StageRun, Tally]:
        async with AsyncPlannerClient(service, RETRY_POLICY, access=access) as planner:
            model = await served_model(planner, give_up_after)
            run = ledger.run("rollout", config_of(model, sampling))
            if retry_dead:
                ledger.forget_dead(run)
            if on_ray is not None:
                from looktwice.clients.labelling.on_ray import RolloutWork, chunks, work_on_ray

                work = RolloutWork(run, service, access, model, sampling, limits)
                found = chunks(ledger, run, scenes)
                with progress_bar(run, scenes_in(scenes), quiet=as_json) as show:
                    return run, work_on_ray(ledger, run, found, work, on_ray, show, unlabelled.append)
            return run, await do_jobs(
                ledger,
                run,
                islice(jobs(run, scenes, unlabelled.append), 0, None, every),
                lambda job: roll_out(planner, job.subject, model, sampling),
                limits,
                total=-(-scenes_in(scenes) // every),
                quiet=as_json,
            )

    with reported_errors():
        _check_ray(on_ray, limit, dry_run, every)
        run, tally = run_stage(folder, roll, dry=dry_run > 0)
        for name in unlabelled:
            typer.echo(f"{name}: left out, it has no expert's future", err=True)
        report_run(run, tally, as_json, left_out=len(unlabelled))


@app.command()
def outcomes(
    folder: Folder,
    scenes: Annotated[
        Path, typer.Argument(help="Generated scenes, with their manifest: a file or a folder.")
    ],
    workers: Annotated[int, typer.Option(help="Processes that follow plans.", min=1)] = 2,
    small: Annotated[
        Path | None,
        typer.Option(help="Folder of the small planner that drove when these scenes were generated, if any."),
    ] = None,
    by: SmallBy = "tracks",
    max_error_rate: MaxErrorRate = 0.1,
    retry_dead: RetryDead = False,
    limit: Limit = None,
    dry_run: DryRun = 0,
    run: RunId = None,
    as_json: Json = False,
) -> None:
    """Follow the model's own plans in the simulator: which hold, which fail and at what, what mends them."""
    from collections import Counter

    from looktwice.clients.labelling.build_outcomes import Followed, config_of
    from looktwice.clients.labelling.follow import follow_all
    from looktwice.clients.labelling.pipeline import StageLimits
    from looktwice.service.cli.small_pilot import SmallPilot

    makes = None if small is None else partial(SmallPilot, small, by)
    limits = StageLimits(max_error_rate=max_error_rate, at_most=dry_run or limit)
    counts: dict[str, Any] = {}

    async def follow(ledger: Ledger) -> tuple[StageRun, Tally]:
        rollout = ledger.the_run("rollout", run)
        begun = ledger.run("outcomes", config_of(rollout))
        if retry_dead:
            ledger.forget_dead(begun)
        total = None if limits.at_most else min(ledger.count(rollout), scenes_in(scenes))
        with progress_bar(begun, total, quiet=as_json) as show:
            tally = follow_all(ledger, begun, rollout, scenes, workers, limits, show, makes)
        found = [Followed.of(entry.record) for entry in ledger.entries(begun)]
        plans = [plan for each in found for plan in each.plans]
        counts.update(
            scenes=len(found),
            expert_holds=sum(each.expert.holds for each in found),
            plans=len(plans),
            plans_hold=sum(plan.holds for plan in plans),
            fails=dict(Counter(name for plan in plans for name in plan.fails)),
            mends=dict(Counter(mend.mend for each in found for mend in each.mends if mend is not None)),
        )
        return begun, tally

    with reported_errors():
        begun, tally = run_stage(folder, follow, dry=dry_run > 0)
        report_run(begun, tally, as_json, **counts)


@app.command("filter")
def choose(
    folder: Folder,
    scenes: Annotated[
        Path | None, typer.Argument(help="Keep scenes of this file or folder only.", show_default="all")
    ] = None,
    epsilon: Annotated[float, typer.Option(help="minADE of free draws must be above it, m.", min=0)] = 0.5,
    gain: Annotated[float, typer.Option(help="By which the expert's plan must help, m.", min=0)] = 0.0,
    plan_iou: Annotated[
        float | None,
        typer.Option(
            help="Ask it of every draw by itself, whose plan must agree less with the expert's.", min=0
        ),
    ] = None,
    everything: Annotated[bool, typer.Option(help="Keep all scenes.")] = False,
    outcomes: Annotated[
        bool,
        typer.Option("--outcomes", help="Keep the plans that fail when followed, instead of by minADE."),
    ] = False,
    run: RunId = None,
    as_json: Json = False,
) -> None:
    """Keep the scenes whose plan is what goes wrong; writes filter.png."""
    from looktwice.clients.labelling.build_outcomes import followed_plans
    from looktwice.clients.labelling.filtering import Thresholds, filtered, filtered_by_outcome, summary
    from looktwice.clients.labelling.ledger import Ledger
    from looktwice.clients.labelling.scatter import scatter
    from looktwice.model.driving.scene_store import row_groups, scene_files

    thresholds = Thresholds(epsilon, gain, plan_iou, everything)
    with reported_errors(), Ledger(folder) as ledger:
        if outcomes and thresholds != Thresholds():
            raise ValueError(
                "--outcomes asks what came of plans: no --epsilon, --gain, --plan-iou, --everything"
            )
        rollout = ledger.the_run("rollout", run)
        entries = ledger.entries(rollout)
        if scenes is not None:
            wanted = {name for file in scene_files(scenes) for group in row_groups(file) for name in group}
            entries = (entry for entry in entries if entry.scene_id in wanted)
        found = (
            filtered_by_outcome(entries, followed_plans(ledger, rollout))
            if outcomes
            else filtered(entries, thresholds)
        )
        ledger.select(rollout, ((scene.entry.key, scene.draws) for scene in found if scene.selected))
        scatter(found, None if outcomes else thresholds, folder / "filter.png")
        result = summary(found)
    if as_json:
        typer.echo(json.dumps(result))
        return
    typer.echo(f"{result['kept']} of {result['scenes']} scenes kept, {result['plans']} plans")
    typer.echo(f"see {folder / 'filter.png'}")
    for tag, counts in result["tags"].items():
        typer.echo(f"  {tag:<14} {counts['kept']:>7} of {counts['scenes']:>7}")


@app.command()
def label(
    folder: Folder,
    scenes: Scenes,
    teacher: Annotated[
        Literal["settings", "service"],
        typer.Option(help="settings: LOOKTWICE_TEACHER_…, built in by default; service: POST /v1/label."),
    ] = "settings",
    service: Annotated[str, typer.Option(help="URL of a running service.")] = "http://127.0.0.1:8000",
    plans_per_scene: PlansPerScene = 1,
    seed: LabelSeed = 0,
    run: RunId = None,
    at_once: AtOnce = 16,
    give_up_after: GiveUp = 300.0,
    max_error_rate: MaxErrorRate = 0.1,
    retry_dead: RetryDead = False,
    limit: Limit = None,
    dry_run: DryRun = 0,
    on_ray: OnRay = None,
    as_json: Json = False,
) -> None:
    """Have a teacher say, for every scene kept, what is less good about the model's plan."""
    from looktwice.clients.labelling.label import config_of, jobs, labeller, questions
    from looktwice.clients.labelling.pipeline import StageLimits
    from looktwice.clients.labelling.teachers.service import ServiceTeacher
    from looktwice.clients.labelling.teachers.teacher import TeacherError
    from looktwice.clients.planner import Access

    connect: Callable[[], Awaitable[Teacher]] = (
        _teacher_of_settings
        if teacher == "settings"
        else partial(ServiceTeacher.connect, service, Access.from_environment())
    )
    spent: dict[str, Any] = {}

    async def ask_all(ledger: Ledger) -> tuple[StageRun, Tally]:
        rollout = ledger.the_run("rollout", run)
        if not ledger.selected_draws(rollout, 1):
            raise RuntimeError("no scene is kept: run `looktwice build filter` first")
        try:
            asked = await connect()
        except TeacherError as error:
            raise RuntimeError(str(error)) from error
        try:
            begun = ledger.run("label", config_of(rollout, asked, seed))
            if retry_dead:
                ledger.forget_dead(begun)
            before = ledger.spent(begun)
            limits = StageLimits(at_once, give_up_after, max_error_rate, dry_run or limit)
            if on_ray is not None:
                from looktwice.clients.labelling.on_ray import LabelWork, chunks, work_on_ray

                work = LabelWork(begun, rollout, connect, plans_per_scene, seed, limits)
                kept = chunks(ledger, begun, scenes, rollout)
                with progress_bar(
                    begun, ledger.selected_draws(rollout, plans_per_scene), quiet=as_json
                ) as show:
                    tally = work_on_ray(ledger, begun, kept, work, on_ray, show)
            else:
                found = questions(ledger, rollout, scenes, plans_per_scene=plans_per_scene, seed=seed)
                tally = await do_jobs(
                    ledger,
                    begun,
                    jobs(begun, found),
                    labeller(ledger, begun, asked),
                    limits,
                    total=ledger.selected_draws(rollout, plans_per_scene),
                    quiet=as_json,
                )
            spent.update(ledger.spent(begun).since(before))
            return begun, tally
        finally:
            await asked.close()

    with reported_errors():
        _check_ray(on_ray, limit, dry_run)
        begun, tally = run_stage(folder, ask_all, dry=dry_run > 0)
        report_run(begun, tally, as_json, **spent)


@app.command()
def export(
    folder: Folder,
    to: Annotated[Path, typer.Option(help="File (parquet, openai-batch) or folder (messages) to write.")],
    form: Annotated[
        Literal["parquet", "messages", "openai-batch"],
        typer.Option(help="parquet: to train on; messages: for TRL, LLaMA-Factory; openai-batch: questions."),
    ] = "parquet",
    scenes: Annotated[
        Path | None, typer.Option(help="Labelled scenes, for messages and openai-batch.")
    ] = None,
    right_iou: Annotated[
        float | None,
        typer.Option(
            help="parquet: also the model's plans that agree so much with the expert's, to be acted on.",
            min=0,
            max=1,
        ),
    ] = None,
    right_outcomes: Annotated[
        bool,
        typer.Option(
            "--right-outcomes",
            help="parquet: outcomes decide which plans deserve a second look; those that hold are acted on.",
        ),
    ] = False,
    plans_per_scene: PlansPerScene = 1,
    seed: LabelSeed = 0,
    run: Annotated[str | None, typer.Option("--run", help="Which labels (openai-batch: rollout).")] = None,
) -> None:
    """Write what was labelled, or what is still to be asked."""
    from looktwice.clients.labelling.batch_api import batch_requests
    from looktwice.clients.labelling.export import held_plans, reflections, right_plans, write_messages
    from looktwice.clients.labelling.ledger import Ledger
    from looktwice.model.driving.reflection_store import write_reflections
    from looktwice.model.driving.whole_files import written_whole

    with reported_errors(), Ledger(folder) as ledger:
        if (right_iou is not None or right_outcomes) and form != "parquet":
            raise ValueError(
                f"--form {form} has no place for plans that are right: "
                "--right-iou and --right-outcomes need parquet"
            )
        if right_iou is not None and right_outcomes:
            raise ValueError(
                "a plan is right by its agreement or by its outcome: --right-iou or --right-outcomes"
            )
        if form == "parquet":
            labels = ledger.the_run("label", run)
            right: Iterable[LabelledReflection] = ()
            if right_iou is not None:
                right = right_plans(ledger, labels, right_iou)
            elif right_outcomes:
                right = held_plans(ledger, labels)
            labelled = reflections(ledger, labels, by_outcome=right_outcomes)
            count = write_reflections(to, chain(labelled, right))
        elif scenes is None:
            raise ValueError(f"--form {form} needs --scenes")
        elif form == "messages":
            count = write_messages(ledger, ledger.the_run("label", run), scenes, to)
        else:
            settings, _, found = _batch(ledger, scenes, plans_per_scene, seed, run)
            count = 0
            with written_whole(to) as temporary, temporary.open("w") as lines:
                for line in batch_requests(ledger, found, settings):
                    lines.write(json.dumps(line) + "\n")
                    count += 1
        typer.echo(f"{count} written to {to}")


@app.command()
def take(
    folder: Folder,
    scenes: Scenes,
    results: Annotated[Path, typer.Argument(help="Output file of an OpenAI batch.")],
    plans_per_scene: PlansPerScene = 1,
    seed: LabelSeed = 0,
    run: RunId = None,
    as_json: Json = False,
) -> None:
    """Take the answers to an exported openai-batch; what fails its checks is in the next export again."""
    from looktwice.clients.labelling.batch_api import read_results, take_results
    from looktwice.clients.labelling.dead_letters import write_dead_letters
    from looktwice.clients.labelling.ledger import Ledger

    with reported_errors(), Ledger(folder) as ledger, results.open() as lines:
        settings, begun, found = _batch(ledger, scenes, plans_per_scene, seed, run)
        before = ledger.spent(begun)
        tally = take_results(ledger, begun, found, read_results(lines, settings))
        write_dead_letters(ledger, folder)
        report_run(begun, tally, as_json, **ledger.spent(begun).since(before))


def _batch(
    ledger: Ledger, scenes: Path, plans_per_scene: int, seed: int, run: str | None
) -> tuple[OpenAiSettings, StageRun, Iterator[Job[LabelTask]]]:
    """The questions for the endpoint that the settings name."""
    from looktwice.clients.labelling.label import config_of, jobs, questions
    from looktwice.clients.labelling.teachers.openai import OpenAiTeacher
    from looktwice.service.operations.settings import TeacherSettings

    settings = TeacherSettings().openai()
    rollout = ledger.the_run("rollout", run)
    begun = ledger.run("label", config_of(rollout, OpenAiTeacher(settings), seed))
    found = questions(ledger, rollout, scenes, plans_per_scene=plans_per_scene, seed=seed)
    return settings, begun, jobs(begun, found)


def _check_ray(on_ray: str | None, limit: int | None, dry_run: int, every: int = 1) -> None:
    if on_ray is not None and (limit is not None or dry_run or every > 1):
        raise ValueError("--ray works on whole scene files: no --limit, --dry-run or --every")


async def _teacher_of_settings() -> Teacher:
    from looktwice.service.operations.settings import TeacherSettings

    return TeacherSettings().teacher()
