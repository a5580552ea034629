"""`looktwice serve`: the HTTP service over a checkpoint."""

from __future__ import annotations

import re
import socket
import sys
import textwrap
from functools import partial
from typing import Annotated, Any, Final

import typer
from pydantic_settings import BaseSettings

from looktwice.service.cli.engines import (
    CacheMb,
    Device,
    EngineName,
    Formats,
    Reproducible,
    Rows,
    VllmArguments,
    make_engine,
)
from looktwice.service.cli.options import DEFAULT_CHECKPOINT, Checkpoint, reported_errors

_TURN_S: Final = 0.0001
"""After which a thread that computes in Python lets others go on. The engine's thread asks for its turn many
times in a pass: beside a thread that checks a body, plans took 3 to 5 times as long with Python's own 5 ms,
and take twice as long with this."""
_INDENTED: Final[Any] = {"initial_indent": "    ", "subsequent_indent": "    "}


def serve(
    checkpoint: Checkpoint = DEFAULT_CHECKPOINT,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(help="Port to listen on; 0 takes a free one.", min=0, max=65535)
    ] = 8000,
    rows: Rows = 64,
    engine: EngineName = "torch",
    format: Formats = None,
    device: Device = "cpu",
    vllm_arguments: VllmArguments = "{}",
    cache_mb: CacheMb = 256,
    reproducible: Reproducible = None,
    no_model: Annotated[
        bool, typer.Option("--no-model", help="Load no checkpoint: scores trajectories, plans nothing.")
    ] = False,
    list_settings: Annotated[
        bool, typer.Option("--settings", help="Say what can be set by environment variables, and end.")
    ] = False,
) -> None:
    """Serve a checkpoint over HTTP; the inspector page is at /."""
    from looktwice.model.network.allocator import return_large_buffers
    from looktwice.service.app import create_app
    from looktwice.service.http.server import make_server
    from looktwice.service.operations.settings import Settings, TeacherSettings

    if list_settings:
        for kind in (Settings, TeacherSettings):
            typer.echo("\n".join(_described(kind)))
        return
    return_large_buffers()
    sys.setswitchinterval(_TURN_S)
    with reported_errors():
        settings = Settings()
        _check_free(host, port)
        load = partial(
            make_engine,
            rows=rows,
            name=engine,
            device=device,
            vllm_arguments=vllm_arguments,
            formats=format,
            cache_mb=cache_mb,
            reproducible=reproducible,
        )
        teacher = TeacherSettings().teacher()
        if no_model:
            from looktwice.service.operations.no_model import NoModel

            app = create_app(NoModel(), settings, teacher=teacher)
        else:
            app = create_app(load(checkpoint), settings, teacher=teacher, load=load)
        make_server(app, settings, host, port, announce=_announce).run()


def _check_free(host: str, port: int) -> None:
    """Raise `ValueError` where nothing can listen, before a model is loaded for nothing."""
    try:
        (family, *_, address), *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            # As servers do: only who listens now is in the way, not who did a moment ago.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise ValueError(f"cannot listen at {host}, port {port}: {error.strerror}") from error


def _announce(url: str) -> None:
    """Where to go; on stdout, since stderr is the log's."""
    typer.echo(
        f"LookTwice listens at {url}; the inspector page is {url}/, its API is described at {url}/docs"
    )


def _described(kind: type[BaseSettings]) -> list[str]:
    """Each setting with its default and what its class says of it."""
    lines = []
    for names, meaning in re.findall(r"^ {8}([a-z_, \n]+): ((?:.|\n {12})+)", kind.__doc__ or "", re.M):
        for name in re.split(r"[,\s]+", names.strip()):
            default = kind.model_fields[name].get_default(call_default_factory=True)
            lines.append(f"{kind.model_config.get('env_prefix', '')}{name}".upper() + f"={default}")
        lines.append(textwrap.fill(" ".join(meaning.split()), 100, **_INDENTED))
    return lines
