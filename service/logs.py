"""How the service logs: one line an event, JSON for machines or readable for people."""

from __future__ import annotations

import sys
from typing import Literal

import structlog


def configure_logging(log_format: Literal["json", "console"]) -> None:
    """Send structlog's events to standard error; values bound to the request come with every line."""
    rendering: list[structlog.typing.Processor] = (
        [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
        if log_format == "json"
        # The default traceback shows local variables: megabytes of pictures.
        else [structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)]
    )
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            *rendering,
        ],
        # Looked up for each line, so that a redirected standard error is honoured.
        logger_factory=lambda *_: structlog.PrintLogger(sys.stderr),
        cache_logger_on_first_use=False,
    )
