"""The command line: `looktwice`. The only room that sees all others."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; says what to install where only the planner client is there."""
    try:
        from service.cli.commands import app
    except ImportError as error:
        sys.exit(f"looktwice: {error}. The command line needs more: pip install 'looktwice[serve]'")
    app()
