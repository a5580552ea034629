"""The command line: `looktwice`. The only room that sees all others."""

from __future__ import annotations

import sys
from typing import Final

_MORE: Final = (
    "This command needs more: the simulator (`make sim`), or an extra such as "
    "pip install 'looktwice[load]' for load tests, [train], [video], [ray] or [alpasim]"
)


def main() -> None:
    """Run the command line; says what to install where a package is missing."""
    try:
        from looktwice.service.cli.commands import app
    except ImportError as error:
        sys.exit(f"looktwice: {error}. The command line needs more: pip install 'looktwice[serve]'")
    try:
        app()
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] == "looktwice":
            raise
        sys.exit(f"looktwice: {error}. {_MORE}")
