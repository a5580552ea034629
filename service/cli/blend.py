"""`looktwice blend`: a checkpoint between two others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from looktwice.service.cli.options import folder_along, reported_errors


def blend(
    before: Annotated[
        Path,
        typer.Argument(
            help="Checkpoint folder that training began with, or one that comes along.", callback=folder_along
        ),
    ],
    after: Annotated[
        Path,
        typer.Argument(
            help="Checkpoint folder that came of it, or one that comes along.", callback=folder_along
        ),
    ],
    to: Annotated[Path, typer.Option(help="Folder for the checkpoint between them.")],
    share: Annotated[float, typer.Option(min=0, max=1, help="Of the second checkpoint.")] = 0.5,
) -> None:
    """Mix the decoders of two checkpoints, and what reads one tower; the small planners are the second's."""
    with reported_errors():
        import shutil

        import torch

        from looktwice.model.network.blend import blend as blend_of
        from looktwice.model.network.card import LOG_FILE
        from looktwice.model.network.checkpoint import load, save

        blended = blend_of(load(before), load(after), share)
        save(
            to,
            blended.model,
            blended.vocabulary,
            blended.codec,
            dtype=torch.bfloat16,
            details=blended.card.details,
            visual_codes=blended.visual_codes,
        )
        if (after / LOG_FILE).exists():
            shutil.copyfile(after / LOG_FILE, to / LOG_FILE)
        typer.echo(str(to))
