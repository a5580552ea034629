"""What commands that work through stages of a ledger have in common: the folder, the bar, the report."""

from __future__ import annotations

import asyncio
import json
import tempfile
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from looktwice.clients.labelling.ledger import Ledger, Record, StageRun
    from looktwice.clients.labelling.pipeline import Job, StageLimits, Tally


def run_stage(
    folder: Path, work: Callable[[Ledger], Coroutine[Any, Any, tuple[StageRun, Tally]]], *, dry: bool
) -> tuple[StageRun, Tally]:
    """Run a stage on a folder's ledger, or on a copy that is thrown away."""
    from looktwice.clients.labelling.dead_letters import write_dead_letters
    from looktwice.clients.labelling.ledger import FILE, Ledger

    if dry:
        with tempfile.TemporaryDirectory(prefix="looktwice-") as scratch:
            if (folder / FILE).exists():
                Ledger.copy(folder, Path(scratch))
            with Ledger(Path(scratch)) as ledger:
                result = asyncio.run(work(ledger))
                for entry in ledger.latest(result[0], result[1].done + result[1].dead):
                    typer.echo(json.dumps({"scene_id": entry.scene_id, entry.state: entry.record}, indent=1))
                return result
    with Ledger(folder) as ledger:
        try:
            return asyncio.run(work(ledger))
        finally:
            write_dead_letters(ledger, folder)


async def do_jobs(
    ledger: Ledger,
    run: StageRun,
    jobs: Iterator[Job[Any]],
    do: Callable[[Job[Any]], Awaitable[Record]],
    limits: StageLimits,
    *,
    total: int,
    quiet: bool,
) -> Tally:
    """Work through ``jobs`` under a bar; of ``total`` pieces of work, where all of them are to be done."""
    from looktwice.clients.labelling.pipeline import work_through

    with progress_bar(run, total if limits.at_most is None else None, quiet=quiet) as show:
        return await work_through(ledger, run, jobs, do, limits, show)


@contextmanager
def progress_bar(run: StageRun, total: int | None, *, quiet: bool) -> Iterator[Callable[[Tally], None]]:
    """Progress bar on stderr; also shows retries."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
    from stamina.instrumentation import RetryDetails, get_on_retry_hooks, set_on_retry_hooks

    columns = (TextColumn(run.stage), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = TextColumn("{task.description}")
    with Progress(*columns, bar, console=Console(stderr=True, quiet=quiet)) as progress:
        task = progress.add_task("", total=total)

        def show(tally: Tally) -> None:
            ended = tally.done + tally.dead + tally.earlier
            told = f"{tally.dead} dead letters" if tally.dead else ""
            progress.update(task, completed=ended, description=told)

        def wait(details: RetryDetails) -> None:
            # Not a line for each of many that wait, on the output that scripts read.
            progress.update(task, description=f"waiting: {details.caused_by}")

        hooks = get_on_retry_hooks()
        set_on_retry_hooks([wait])
        try:
            yield show
        finally:
            set_on_retry_hooks(hooks)


def scenes_in(scenes: Path) -> int:
    """How many scenes a file or folder holds."""
    from looktwice.model.driving.scene_store import count_scenes

    return count_scenes(scenes)


def report_run(run: StageRun, tally: Tally, as_json: bool, **more: Any) -> None:
    """Print what a stage did, with ``more`` of its own."""
    result = {
        "run": run.id,
        "config": dict(run.config),
        "done": tally.done,
        "dead": tally.dead,
        "earlier": tally.earlier,
        "seconds": round(tally.seconds, 3),
        "per_s": round((tally.done + tally.dead) / max(tally.seconds, 1e-9), 3),
    } | more
    if as_json:
        typer.echo(json.dumps(result))
        return
    typer.echo(
        f"{run.stage} {run.id[:8]}: {tally.done} done in {tally.seconds:.0f} s ({result['per_s']} a second), "
        f"{tally.dead} dead letters, {tally.earlier} were done before"
    )
    for name, value in more.items():
        typer.echo(f"  {name.replace('_', ' ')}: {value}")
