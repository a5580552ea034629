"""`looktwice build`, run in this process."""

from __future__ import annotations

import json
from typing import Any

from typer.testing import CliRunner

from looktwice.service.cli.commands import app


def ran(*arguments: object, code: int = 0) -> str:
    """What a command prints."""
    result = CliRunner().invoke(app, ["build", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


def told(*arguments: object) -> dict[str, Any]:
    """The JSON object that a command prints."""
    # The service runs in this process too, and its log goes where the command prints.
    lines = [json.loads(line) for line in ran(*arguments).splitlines() if line.startswith("{")]
    (found,) = [line for line in lines if "event" not in line]
    assert isinstance(found, dict)
    return found
