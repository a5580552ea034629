"""How far a command has come, told beside what it prints."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress


def progress_on_stderr(*, quiet: bool = False) -> Progress:
    """Progress bars on stderr, so that stdout holds nothing but the table or the figures."""
    from rich.console import Console
    from rich.progress import Progress

    return Progress(console=Console(stderr=True, quiet=quiet))
