"""`looktwice loadtest`: load on a running service, and what it does to latency."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import typer

from looktwice.service.cli.options import DEFAULT_SCENES, Json, ScenePath, reported_errors

Scenario = Literal["poisson", "sweep", "fleet", "soak", "burst", "hostile", "costly"]


def loadtest(
    service: Annotated[str, typer.Option(help="URL of a running service.")] = "http://127.0.0.1:8000",
    scenario: Annotated[Scenario, typer.Option(help="What is done; docs/load-tests.md tells.")] = "poisson",
    rate: Annotated[
        float,
        typer.Option(
            help="Requests offered per second, on average: they come by chance, so 60 s at 0.5 offer 30 "
            "give or take 5. Where a sweep begins.",
            min=0.2,
        ),
    ] = 0.5,
    seconds: Annotated[float, typer.Option(help="Of the measured run, or of each of its steps.", min=1)] = 60,
    warm_up: Annotated[float, typer.Option(help="Seconds before, left out of all figures.", min=0)] = 5.0,
    mix: Annotated[
        str,
        typer.Option(
            help="plan, direct, think, reflect, label, batch, imagine, with weights: direct=3,think=1."
        ),
    ] = "plan",
    n: Annotated[str, typer.Option(help="Draws, or imagined pictures, with weights: 1=3,6=1.")] = "6",
    payload: Annotated[str, typer.Option(help="json, msgpack, multipart, with weights.")] = "json",
    deadline_ms: Annotated[
        str, typer.Option(help="Told to the service, with weights: none=3,300=1.")
    ] = "none",
    stream: Annotated[float, typer.Option(help="Share that is streamed.", min=0, max=1)] = 0.0,
    goal_ms: Annotated[
        float | None,
        typer.Option(
            help="Latency wanted of requests without a deadline.",
            min=1,
            show_default="1000; of a fleet, the time between two ticks",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of arrivals, mix, pictures and draws.", min=0)] = 0,
    workers: Annotated[int, typer.Option(help="Processes that send.", min=1)] = 1,
    timeout_s: Annotated[float, typer.Option(help="After which an answer is given up.", min=0.1)] = 30.0,
    lag_limit_ms: Annotated[
        float, typer.Option(help="A run is not valid where 1 in 100 requests is sent later.", min=1)
    ] = 25.0,
    distinct: Annotated[
        int, typer.Option(help="Requests made beforehand at most; then they are sent again.", min=1)
    ] = 1000,
    scenes: ScenePath = DEFAULT_SCENES,
    api_key: Annotated[
        str,
        typer.Option(envvar="LOOKTWICE_API_KEY", help="Of a service that asks for one.", show_default=False),
    ] = "",
    planners: Annotated[int, typer.Option(help="fleet: how many.", min=1)] = 4,
    hz: Annotated[float, typer.Option(help="fleet: plans a second of each; 10, 5, 2 or 1.", min=0.1)] = 10.0,
    knee: Annotated[float | None, typer.Option(help="soak: what a sweep found.", min=0.05)] = None,
    share: Annotated[float, typer.Option(help="soak: of the knee.", min=0.01, max=1)] = 0.8,
    growth_limit: Annotated[
        float, typer.Option(help="soak: of memory over the second half; with more it is not valid.", min=0)
    ] = 0.05,
    server_pid: Annotated[int | None, typer.Option(help="soak, costly: whose memory is watched.")] = None,
    own_service: Annotated[
        bool,
        typer.Option(
            "--own-service",
            help="costly: start a service for it, with a teacher that means no good and a log that nobody "
            "reads, and stop it in the midst.",
        ),
    ] = False,
    factor: Annotated[float, typer.Option(help="burst: times the rate.", min=1)] = 10.0,
    burst_seconds: Annotated[float, typer.Option(help="burst: how long.", min=0.5)] = 5.0,
    report: Annotated[Path | None, typer.Option(help="Write a page with plots here (HTML).")] = None,
    as_json: Json = False,
) -> None:
    """Offer load, measured from when each request was due; exits with 1 where the run is not valid."""
    with reported_errors(), ExitStack() as stack:
        from looktwice.loadtests.attacks import RUDE
        from looktwice.loadtests.bad_teacher import bad_teacher
        from looktwice.loadtests.environment import describe_client, describe_service, versions
        from looktwice.loadtests.load_report import LoadReport
        from looktwice.loadtests.load_run import Result, Setup
        from looktwice.loadtests.mix import parse_mix
        from looktwice.loadtests.scenarios.hostile import OwnService, costly, hostile
        from looktwice.loadtests.scenarios.steady import burst, fleet, poisson, soak
        from looktwice.loadtests.scenarios.sweep import KneeSearch, sweep
        from looktwice.loadtests.sending import ServiceTarget
        from looktwice.model.driving.scene_store import read_scenes
        from looktwice.service.cli.serving import served
        from looktwice.service.operations.settings import Settings

        def soaked() -> Result:
            if knee is None or server_pid is None:
                raise ValueError(
                    "a soak needs --knee (see the sweep) and --server-pid (whose memory is watched)"
                )
            return soak(setup, knee, share, server_pid, growth_limit)

        run: dict[Scenario, Callable[[], Result]] = {
            "poisson": lambda: poisson(setup),
            "sweep": lambda: sweep(setup, KneeSearch(rate)),
            "fleet": lambda: fleet(setup, planners, hz),
            "soak": soaked,
            "burst": lambda: burst(setup, factor, burst_seconds),
            "hostile": lambda: hostile(setup, RUDE),
            "costly": lambda: costly(setup, own, server_pid),
        }
        own: OwnService | None = None
        if own_service:
            if scenario != "costly":
                raise ValueError("only the scenario costly starts a service of its own")
            teacher = stack.enter_context(bad_teacher())
            settings = {"KIND": "openai", "BASE_URL": teacher.url, "MODEL": "no-good"}
            environment = {f"LOOKTWICE_TEACHER_{name}": value for name, value in settings.items()}
            process, service = stack.enter_context(served((), environment, unread_log=True))
            own = OwnService(process, teacher, Settings().drain_s)
        goal_s = (1 / hz if scenario == "fleet" else 1.0) if goal_ms is None else goal_ms / 1000
        setup = Setup(
            target=ServiceTarget(service.rstrip("/"), api_key, timeout_s),
            scenes=tuple(read_scenes(scenes, dense=False)),
            mix=parse_mix(mix, n, payload, deadline_ms, stream),
            rate_rps=rate,
            seconds=seconds,
            warm_up_s=warm_up,
            goal_s=goal_s,
            lag_limit_s=lag_limit_ms / 1000,
            seed=seed,
            workers=workers,
            distinct=distinct,
            tell=lambda line: typer.echo(line, err=True),
        )
        models, client = describe_service(setup.target, setup.mix), describe_client()
        began = datetime.now(UTC).isoformat(timespec="seconds")
        made = LoadReport(setup, run[scenario](), began, client, models, versions())
        if report is not None:
            from looktwice.loadtests.report_page import page

            report.parent.mkdir(parents=True, exist_ok=True)
            report.write_text(page(made), encoding="utf-8")
        typer.echo(json.dumps(made.to_json()) if as_json else str(made))
    if not made.result.valid:
        raise typer.Exit(1)
