"""`looktwice keys`: keys for callers of the service."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Make keys for callers of the service.")


@app.command()
def new(name: Annotated[str, typer.Argument(help="Whose key it is: letters, digits, dots, dashes.")]) -> None:
    """Print a new key, and the line for the service's keys file; the key itself is kept nowhere."""
    from looktwice.service.operations.keys import new_line

    try:
        key, line = new_line(name)
    except ValueError as error:
        typer.echo(f"looktwice: {error}", err=True)
        raise typer.Exit(2) from error
    typer.echo(f"key:  {key}")
    typer.echo(f"line: {line}")
