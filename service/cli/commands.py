"""All commands in one tree; each imports what it needs when it runs, so that help is instant."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated

import typer

import looktwice.service.cli.bench as bench
import looktwice.service.cli.blend as blend
import looktwice.service.cli.build as build
import looktwice.service.cli.describe as describe
import looktwice.service.cli.drive as drive
import looktwice.service.cli.egodriver as egodriver
import looktwice.service.cli.evaluate as evaluate
import looktwice.service.cli.failures as failures
import looktwice.service.cli.feedback as feedback
import looktwice.service.cli.keys as keys
import looktwice.service.cli.loadtest as loadtest
import looktwice.service.cli.plan as plan
import looktwice.service.cli.scenes as scenes
import looktwice.service.cli.score as score
import looktwice.service.cli.serve as serve
import looktwice.service.cli.train as train


def _told_version(asked: bool) -> None:
    if asked:
        typer.echo(f"looktwice {version('looktwice')}")
        raise typer.Exit


def _options(
    _: Annotated[
        bool,
        typer.Option("--version", help="Say which version this is.", callback=_told_version, is_eager=True),
    ] = False,
) -> None:
    """A server for driving models that look twice before they act."""


app = typer.Typer(
    name="looktwice",
    callback=_options,
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)
app.command("plan")(plan.plan)
app.command("serve")(serve.serve)
app.command("train", cls=train.TrainCommand)(train.train)
app.command("score")(score.score)
app.command("failures")(failures.failures)
app.command("feedback")(feedback.feedback)
app.command("evaluate")(evaluate.evaluate)
app.command("blend")(blend.blend)
app.command("describe")(describe.describe)
app.command("drive")(drive.drive)
app.command("loadtest")(loadtest.loadtest)
app.command("egodriver")(egodriver.egodriver)
app.add_typer(build.app, name="build")
app.add_typer(bench.bench, name="bench")
app.add_typer(scenes.app, name="scenes")
app.add_typer(keys.app, name="keys")
