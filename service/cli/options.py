"""Options that several commands share."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Final, Literal

import typer

from looktwice.model.bundled import CHECKPOINT, CHECKPOINTS, SCENES


@contextmanager
def reported_errors() -> Iterator[None]:
    """Turn the project's own errors, and a disk that is full, into one line on stderr and exit code 2."""
    try:
        yield
    except (ValueError, RuntimeError, OSError, sqlite3.OperationalError) as error:
        typer.echo(f"looktwice: {error}", err=True)
        raise typer.Exit(2) from error


def folder_along(named: Path) -> Path:
    """The folder of a checkpoint that comes along, by its name; any other folder as it is."""
    return named if named.exists() else CHECKPOINTS.get(str(named), named)


def _found(checkpoint: Path) -> Path:
    if (folder := folder_along(checkpoint)).exists():
        return folder
    from looktwice.model.network.hub import checkpoint_folder

    with reported_errors():
        return checkpoint_folder(checkpoint)


_CHECKPOINT_HELP: Final = (
    f"Checkpoint folder, one that comes along ({', '.join(CHECKPOINTS)}), or OWNER/NAME[@REVISION] on the "
    "Hugging Face hub."
)
Checkpoint = Annotated[
    Path,
    typer.Option(
        "--checkpoint",
        help=_CHECKPOINT_HELP,
        show_default=str(CHECKPOINT.name),
        callback=_found,
    ),
]
OptionalCheckpoint = Annotated[
    Path | None,
    typer.Option(
        "--checkpoint",
        help=_CHECKPOINT_HELP,
        callback=lambda checkpoint: checkpoint and _found(checkpoint),
    ),
]
ScenePath = Annotated[
    Path, typer.Option("--scenes", help="Scene file or folder of scene files.", show_default="bundled")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]

DEFAULT_CHECKPOINT = CHECKPOINT
DEFAULT_SCENES = SCENES


SmallPlanners = Annotated[
    list[Path] | None,
    typer.Option(
        "--small",
        help="Folder of a small planner (`train blind`, `train teacher`) that plans too, or of a checkpoint "
        f"whose reader of tracks writes sketches; or one that comes along ({', '.join(CHECKPOINTS)}).",
        callback=lambda folders: folders and [folder_along(folder) for folder in folders],
    ),
]
SmallInput = Literal["tracks", "pictures", "facts"]
"""What a small planner plans from."""
SmallBy = Annotated[
    SmallInput,
    typer.Option(
        help="What --small plans from: tracks of the objects around; or it is a checkpoint, and drives by "
        "what it reads in pictures, or by the true facts in their place."
    ),
]


def small_names(kinds: Sequence[str], folders: Sequence[Path]) -> list[str]:
    """What tables call small planners: by kind and, where several are of one kind, by folder too.

    Raises:
        ValueError: two planners of one kind lie in folders of the same name.
    """
    names = [
        kind if kinds.count(kind) == 1 else f"{kind} {folder.absolute().name}"
        for kind, folder in zip(kinds, folders, strict=True)
    ]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two --small would be called {name!r}: rename a folder, or give it once")
    return names
