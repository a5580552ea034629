"""`looktwice describe`: what a model repository needs, written into a checkpoint folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from looktwice.service.cli.options import reported_errors


def describe(
    folder: Annotated[Path, typer.Argument(help="Checkpoint folder.")],
    figure: Annotated[
        list[str] | None,
        typer.Option(help="WHAT=VALUE, once for each measured value; those told before are replaced."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="What the checkpoint is called from now on.")] = None,
    format: Annotated[
        list[str] | None,
        typer.Option(help="A format that it is for, once for each; the first is its default. All without."),
    ] = None,
) -> None:
    """Write model card, processor and chat template into a checkpoint folder; weights stay as they are."""
    with reported_errors():
        from looktwice.model.network.repository import CARD, write_repository

        figures = dict(map(_split, figure)) if figure else None
        write_repository(folder, figures, name=name, formats=format)
        typer.echo(str(folder / CARD))


def _split(told: str) -> tuple[str, str]:
    what, _, value = told.rpartition("=")
    if not what or not value or "|" in told or "\n" in told:
        raise ValueError(f"{told!r} is no WHAT=VALUE, in one line and without |")
    return what.strip(), value.strip()
