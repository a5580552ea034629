"""`looktwice serve`: the HTTP service over a checkpoint."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from service.cli.engines import CacheMb, Device, EngineName, Reproducible, Rows, VllmArguments, make_engine
from service.cli.options import DEFAULT_CHECKPOINT, Checkpoint, told


def serve(
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on; 0 takes a free one.")] = 8000,
    rows: Rows = 64,
    engine: EngineName = "torch",
    device: Device = "cpu",
    vllm_arguments: VllmArguments = "{}",
    cache_mb: CacheMb = 256,
    reproducible: Reproducible = None,
) -> None:
    """Serve a checkpoint over HTTP; the inspector page is at /."""
    from service.app import create_app
    from service.server import make_server
    from service.settings import Settings, TeacherSettings

    with told():
        settings = Settings()
        load = partial(
            make_engine,
            rows=rows,
            name=engine,
            device=device,
            vllm_arguments=vllm_arguments,
            cache_mb=cache_mb,
            reproducible=reproducible,
        )
        app = create_app(load(checkpoint), settings, teacher=TeacherSettings().teacher(), load=load)
        make_server(app, settings, host, port).run()
