"""`looktwice egodriver`: alpasim's driver service in front of a planner."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from looktwice.service.cli.engines import Device, EngineName, Formats, Rows, VllmArguments, make_engine
from looktwice.service.cli.options import DEFAULT_CHECKPOINT, Checkpoint, reported_errors

if TYPE_CHECKING:
    from looktwice.clients.planner import AsyncPlannerClient
    from looktwice.clients.wire import ModelCard
    from looktwice.model.engines.engine import Engine


def egodriver(
    service: Annotated[
        str | None,
        typer.Option(help="URL of a running service; without one the checkpoint is served in this process."),
    ] = None,
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    host: Annotated[
        str,
        typer.Option(envvar="ALPASIM_DRIVER_HOST", help="Address to listen on, or unix:///path/of.sock."),
    ] = "127.0.0.1",
    port: Annotated[
        int,
        typer.Option(
            envvar="ALPASIM_DRIVER_PORT",
            help="Port to listen on; 0 takes a free one.",
            min=0,
            max=65535,
        ),
    ] = 6789,
    cameras: Annotated[
        list[str] | None,
        typer.Option(
            "--camera",
            help="OURS=LOGICAL_ID, once for each; unsaid ones are alpasim's front wide and front tele.",
        ),
    ] = None,
    n: Annotated[
        int, typer.Option(help="Draws; the one nearest to the others is driven.", min=1, max=64)
    ] = 6,
    thinking: Annotated[
        Literal["adaptive", "always", "never"], typer.Option(help="Who decides on a second look.")
    ] = "adaptive",
    temperature: Annotated[float, typer.Option(help="Of sampling.", min=0, max=2)] = 1.0,
    route: Annotated[bool, typer.Option(help="Tell the model the route.")] = True,
    deadline_ms: Annotated[
        int, typer.Option(help="That each drive has; 0 for none.", min=0, max=600_000)
    ] = 100,
    max_sessions: Annotated[int, typer.Option(help="Open at once.", min=1)] = 64,
    drain_s: Annotated[float, typer.Option(help="For open sessions, after SIGTERM.", min=0)] = 25.0,
    debug_info: Annotated[
        Literal["json", "pickle"],
        typer.Option(help="Form of the debug info; alpasim's evaluation reads pickle."),
    ] = "json",
    rows: Rows = 64,
    engine: EngineName = "torch",
    format: Formats = None,
    device: Device = "cpu",
    vllm_arguments: VllmArguments = "{}",
) -> None:
    """Serve alpasim's egodriver contract over gRPC, many sessions batched together."""
    from looktwice.clients import wire

    with reported_errors():
        if find_spec("carla_driver_interface") is None:
            raise RuntimeError("the egodriver needs more: pip install 'looktwice[alpasim]'")
        from looktwice.clients.alpasim.driver import DriverConfig
        from looktwice.clients.alpasim.session import CAMERAS
        from looktwice.service.operations.logs import configure_logging
        from looktwice.service.operations.settings import Settings

        config = DriverConfig(
            cameras={**CAMERAS, **_cameras(cameras or [])},
            controls=wire.Controls(n=n, thinking=thinking, temperature=temperature),
            route=route,
            deadline_ms=deadline_ms or None,
            max_sessions=max_sessions,
        )
        made = None
        if service is None:
            made = make_engine(
                checkpoint, rows, name=engine, device=device, vllm_arguments=vllm_arguments, formats=format
            )

        configure_logging(Settings().log_format)

        async def run() -> None:
            from looktwice.clients.alpasim.driver import Egodriver
            from looktwice.clients.alpasim.errors import EgodriverError
            from looktwice.clients.alpasim.grpc_server import serve
            from looktwice.clients.planner import PlannerError

            async with _planner(service, made) as planner:
                try:
                    driver = Egodriver(planner, await _card(planner), config)
                except (PlannerError, EgodriverError) as error:
                    raise RuntimeError(str(error)) from error
                await serve(
                    driver,
                    host,
                    port,
                    drain_s=drain_s,
                    debug_format=debug_info,
                    on_listening=lambda address: typer.echo(f"listening on {address}", err=True),
                )

        asyncio.run(run())


@asynccontextmanager
async def _planner(service: str | None, engine: Engine | None) -> AsyncIterator[AsyncPlannerClient]:
    """The service at a URL, or the same service in this process, without a socket in between."""
    import httpx

    from looktwice.clients.planner import Access, AsyncPlannerClient

    if engine is None:
        async with AsyncPlannerClient(str(service), access=Access.from_environment()) as planner:
            yield planner
        return
    from looktwice.service.app import create_app
    from looktwice.service.operations.settings import Settings

    # Nobody else reaches it: sessions are what is limited here.
    app = create_app(engine, Settings(api_keys_file=None, rate_limit=None, max_draws=4096, max_scenes=1024))
    async with (
        app.router.lifespan_context(app),
        AsyncPlannerClient("http://localhost", transport=httpx.ASGITransport(app)) as planner,
    ):
        yield planner


async def _card(planner: AsyncPlannerClient) -> ModelCard:
    """The model behind the planner, as soon as it can plan."""
    from looktwice.clients.planner import ServiceBusy

    while True:
        try:
            return (await planner.models())[0]
        except ServiceBusy as busy:
            if not busy.type.endswith("/not-ready"):
                raise
            await asyncio.sleep(busy.retry_after_s or 1.0)


def _cameras(given: list[str]) -> dict[str, str]:
    from looktwice.model.driving.scene import CAMERAS

    found = {}
    for text in given:
        camera, equals, logical_id = text.partition("=")
        if not equals or not logical_id or camera not in CAMERAS:
            raise ValueError(f"--camera {text!r} is not OURS=LOGICAL_ID; ours are {', '.join(CAMERAS)}")
        found[camera] = logical_id
    return found
