"""`looktwice serve`: the HTTP service over a checkpoint."""

from __future__ import annotations

from typing import Annotated

import typer

from service.cli.options import DEFAULT_CHECKPOINT, Checkpoint, told


def serve(
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on; 0 takes a free one.")] = 8000,
    rows: Annotated[int, typer.Option(help="Draws decoded at once.", min=1)] = 64,
) -> None:
    """Serve a checkpoint over HTTP; the inspector page is at /."""
    import uvicorn

    from model.engines.torch.engine import TorchEngine, TorchSettings
    from service.app import create_app
    from service.settings import Settings

    with told():
        engine = TorchEngine(checkpoint, TorchSettings(rows=rows))
        uvicorn.run(create_app(engine, Settings()), host=host, port=port, log_config=None)
