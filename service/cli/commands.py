"""All commands in one tree; each imports what it needs when it runs, so that help is instant."""

from __future__ import annotations

import typer

import service.cli.bench as bench
import service.cli.build as build
import service.cli.drive as drive
import service.cli.egodriver as egodriver
import service.cli.evaluate as evaluate
import service.cli.keys as keys
import service.cli.loadtest as loadtest
import service.cli.plan as plan
import service.cli.scenes as scenes
import service.cli.serve as serve
import service.cli.train as train

app = typer.Typer(
    name="looktwice",
    help="A server for driving models that look twice before they act.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)
app.command("plan")(plan.plan)
app.command("serve")(serve.serve)
app.command("train")(train.train)
app.command("evaluate")(evaluate.evaluate)
app.command("drive")(drive.drive)
app.command("loadtest")(loadtest.loadtest)
app.command("egodriver")(egodriver.egodriver)
app.add_typer(build.app, name="build")
app.add_typer(bench.bench, name="bench")
app.add_typer(scenes.app, name="scenes")
app.add_typer(keys.app, name="keys")
